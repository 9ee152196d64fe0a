"""Behaviour cloning: it learns recorded actions, and those alone, and acts as a policy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.models.pair_batches import VIEWS, contract, overfit, window_batch
from vilp_data.dataset import WindowTensors
from vilp_data.errors import UsageError
from vilp_models.policies.base import Observation, Policy
from vilp_models.policies.bc import BcNetwork, BcPolicy
from vilp_models.recipe import BcRecipe

N_ACTION_STEPS = 4


def network(n_action_steps: int = N_ACTION_STEPS, **recipe: Any) -> BcNetwork:
    torch.manual_seed(0)
    settings = {"vision_width": 8, "hidden": (32,), "batch_size": 8} | recipe
    return BcNetwork(BcRecipe(**settings), contract(latent_keys={}, latent_shapes={}), n_action_steps)


def loss_of(model: BcNetwork, batch: WindowTensors) -> float:
    return float(model.losses(batch, torch.Generator())["action"].detach())


@pytest.mark.parametrize("pool", ["average", "keypoints"])
def test_it_learns_one_batch_by_heart(pool: str) -> None:
    before, after = overfit(network(pool=pool), window_batch(4), steps=60)
    assert after < 0.01 * before


@pytest.mark.parametrize("pool", ["average", "keypoints"])
def test_the_gradient_reaches_every_parameter(pool: str) -> None:
    model = network(pool=pool)
    model.losses(window_batch(), torch.Generator())["action"].backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0] == []


def test_only_recorded_actions_of_the_chunk_count() -> None:
    model, batch = network(), window_batch()
    mask, action = batch.action_mask.clone(), batch.action
    assert action is not None
    mask[:3, 2:] = False
    masked = replace(batch, action_mask=mask)
    expected = loss_of(model, masked)

    def changed(rows: slice, steps: slice) -> float:
        other = action.clone()
        other[rows, steps] += 50
        return loss_of(model, replace(masked, action=other))

    assert changed(slice(0, 3), slice(2, None)) == expected
    assert changed(slice(None), slice(N_ACTION_STEPS, None)) == expected
    assert changed(slice(0, 3), slice(0, 2)) > expected
    assert changed(slice(3, None), slice(3, 4)) > expected


def test_the_loss_is_the_mean_over_recorded_actions_in_units_of_their_deviation() -> None:
    model, batch = network(), window_batch()
    mask = torch.zeros_like(batch.action_mask)
    mask[1, 0] = mask[5, 3] = True
    predicted = model.act(batch.frames, batch.low_dim)
    assert batch.action is not None
    error = (predicted - batch.action[:, :N_ACTION_STEPS]) / torch.tensor([40.0, 2.0])
    expected = float((error[1, 0].square().mean() + error[5, 3].square().mean()) / 2)
    assert loss_of(model, replace(batch, action_mask=mask)) == pytest.approx(expected, rel=1e-4)


def test_a_batch_without_a_recorded_action_has_no_loss_and_no_nan() -> None:
    batch = window_batch()
    assert loss_of(network(), replace(batch, action_mask=torch.zeros_like(batch.action_mask))) == 0


def test_a_chunk_longer_than_the_windows_is_refused() -> None:
    with pytest.raises(UsageError, match=r"n_action_steps = 7, windows of 6 actions"):
        loss_of(network(7), window_batch())
    with pytest.raises(UsageError, match="windows of 0 actions"):
        loss_of(network(), replace(window_batch(), action=None))


def test_the_policy_gives_what_the_network_does() -> None:
    batch = window_batch()
    policy: Policy = BcPolicy(network(), tags={"checkpoint": "abc"})
    assert policy.timings() == {}
    policy.reset([3, 4])
    observation = Observation(
        frames={view: batch.frames[view].numpy()[:2] for view in VIEWS},
        low_dim=batch.low_dim.numpy()[:2],
        hold_action=np.zeros((2, 2), np.float32),
    )
    actions = policy.act(observation)
    assert actions.shape == (2, policy.n_action_steps, 2)
    assert actions.dtype == np.float32
    expected = network().act({view: batch.frames[view][:2] for view in VIEWS}, batch.low_dim[:2])
    np.testing.assert_allclose(actions, expected.numpy(), rtol=1e-5)
    assert set(policy.timings()) == {"act"}
    assert policy.timings()["act"] > 0
    assert policy.tags == {"checkpoint": "abc"}
