"""The Push-T environment: exact resets, its spaces, its physics and its success."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.real_data import real_data
from vilp_data.errors import UsageError
from vilp_models.metrics import psnr

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


def test_a_moved_goal_is_where_success_is_and_where_the_picture_shows_it():
    moved = PushTEnv(goal_pose=(356.0, 356.0, 0.0))
    there = np.array([50.0, 450.0, 356.0, 356.0, 0.0])
    assert moved.reset(options={"state": ON_THE_GOAL})[1]["is_success"] is False
    assert moved.reset(options={"state": there})[1]["coverage"] == pytest.approx(1, abs=0.02)
    assert moved.step(there[:2])[2]
    picture = moved.reset(options={"state": ON_THE_GOAL})[0]["top"]
    green = (picture[..., 1] > 200) & (picture[..., 0] < 180) & (picture[..., 2] < 180)
    row, column = (np.argwhere(green).mean(axis=0) + 0.5) * 512 / 96
    assert (330 < column < 380, 360 < row < 430) == (True, True)
    assert moved.tags() == {"goal": "356,356,0", "object": "T"}
    assert PushTEnv(cameras=False).tags() == {"goal": "256,256,45", "object": "T"}
    moved.reset(seed=1)
    assert moved.step(there[:2])[4]["coverage"] < 0.9  # a start from a seed keeps the goal too


def test_a_goal_of_other_numbers_is_refused():
    with pytest.raises(UsageError, match="2 numbers"):
        PushTEnv(goal_pose=(1.0, 2.0))


def test_the_published_frames_with_another_goal_are_drawn_as_they_are():
    zarr = pytest.importorskip("zarr")
    data = zarr.open(real_data("pusht/pusht_keypoint_x356_y356.zarr"), mode="r")["data"]
    moved = PushTEnv(goal_pose=(356.0, 356.0, math.pi / 4))
    for step in (0, 60, 120):
        drawn = moved.reset(options={"state": np.array(data["state"][step], np.float64)})[0]["top"]
        assert psnr(drawn, np.array(data["img"][step])) > 40
