"""VILP acting: what it decodes, what its noise depends on, and that a batch is as its environments alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.models.conftest import tiny_recipe
from tests.models.pair_batches import HEIGHT, N_PLAN_FRAMES, STRIDE, VIEWS, WIDTH, codebooks, contract
from vilp_data.errors import UsageError
from vilp_models.low_level import LowLevelPolicy
from vilp_models.planner import Planner
from vilp_models.policies.base import Observation, Policy
from vilp_models.policies.vilp import VilpPolicy
from vilp_models.recipe import PlannerRecipe, PolicyRecipe
from vilp_models.vqgan import VqganEncoder, build_vqgan

PLANNER = {
    "width": 8, "multipliers": (1, 2), "blocks": 1, "groups": 8, "convolutions": "factorised", "vision_width": 4,
    "denoising_steps": 2, "steps": 1, "warmup_steps": 0, "batch_size": 1,
}  # fmt: skip
N_ACTION_STEPS = 3  # a pair and a half


class CountingVqgan(VqganEncoder):
    """Not trained, but its codes differ so much that its images do; counts the frames it decodes."""

    def __init__(self) -> None:
        model = build_vqgan(tiny_recipe(multipliers=(1, 1, 2, 2)))
        nn.init.normal_(model.quantize.embedding.weight, std=3.0)
        super().__init__(model)
        self.n_decoded = 0

    def decode_tensor(self, z_BCHW: Tensor) -> Tensor:
        self.n_decoded += len(z_BCHW)
        return super().decode_tensor(z_BCHW)


def vilp(
    n_action_steps: int = N_ACTION_STEPS,
    *,
    sees: str = "frames",
    condition: str = "token+concat",
    low_dim: bool = False,
    **options: Any,
) -> VilpPolicy:
    torch.manual_seed(0)
    recipe = PlannerRecipe(**PLANNER, condition=condition)  # type: ignore[arg-type]
    planners = {view: Planner(recipe, contract(), view) for view in VIEWS}
    for planner in planners.values():  # layers that begin at zero would make every plan the same
        for parameter in planner.parameters():
            if not parameter.any():
                nn.init.normal_(parameter, std=0.1)
    policy = PolicyRecipe(vision_width=8, hidden=(32,), sees=sees, low_dim=low_dim, batch_size=1)  # type: ignore[arg-type]
    low_level = LowLevelPolicy(policy, contract(), codebooks=codebooks())
    encoders = {view: CountingVqgan() for view in VIEWS}
    return VilpPolicy(planners, encoders, low_level, n_action_steps=n_action_steps, **options)


def n_decoded(policy: VilpPolicy) -> list[int]:
    return [encoder.n_decoded for encoder in policy.encoders.values() if isinstance(encoder, CountingVqgan)]


def observation(*numbers: int) -> Observation:
    """Each environment's is a function of its number."""
    drawn = [np.random.default_rng(number) for number in numbers]
    return Observation(
        frames={
            view: np.stack([rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8) for rng in drawn]) for view in VIEWS
        },
        low_dim=np.stack([rng.standard_normal(4) for rng in drawn]).astype(np.float32),
        hold_action=np.zeros((len(drawn), 2), np.float32),
    )


def test_a_chunk_has_as_many_actions_as_are_executed() -> None:
    policy: Policy = vilp()
    policy.reset([5, 6])
    actions = policy.act(observation(1, 2))
    assert (actions.shape, actions.dtype) == ((2, policy.n_action_steps, 2), np.float32)
    assert np.isfinite(actions).all()


def test_only_frames_that_actions_lead_to_are_decoded_and_the_actions_are_the_same() -> None:
    lean, plain = vilp(), vilp(decode_all=True)
    for policy in (lean, plain):
        policy.reset([5, 6])
    first, second = lean.act(observation(1, 2)), plain.act(observation(1, 2))
    assert n_decoded(lean) == [2 * 2, 2 * 2]
    assert n_decoded(plain) == [2 * N_PLAN_FRAMES, 2 * N_PLAN_FRAMES]
    np.testing.assert_allclose(first, second, rtol=1e-3, atol=1e-2)


