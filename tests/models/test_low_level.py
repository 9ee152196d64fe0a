"""The low-level policy: it learns, it tells its frames apart, and it sees the same in training and in use."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.models.pair_batches import VIEWS, codebooks, contract, overfit, pairs
from vilp_data.errors import UsageError
from vilp_data.pairs import PairTensors
from vilp_models.contract import DataContract
from vilp_models.low_level import LowLevelPolicy
from vilp_models.recipe import PolicyRecipe
from vilp_models.vqgan import nearest_codes


def policy(
    seed: int = 0, *, of: DataContract | None = None, given: dict[str, Any] | None = None, **recipe: Any
) -> LowLevelPolicy:
    torch.manual_seed(seed)
    settings = {"vision_width": 8, "hidden": (32,), "batch_size": 8} | recipe
    given = {"codebooks": codebooks()} if given is None else given
    return LowLevelPolicy(PolicyRecipe(**settings), of or contract(), **given)


def sides(batch: PairTensors, sees: str = "frames") -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    seen = batch.latents if sees == "latents" else batch.frames
    return {v: images[:, 0] for v, images in seen.items()}, {v: images[:, 1] for v, images in seen.items()}


def loss_of(network: LowLevelPolicy, batch: PairTensors, seed: int = 0) -> float:
    return float(network.losses(batch, torch.Generator().manual_seed(seed))["action"].detach())


VARIANTS: list[dict[str, Any]] = [
    {"pool": "average"},
    {"pool": "keypoints", "low_dim": True},
    {"pool": "average", "shared_vision": False},
    {"sees": "latents", "pool": "average"},
    {"sees": "latents", "pool": "keypoints", "shared_vision": False},
]


@pytest.mark.parametrize("variant", VARIANTS[:1] + VARIANTS[1:2] + VARIANTS[3:4])
def test_it_learns_one_batch_by_heart(variant: dict[str, Any]) -> None:
    before, after = overfit(policy(**variant), pairs(), steps=80)
    assert after < 0.01 * before


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_gradient_reaches_every_parameter(variant: dict[str, Any]) -> None:
    network = policy(**variant)
    network.losses(pairs(), torch.Generator())["action"].backward()
    still = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert still == []


@pytest.mark.parametrize("variant", VARIANTS)
def test_actions_have_the_dataset_s_unit(variant: dict[str, Any]) -> None:
    network, batch = policy(**variant).eval(), pairs()
    actions = network.act(*sides(batch, network.recipe.sees), batch.low_dim)
    assert actions.shape == batch.action.shape
    assert actions.dtype == torch.float32
    normalised = (actions - torch.tensor([100.0, -5.0])) / torch.tensor([40.0, 2.0])
    recorded = (batch.action - torch.tensor([100.0, -5.0])) / torch.tensor([40.0, 2.0])
    assert float((normalised - recorded).square().mean()) == pytest.approx(loss_of(network, batch), rel=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_order_of_the_frames_matters(variant: dict[str, Any]) -> None:
    network, batch = policy(**variant), pairs()
    first, second = sides(batch, network.recipe.sees)
    forward, backward = network.act(first, second, batch.low_dim), network.act(second, first, batch.low_dim)
    assert (forward - backward).abs().max() > 1e-3


def test_every_view_is_seen() -> None:
    network, batch = policy(), pairs()
    first, second = sides(batch)
    before = network.act(first, second)
    for view in VIEWS:
        assert (network.act(first | {view: 255 - first[view]}, second) - before).abs().max() > 1e-3


def test_separate_networks_see_the_two_frames() -> None:
    shared, separate = policy(), policy(shared_vision=False)

    def count(network: LowLevelPolicy) -> int:
        return sum(p.numel() for name, p in network.named_parameters() if "vision" in name)

    assert count(separate) == 2 * count(shared)
    batch = pairs()
    before = separate.act(*sides(batch))
    same_first = separate.vision["front"](torch.zeros(1, 3, 32, 32))
    assert separate.second_vision is not None
    for parameter in separate.second_vision.parameters():
        parameter.data += 0.1
    assert torch.equal(separate.vision["front"](torch.zeros(1, 3, 32, 32)), same_first)
    assert (separate.act(*sides(batch)) - before).abs().max() > 1e-3


def test_low_dim_is_seen_where_the_recipe_says_so() -> None:
    batch = pairs()
    blind, seeing = policy(), policy(low_dim=True)
    assert torch.equal(blind.act(*sides(batch), batch.low_dim), blind.act(*sides(batch)))
    assert (seeing.act(*sides(batch), batch.low_dim) - seeing.act(*sides(batch), batch.low_dim + 1)).abs().max() > 1e-3
    with pytest.raises(UsageError, match="trained with low_dim"):
        seeing.act(*sides(batch))
    policy(low_dim=True, of=contract(low_dim_size=0)).act(*sides(batch))


# --- latents


def test_latents_are_quantised_before_they_are_seen() -> None:
    network, batch = policy(sees="latents"), pairs()
    first, second = sides(batch, "latents")
    books = codebooks()

    def quantised(latents: dict[str, Tensor]) -> dict[str, Tensor]:
        return {v: books[v][nearest_codes(z, books[v])].permute(0, 3, 1, 2) for v, z in latents.items()}

    torch.testing.assert_close(network.act(first, second), network.act(quantised(first), quantised(second)))
    nudged = {view: latents + 1e-3 for view, latents in quantised(second).items()}
    torch.testing.assert_close(network.act(first, nudged), network.act(first, second))


def test_a_checkpoint_brings_its_codebooks() -> None:
    batch = pairs()
    trained, loaded = policy(sees="latents"), policy(7, sees="latents", given={})
    with pytest.raises(UsageError, match="codebooks"):
        loaded.act(*sides(batch, "latents"))
    loaded.load_state_dict(trained.state_dict())
    assert torch.equal(loaded.act(*sides(batch, "latents")), trained.act(*sides(batch, "latents")))


@pytest.mark.parametrize("recipe", [{"sees": "latents"}, {"reconstructed_share": 0.5}])
def test_a_dataset_without_latents_is_refused(recipe: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=r"front(.|\n)*vilp-data latents"):
        policy(of=contract(latent_shapes={}, latent_keys={}), **recipe)


# --- reconstructed frames


def reconstruction(view: str, latents: Tensor) -> Tensor:
    """A picture of the first latent channel, as large as frames are."""
    grey = (latents[:, 0].float().clamp(-2, 2) * 60 + 128).to(torch.uint8)
    picture = grey.repeat_interleave(8, 1).repeat_interleave(8, 2)
    return picture.unsqueeze(-1).expand(-1, -1, -1, 3) // (1 + VIEWS.index(view))


def all_reconstructed(batch: PairTensors) -> PairTensors:
    frames = {v: images.clone() for v, images in batch.frames.items()}
    for view, images in frames.items():
        images[:, 1] = reconstruction(view, batch.latents[view][:, 1])
    return replace(batch, frames=frames)


def test_a_share_of_second_frames_is_reconstructed_in_training() -> None:
    batch = pairs(64)
    kept = {view: images.clone() for view, images in batch.frames.items()}
    plain = policy()
    partly, wholly = (policy(reconstructed_share=s, given={"reconstruct": reconstruction}) for s in (0.5, 1.0))
    true, imagined = loss_of(plain, batch), loss_of(plain, all_reconstructed(batch))
    assert true != pytest.approx(imagined, rel=1e-4)
    assert loss_of(wholly, batch) == pytest.approx(imagined, rel=1e-6)
    assert loss_of(partly, batch, seed=3) == loss_of(partly, batch, seed=3) != loss_of(partly, batch, seed=4)
    assert loss_of(wholly.eval(), batch) == pytest.approx(true, rel=1e-6)
    assert all(torch.equal(batch.frames[view], images) for view, images in kept.items())


def test_the_share_that_is_reconstructed_is_the_one_asked_for() -> None:
    decoded: list[int] = []

    def counting(view: str, latents: Tensor) -> Tensor:
        decoded.append(len(latents))
        return reconstruction(view, latents)

    network = policy(reconstructed_share=0.3, given={"reconstruct": counting})
    for seed in range(3):
        loss_of(network, pairs(8), seed=seed)
    assert decoded == [2] * 3 * len(VIEWS)  # of 8 pairs, in every step: nobody counts on the device


def test_reconstructing_without_a_vqgan_is_refused() -> None:
    with pytest.raises(UsageError, match="reconstructed_share = 0.5"):
        loss_of(policy(reconstructed_share=0.5, given={}), pairs())
