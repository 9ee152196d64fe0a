"""Towers of Hanoi: what the environment promises, and that its expert solves it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from vilp_data.types import F32, F64

Demonstration = tuple[list[F32], list[F64], dict[str, Any]]

pytestmark = pytest.mark.sim

gymnasium = pytest.importorskip("gymnasium", reason="the simulators are not installed (make setup)")
pytest.importorskip("robosuite", reason="the simulators are not installed (make setup)")

from vilp_data.errors import UsageError  # noqa: E402
from vilp_data.sims import register  # noqa: E402
from vilp_data.sims.hanoi import HanoiEnv  # noqa: E402
from vilp_data.sims.hanoi_expert import HanoiExpert, hanoi_moves  # noqa: E402


@pytest.fixture(scope="module")
def one_disc() -> Iterator[HanoiEnv]:
    env = HanoiEnv(1, cameras=False)
    yield env
    env.close()


@pytest.fixture(scope="module")
def watched() -> Iterator[HanoiEnv]:
    env = HanoiEnv(3)
    yield env
    env.close()


@pytest.fixture(scope="module")
def demonstration(one_disc: HanoiEnv) -> Demonstration:
    return demonstrate(one_disc, seed=5)


def demonstrate(env: HanoiEnv, seed: int) -> Demonstration:
    """The expert's actions, the states before and after each, and the last info."""
    _, info = env.reset(seed=seed)
    actions, states = [], [info["state"]]
    for action in HanoiExpert(env).actions():
        _, _, terminated, truncated, info = env.step(action)
        actions.append(action)
        states.append(info["state"])
        if terminated or truncated:
            break
    return actions, states, info


@pytest.mark.parametrize("n_discs", [1, 2, 3])
def test_moves_are_legal_and_solve_the_puzzle(n_discs: int) -> None:
    pegs: list[list[int]] = [list(range(n_discs)), [], []]  # smallest first
    moves = hanoi_moves(n_discs, 0, 2)
    for disc, source, target in moves:
        assert pegs[source][0] == disc
        assert not pegs[target] or disc < pegs[target][0]
        pegs[target].insert(0, pegs[source].pop(0))
    assert pegs == [[], [], list(range(n_discs))]
    assert len(moves) == 2**n_discs - 1


def test_expert_moves_one_disc_and_lets_go(one_disc: HanoiEnv) -> None:
    quaternions = []
    _, info = one_disc.reset(seed=3)
    actions = []
    for action in HanoiExpert(one_disc).actions():
        observation, _, terminated, _, info = one_disc.step(action)
        actions.append(action)
        quaternions.append(observation["low_dim"][3:7])
        if terminated:
            break
    assert info["is_success"]
    assert 20 < len(actions) < 80
    assert all(action.dtype == np.float32 and one_disc.action_space.contains(action) for action in actions)
    assert not one_disc.scene.gripper_touches_discs()
    assert (np.einsum("ki,ki->k", quaternions[1:], quaternions[:-1]) > 0.9).all()  # none jumps to its negative


def test_expert_grasps_again_when_a_disc_is_lost_on_the_way(one_disc: HanoiEnv) -> None:
    _, info = one_disc.reset(seed=3)
    knocked_away = False
    for action in HanoiExpert(one_disc).actions():
        *_, info = one_disc.step(action)
        if not knocked_away and one_disc.scene.disc_position(0)[2] > 0.84:
            pose = np.array([0.07, 0.05, 0.807, 1, 0, 0, 0])  # flat on the table, beside the pegs
            one_disc.scene.sim.data.set_joint_qpos(one_disc.scene.discs[0].joints[0], pose)
            one_disc.scene.sim.data.set_joint_qvel(one_disc.scene.discs[0].joints[0], np.zeros(6))
            knocked_away = True
        if info["is_success"]:
            break
    assert knocked_away
    assert info["is_success"]


def test_recorded_actions_give_the_recorded_states_back_bit_for_bit(
    one_disc: HanoiEnv, demonstration: Demonstration
) -> None:
    actions, states, _ = demonstration
    one_disc.reset(seed=99)  # another base angle: everything must come from the state
    one_disc.reset(options={"state": states[0]})
    for action, expected in zip(actions, states[1:], strict=True):
        assert np.array_equal(one_disc.step(action)[4]["state"], expected)


def test_an_episode_goes_on_from_a_state_in_its_middle(one_disc: HanoiEnv, demonstration: Demonstration) -> None:
    actions, states, _ = demonstration
    middle = len(actions) // 2  # the disc is in the gripper
    one_disc.reset(options={"state": states[middle]})
    for action, expected in zip(actions[middle:], states[middle + 1 :], strict=True):
        assert np.array_equal(one_disc.step(action)[4]["state"], expected)


def test_actions_one_step_off_do_not_give_the_states_back(one_disc: HanoiEnv, demonstration: Demonstration) -> None:
    actions, states, _ = demonstration
    one_disc.reset(options={"state": states[0]})
    reached = [one_disc.step(action)[4]["state"] for action in actions[1:16]]
    n_joints = len(one_disc.joint_names)
    errors = [
        np.abs(a[1 : 1 + n_joints] - b[1 : 1 + n_joints]).max() for a, b in zip(reached, states[1:], strict=False)
    ]
    assert max(errors) > 0.01  # rad


def test_looking_does_not_change_what_happens(one_disc: HanoiEnv, demonstration: Demonstration) -> None:
    actions, states, _ = demonstration
    one_disc.reset(options={"state": states[0]})
    for action, expected in zip(actions[:15], states[1:16], strict=True):
        one_disc.scene.refresh_kinematics()
        one_disc.is_solved()
        assert np.array_equal(one_disc.step(action)[4]["state"], expected)


