"""The expert of Push-T: what it tries is what happens, and it brings the T to wherever the goal is."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("gym_pusht", reason="the simulators are not installed: make setup")

from vilp_data.sims.pusht import GOAL_POSE, PushTEnv
from vilp_data.sims.pusht_expert import PushTExpert
from vilp_data.sims.pusht_trial import OUTLINE_LENGTH, PushTrial, outline, placed

pytestmark = pytest.mark.sim
LIMIT = 300  # of a policy that is judged, pipelines/pusht.toml
MOVED = (356.0, 356.0, math.pi / 4)


def demonstrate(seed, *, goal=GOAL_POSE):
    """Actions float32 [n,2], states float64 [n+1,5], and whether it ended in success within `LIMIT` steps."""
    env = PushTEnv(cameras=False, goal_pose=goal)
    _, info = env.reset(seed=seed)
    actions, states = [], [info["state"]]
    for action in PushTExpert(env, seed=seed).actions():
        assert env.action_space.contains(action)
        _, _, terminated, _, info = env.step(action)
        actions.append(action)
        states.append(info["state"])
        if terminated or len(actions) == LIMIT:
            break
    return np.array(actions), np.array(states), bool(info["is_success"])


@pytest.mark.parametrize("goal", [GOAL_POSE, MOVED])
def test_five_starts_are_solved_in_time_wherever_the_goal_is(goal):
    assert all(demonstrate(seed, goal=goal)[2] for seed in range(5))


@pytest.mark.slow
@pytest.mark.parametrize("goal", [GOAL_POSE, MOVED, (200.0, 180.0, -2.0)])
def test_nine_of_ten_starts_are_solved_in_time(goal):
    episodes = [demonstrate(seed, goal=goal) for seed in range(50)]
    assert sum(success for *_, success in episodes) >= 45
    assert np.median([len(actions) for actions, *_ in episodes]) < 150  # people: 119


def test_the_same_seed_does_the_same():
    first, again = demonstrate(2), demonstrate(2)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])


def test_actions_alone_bring_the_states_back():
    actions, states, _ = demonstrate(1)
    env = PushTEnv(cameras=False)
    env.reset(options={"state": states[0]})
    played = np.array([env.step(action)[4]["state"] for action in actions])
    assert np.abs(played - states[1:])[:, :2].max() < 1e-3
    assert np.abs(played - states[1:]).max() < 0.1  # gym-pusht puts this T a little into the wall, which pushes it out
    assert env.step(actions[-1])[4]["is_success"]


def test_a_push_that_is_tried_does_what_the_same_push_does_in_the_environment():
    """Through contact, rotation and the wall; an earlier trial leaves nothing behind."""
    trial, env = PushTrial(), PushTEnv(cameras=False)
    pushes = [
        ((250.0, 250.0, 0.5), (150.0, 250.0), (300.0, 260.0)),
        ((430.0, 250.0, 2.0), (300.0, 280.0), (460.0, 300.0)),
    ]
    for block, start, end in pushes:
        targets = np.linspace(start, end, 12)[1:]
        env.reset(options={"state": np.array([*start, *block])})
        for target in targets:
            env.step(target)
        assert np.abs(env.block[:2] - block[:2]).max() > 10
        for _ in range(2):
            np.testing.assert_allclose(trial.push(np.array(block), np.array(start), targets), env.block, atol=0.05)


def test_the_outline_is_the_ts_and_its_normals_point_away():
    from shapely.geometry import Point, Polygon
    from shapely.ops import unary_union

    env = PushTEnv(cameras=False)
    env.reset(options={"state": np.array([50.0, 450, 250, 240, 0.7])})
    shapes = [Polygon([tuple(corner) for corner in shape.get_vertices()]) for shape in env._sim.block.shapes]
    tee = unary_union(shapes)
    places, normals = outline(np.arange(0.5, OUTLINE_LENGTH, 7))
    for place, normal in zip(places, normals, strict=True):
        assert tee.exterior.distance(Point(place)) < 1e-9
        assert not tee.contains(Point(place + normal))
        assert tee.contains(Point(place - normal))
    assert tee.exterior.length == pytest.approx(OUTLINE_LENGTH)
    corner = env._sim.block.local_to_world((60, 0))
    np.testing.assert_allclose(placed(np.array([(60.0, 0.0)]), env.block)[0], corner)


def test_a_disc_that_is_behind_the_t_goes_around_it():
    env = PushTEnv(cameras=False)
    env.reset(options={"state": np.array([256.0, 120, 256, 200, 0.0])})  # the bar is below it
    before = env.block
    for action in PushTExpert(env, seed=0)._go(np.array([256.0, 400.0])):
        env.step(action)
    np.testing.assert_allclose(env.agent, [256, 400], atol=4)
    np.testing.assert_allclose(env.block, before, atol=1e-6)
