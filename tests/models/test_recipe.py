from __future__ import annotations

import pytest

from vilp_data.errors import SpecError
from vilp_models.recipe import VqganRecipe, vqgan_recipe
from vilp_models.vqgan import build_vqgan


def test_the_default_is_the_papers_network() -> None:
    model = build_vqgan(VqganRecipe())
    millions = [round(sum(p.numel() for p in part.parameters()) / 1e6, 1) for part in (model.encoder, model.decoder)]
    assert millions == [23.1, 34.0]
    assert VqganRecipe().downsampling == 8


def test_a_misspelt_key_is_answered_with_the_nearest() -> None:
    with pytest.raises(SpecError, match="did you mean 'learning_rate'"):
        vqgan_recipe({"vqgan": {"learning_rat": 1e-3}}, where="task.toml")


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"width": 24}, "groups = 32 must divide"),
        ({"crop": 50}, "multiple of the downsampling"),
        ({"steps": 10, "codebook_start": 10}, "less than steps = 10"),
        ({"perceptual": "resnet"}, "perceptual"),
    ],
)
def test_values_that_contradict_each_other_are_named(table: dict[str, object], says: str) -> None:
    with pytest.raises(SpecError, match=says):
        vqgan_recipe({"vqgan": table}, where="task.toml")