def test_seed_sets_the_base_angle_within_its_range(one_disc: HanoiEnv) -> None:
    angles = []
    for seed in range(20):
        one_disc.reset(seed=seed)
        angles.append(one_disc.base_angle)
    assert all(np.pi / 4 < angle < 3 * np.pi / 4 for angle in angles)
    assert np.ptp(angles) > 1.0
    one_disc.reset(seed=7)
    assert one_disc.base_angle == angles[7]


def test_an_episode_cannot_outlast_its_limit() -> None:
    env = HanoiEnv(1, cameras=False, max_steps=3)
    env.reset(seed=0)
    assert [env.step(np.zeros(7, np.float32))[3] for _ in range(3)] == [False, False, True]
    env.close()


def test_an_action_moves_the_hand_its_way_in_metres(one_disc: HanoiEnv) -> None:
    before = one_disc.reset(seed=0)[0]["low_dim"]
    action = np.array([0, 0.02, 0, 0, 0, 0, -1], np.float32)
    for _ in range(5):
        after = one_disc.step(action)[0]["low_dim"]
    moved = after[:3] - before[:3]
    assert 0.02 < moved[1] < 0.10
    assert np.abs(moved[[0, 2]]).max() < 0.01
    assert after[7] > 0.035  # open


def test_discs_in_the_wrong_place_or_order_are_no_success(watched: HanoiEnv) -> None:
    watched.reset(seed=0)
    assert not watched.is_solved()
    stack(watched, [2, 1, 0])
    assert watched.is_solved()
    stack(watched, [1, 2, 0])
    assert not watched.is_solved()


def stack(env: HanoiEnv, order: list[int]) -> None:
    """Put the discs on the goal peg, first named lowest."""
    x, y = env.scene.peg_xy[env.goal_peg]
    for level, disc in enumerate(order):
        pose = np.array([x, y, 0.8 + (level + 0.5) * 0.014, 1, 0, 0, 0])
        env.scene.sim.data.set_joint_qpos(env.scene.discs[disc].joints[0], pose)
    env.scene.refresh_kinematics()


def test_views_show_the_discs_upright_and_in_their_colours(watched: HanoiEnv) -> None:
    observation, _ = watched.reset(seed=0)
    assert watched.observation_space.contains(observation)
    for view in ("front", "side"):
        image = observation[view].astype(int)
        red, green, blue = (centre_row(image, channel) for channel in range(3))
        assert red < green < blue  # the smallest disc on top, and the top row first


def centre_row(image: np.ndarray[Any, Any], channel: int) -> float:
    """Mean row of the pixels in which one colour channel stands out."""
    others = np.delete(image, channel, axis=2).max(axis=2)
    rows = np.nonzero(image[..., channel] > others + 50)[0]
    assert len(rows) > 15
    return float(rows.mean())


def test_same_state_gives_the_same_pixels(watched: HanoiEnv) -> None:
    first, info = watched.reset(seed=4)
    watched.reset(seed=8)
    second, _ = watched.reset(options={"state": info["state"]})
    assert np.array_equal(first["front"], second["front"])
    assert np.array_equal(first["side"], second["side"])


def test_proprioception_comes_at_twenty_hertz_and_ends_at_the_observation(one_disc: HanoiEnv) -> None:
    _, info = one_disc.reset(seed=0)
    assert [sample.time_s for sample in info["proprioception"]] == [0.0]
    observation, _, _, _, info = one_disc.step(np.zeros(7, np.float32))
    assert np.allclose([sample.time_s for sample in info["proprioception"]], [0.05, 0.1])
    assert np.array_equal(observation["low_dim"][:3], info["proprioception"][-1].ee_position.astype(np.float32))


def test_unusable_options_states_and_actions_are_refused(one_disc: HanoiEnv) -> None:
    with pytest.raises(UsageError, match="1 to 3 discs"):
        HanoiEnv(4)
    with pytest.raises(UsageError, match="n_discs=1"):
        one_disc.reset(options={"state": np.zeros(97)})
    one_disc.reset(seed=0)
    with pytest.raises(ValueError, match="seven finite numbers"):
        one_disc.step(np.full(7, np.nan, np.float32))


def test_gymnasium_knows_the_environments_by_name() -> None:
    register()
    register()
    env = gymnasium.make("vilp/Hanoi-v0", n_discs=1, cameras=False)
    assert isinstance(env.unwrapped, HanoiEnv)
    env.close()


def test_importing_the_package_needs_no_simulator() -> None:
    code = "import sys, vilp_data.sims, vilp_data.sims.record; sys.exit('robosuite' in sys.modules or 'gymnasium' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", code], check=False, env={**os.environ, "PYTHONPATH": ""}).returncode == 0
    )


@pytest.mark.slow
def test_expert_solves_nine_of_ten_towers() -> None:
    env = HanoiEnv(3, cameras=False)
    solved = [demonstrate(env, seed)[2]["is_success"] for seed in range(20)]
    env.close()
    assert sum(solved) >= 18


@pytest.mark.slow
def test_a_whole_tower_replays_bit_for_bit_in_a_fresh_environment() -> None:
    actions, states, info = demonstrate(HanoiEnv(3, cameras=False), seed=0)
    assert info["is_success"]
    env = HanoiEnv(3, cameras=False)
    env.reset(options={"state": states[0]})
    for action, expected in zip(actions, states[1:], strict=True):
        assert np.array_equal(env.step(action)[4]["state"], expected)