def test_actions_lead_from_the_real_present_through_imagined_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, seen = vilp(), []

    def act(first: dict[str, Tensor], second: dict[str, Tensor], low_dim: Tensor) -> Tensor:
        seen.append((first, second, low_dim))
        return torch.zeros(len(low_dim), STRIDE, 2)

    monkeypatch.setattr(policy.low_level, "act", act)
    policy.reset([5, 6])
    now = observation(1, 2)
    policy.act(now)
    [(first, second, low_dim)] = seen
    for view in VIEWS:
        pairs_first, pairs_second = first[view].view(2, 2, HEIGHT, WIDTH, 3), second[view].view(2, 2, HEIGHT, WIDTH, 3)
        np.testing.assert_array_equal(pairs_first[:, 0], now.frames[view])
        assert torch.equal(pairs_first[:, 1], pairs_second[:, 0])
        assert not torch.equal(pairs_second[:, 0], pairs_second[:, 1])
    np.testing.assert_array_equal(low_dim, np.repeat(now.low_dim, 2, axis=0))


def test_the_same_seed_gives_the_same_actions_and_every_plan_has_noise_of_its_own() -> None:
    policy = vilp()

    def two_plans(seed: int) -> list[np.ndarray[Any, Any]]:
        policy.reset(seed)
        return [policy.act(observation(1)) for _ in range(2)]

    one, again, other = two_plans(5), two_plans(5), two_plans(6)
    np.testing.assert_array_equal(one, again)
    assert np.abs(one[0] - one[1]).max() > 1e-3
    assert np.abs(one[0] - other[0]).max() > 1e-3


def test_an_environment_does_not_depend_on_who_else_is_in_the_batch() -> None:
    policy = vilp()
    policy.reset([7, 5, 9])
    together = [policy.act(observation(3, 1, 2)), policy.act(observation(6, 4, 5))]
    policy.reset(5)
    alone = [policy.act(observation(1)), policy.act(observation(4))]
    for many, one in zip(together, alone, strict=True):
        np.testing.assert_allclose(many[1:2], one, rtol=1e-3, atol=1e-2)
        assert np.abs(many[0] - one[0]).max() > 0.1


def test_a_low_level_policy_that_sees_latents_needs_no_decoder() -> None:
    policy = vilp(sees="latents", condition="token")
    policy.reset([5, 6])
    assert policy.act(observation(1, 2)).shape == (2, N_ACTION_STEPS, 2)
    assert n_decoded(policy) == [0, 0]
    assert set(policy.timings()) == {"encode", "condition", "denoise", "act"}


@pytest.mark.parametrize("condition", ["token", "token+concat"])
def test_timings_say_where_a_plan_went(condition: str) -> None:
    policy = vilp(condition=condition)
    policy.reset(5)
    assert policy.timings() == {}
    policy.act(observation(1))
    encoded = {"encode"} if condition == "token+concat" else set()
    assert set(policy.timings()) == {"condition", "denoise", "decode", "act"} | encoded
    assert min(policy.timings().values()) > 0


def test_low_dim_that_nobody_knows_at_imagined_frames_is_refused() -> None:
    assert vilp(STRIDE, low_dim=True).n_pairs == 1
    with pytest.raises(UsageError, match=rf"low_dim = false(.|\n)*n_action_steps = {STRIDE}\)"):
        vilp(STRIDE + 1, low_dim=True)


def test_more_denoising_steps_than_noise_levels_are_refused() -> None:
    levels = PlannerRecipe().train_steps
    with pytest.raises(UsageError, match=rf"{levels + 1} denoising steps(.|\n)*at most {levels}"):
        vilp(denoising_steps=levels + 1)


def test_how_it_samples_is_told_beside_its_checkpoints() -> None:
    tags = vilp(sampler="ddim", precision="bf16", tags={"policy_checkpoint": "abc"}).tags
    told = {"denoising_steps": "2", "sampler": "ddim", "precision": "bf16"}
    assert tags == {"policy_checkpoint": "abc", **told}


def test_actions_that_no_planned_frame_reaches_are_refused() -> None:
    reach = N_PLAN_FRAMES * STRIDE
    assert vilp(reach).n_pairs == N_PLAN_FRAMES
    with pytest.raises(UsageError, match=rf"n_action_steps = {reach + 1}, 3 frames of 2 steps(.|\n)*at most {reach}"):
        vilp(reach + 1)
