from __future__ import annotations

import pytest

from vilp_data.errors import SpecError, UsageError
from vilp_data.spec import PRESETS, Frozen
from vilp_data.task_toml import load_task, parse_task, task_names
from vilp_models.recipe import (
    VQGAN_PRESETS,
    BcRecipe,
    PlannerRecipe,
    PolicyRecipe,
    VilpRecipe,
    VqganRecipe,
    load_recipe,
    vqgan_recipe,
)
from vilp_models.vqgan import build_vqgan

KINDS: dict[str, type[Frozen]] = {
    "vqgan": VqganRecipe, "planner": PlannerRecipe, "policy": PolicyRecipe, "bc": BcRecipe, "vilp": VilpRecipe,
}  # fmt: skip


def test_the_default_is_the_papers_network() -> None:
    model = build_vqgan(VqganRecipe())
    millions = [round(sum(p.numel() for p in part.parameters()) / 1e6, 1) for part in (model.encoder, model.decoder)]
    assert millions == [23.1, 34.0]
    assert VqganRecipe().downsampling == 8


def test_a_misspelt_key_is_answered_with_the_nearest() -> None:
    with pytest.raises(SpecError, match="did you mean 'learning_rate'"):
        vqgan_recipe({"vqgan": {"learning_rat": 1e-3}}, preset=None, where="task.toml")


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
        vqgan_recipe({"vqgan": table}, preset=None, where="task.toml")


OWN_TASK = """
name = "own"
views.top = { topic = "/top", height = 96, width = 96 }
models.vqgan = { codes = 512 }
presets.cpu.models.vqgan = { steps = 1000 }
"""


def test_a_task_of_ones_own_gets_the_presets_recipe_with_its_own_keys_on_top() -> None:
    recipe = vqgan_recipe(parse_task(OWN_TASK, where="own.toml", preset="cpu").models, preset="cpu", where="own.toml")
    assert (recipe.width, recipe.multipliers, recipe.crop) == (16, (1, 2, 4, 4), 48)
    assert (recipe.codes, recipe.steps) == (512, 1000)
    tiny = vqgan_recipe(parse_task(OWN_TASK, where="own.toml", preset="tiny").models, preset="tiny", where="own.toml")
    assert (tiny.codes, tiny.steps) == (512, 60)


def test_without_a_preset_and_at_paper_the_recipe_is_the_papers() -> None:
    assert vqgan_recipe({}, preset=None, where="x") == vqgan_recipe({}, preset="paper", where="x") == VqganRecipe()


def test_every_preset_of_tasks_has_a_recipe_and_no_other_does() -> None:
    assert set(VQGAN_PRESETS) == set(PRESETS)
    with pytest.raises(UsageError, match="did you mean 'tiny'"):
        vqgan_recipe({}, preset="tinny", where="x")


@pytest.mark.parametrize(("task", "steps"), [("arrange_blocks", 4000), ("hanoi", 4000), ("pusht", 7000)])
def test_the_built_in_tasks_differ_in_what_their_toml_says_alone(task: str, steps: int) -> None:
    recipe = vqgan_recipe(load_task(task, preset="cpu").models, preset="cpu", where=task)
    assert recipe.model_copy(update={"steps": 4000}) == vqgan_recipe({}, preset="cpu", where="any")
    assert recipe.steps == steps


@pytest.mark.parametrize("kind", [VqganRecipe, PlannerRecipe, PolicyRecipe, BcRecipe])
def test_a_warm_up_that_outlasts_training_is_refused(kind: type[Frozen]) -> None:
    changes = {"steps": 100, "warmup_steps": 101}
    with pytest.raises(ValueError, match="warmup_steps = 101 must be at most steps = 100"):
        kind.model_validate(changes)
    assert kind.model_validate({**changes, "warmup_steps": 100})


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("task", task_names())
def test_every_preset_of_every_task_is_a_recipe(task: str, preset: str) -> None:
    models = load_task(task, preset=preset).models
    for name, kind in KINDS.items():
        assert load_recipe(kind, name, models, preset=preset, where=task)
