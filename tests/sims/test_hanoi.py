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


def test_seed_sets_the_base_angle_within_its_range(one_disc: HanoiEnv) -> None:
    angles = []
    for seed in range(20):
        one_disc.reset(seed=seed)
        angles.append(one_disc.base_angle)
    assert all(np.pi / 4 < angle < 3 * np.pi / 4 for angle in angles)
    assert np.ptp(angles) > 1.0
    one_disc.reset(seed=7)
    assert one_disc.base_angle == angles[7]


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


def test_a_number_of_discs_that_it_does_not_have_is_refused() -> None:
    with pytest.raises(UsageError, match="1 to 3 discs"):
        HanoiEnv(4)


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
