"""The Push-T environment: exact resets, its spaces, its physics and its success."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vilp_data.errors import UsageError

pytest.importorskip("gym_pusht", reason="the simulators are not installed: make setup")

from vilp_data.sims.pusht import PushTEnv

pytestmark = pytest.mark.sim

ON_THE_GOAL = np.array([50.0, 450.0, 256.0, 256.0, math.pi / 4])
APART = np.array([100.0, 100.0, 350.0, 300.0, 2.0])


@pytest.fixture(scope="module")
def env():
    env = PushTEnv()
    yield env
    env.close()


position = st.floats(20, 492)


@given(st.tuples(position, position, position, position, st.floats(0, 2 * math.pi, exclude_max=True)))
@settings(max_examples=50, deadline=None)
def test_reset_restores_any_state_exactly(env, state):
    _, info = env.reset(options={"state": np.array(state)})
    wrapped = np.abs(np.angle(np.exp(1j * (info["state"][4] - state[4]))))
    assert np.abs(info["state"][:4] - state[:4]).max() < 1e-9
    assert wrapped < 1e-9


def test_observation_and_action_fit_their_spaces(env):
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    observation, _, _, truncated, _ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert not truncated


def test_picture_and_state_tell_the_same_story(env):
    observation, info = env.reset(options={"state": APART})
    blue = (observation["top"][..., 2] > 200) & (observation["top"][..., 0] < 120)
    row, column = (np.argwhere(blue).mean(axis=0) + 0.5) * 512 / 96
    assert np.abs(np.array([column, row]) - info["state"][:2]).max() < 3
    assert np.abs(observation["low_dim"] - info["state"][:2]).max() < 1e-4


def test_nothing_of_an_earlier_episode_survives_a_reset(env):
    target = np.array([300.0, 320.0], np.float32)

    def played():
        env.reset(options={"state": APART})
        return np.stack([env.step(target)[4]["state"] for _ in range(15)])

    first = played()  # ends in contact with the block, moving
    np.testing.assert_array_equal(played(), first)


def test_the_agent_reaches_a_target_it_is_given(env):
    env.reset(options={"state": APART})
    for _ in range(20):
        _, _, _, _, info = env.step(np.array([150.0, 80.0], np.float32))
    assert np.abs(info["state"][:2] - (150, 80)).max() < 0.5
    np.testing.assert_allclose(info["state"][2:], APART[2:], atol=1e-9)


def test_a_block_on_the_goal_is_a_success_and_one_apart_is_not(env):
    assert env.reset(options={"state": ON_THE_GOAL})[1]["coverage"] == pytest.approx(1, abs=0.02)
    _, reward, terminated, _, info = env.step(ON_THE_GOAL[:2])
    assert (reward, terminated, info["is_success"]) == (1.0, True, True)
    env.reset(options={"state": APART})
    _, reward, terminated, _, info = env.step(APART[:2])
    assert reward < 0.95
    assert not terminated
    assert not info["is_success"]


def test_the_same_seed_starts_at_the_same_state_and_another_does_not(env):
    first, again, other = (env.reset(seed=seed)[1]["state"] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1


def test_a_state_of_another_shape_is_refused(env):
    with pytest.raises(UsageError, match="block_angle"):
        env.reset(options={"state": np.zeros(4)})
