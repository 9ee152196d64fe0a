"""What every robosuite task keeps to: states, seeds, actions, views and proprioception of one arm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from vilp_data.types import F32, F64

pytestmark = pytest.mark.sim

gymnasium = pytest.importorskip("gymnasium", reason="the simulators are not installed (make setup)")
pytest.importorskip("robosuite", reason="the simulators are not installed (make setup)")

from vilp_data.errors import UsageError  # noqa: E402
from vilp_data.sims.arm_env import HAND_DOWN, ArmEnv  # noqa: E402
from vilp_data.sims.arm_scene import ROBOTS  # noqa: E402
from vilp_data.sims.can import CanEnv  # noqa: E402
from vilp_data.sims.can_expert import CanExpert  # noqa: E402
from vilp_data.sims.hanoi import HanoiEnv  # noqa: E402
from vilp_data.sims.hanoi_expert import HanoiExpert  # noqa: E402
from vilp_data.sims.move_the_stack import MoveTheStackEnv  # noqa: E402
from vilp_data.sims.move_the_stack_expert import MoveTheStackExpert  # noqa: E402
from vilp_data.sims.nut_assembly import NutAssemblyEnv  # noqa: E402
from vilp_data.sims.nut_assembly_expert import NutAssemblyExpert  # noqa: E402

TASKS: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    "can": (CanEnv, CanExpert, {}),
    "hanoi": (HanoiEnv, HanoiExpert, {"n_discs": 1}),
    "move_the_stack": (MoveTheStackEnv, MoveTheStackExpert, {}),
    "nut_assembly": (NutAssemblyEnv, NutAssemblyExpert, {}),
}
"""Task -> its environment, its expert, and the options of an environment that is quick."""


@dataclass(frozen=True)
class Demonstration:
    """The expert's first actions of an episode, and the states and low_dims before and after each."""

    actions: list[F32]
    states: list[F64]
    low_dims: list[F32]


@pytest.fixture(scope="module", params=TASKS)
def task(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def blind(task: str) -> Iterator[ArmEnv[Any]]:
    kind, _, options = TASKS[task]
    env = kind(**options, cameras=False)
    yield env
    env.close()


@pytest.fixture(scope="module")
def demonstration(task: str, blind: ArmEnv[Any]) -> Demonstration:
    """Long enough that something is in the gripper in its middle."""
    observation, info = blind.reset(seed=5)
    actions, states, low_dims = [], [info["state"]], [observation["low_dim"]]
    for action in TASKS[task][1](blind).actions():
        observation, *_, info = blind.step(action)
        actions.append(action)
        states.append(info["state"])
        low_dims.append(observation["low_dim"])
        if len(actions) == 40:
            break
    return Demonstration(actions, states, low_dims)


def test_recorded_actions_give_the_recorded_states_back_bit_for_bit(
    blind: ArmEnv[Any], demonstration: Demonstration
) -> None:
    blind.reset(seed=99)  # another episode: everything must come from the state
    blind.reset(options={"state": demonstration.states[0]})
    for action, expected in zip(demonstration.actions, demonstration.states[1:], strict=True):
        assert np.array_equal(blind.step(action)[4]["state"], expected)


def test_an_episode_goes_on_from_a_state_in_its_middle(blind: ArmEnv[Any], demonstration: Demonstration) -> None:
    actions, states = demonstration.actions, demonstration.states
    middle = len(actions) // 2
    observation, info = blind.reset(seed=6, options={"state": states[middle]})
    for step in range(middle, len(actions)):
        assert np.array_equal(info["state"], states[step])
        assert np.array_equal(observation["low_dim"], demonstration.low_dims[step])
        observation, *_, info = blind.step(actions[step])


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_state_is_seen_alike_whatever_seed_it_is_restored_with(task: str, robot: str) -> None:
    kind, _, options = TASKS[task]
    env = kind(**options, robot=robot, cameras=False)
    recorded = [env.reset(seed=seed) for seed in range(1000, 1012)]
    for n, (observation, info) in enumerate(recorded):
        again, _ = env.reset(seed=1000 + (n + 1) % len(recorded), options={"state": info["state"]})
        assert np.array_equal(again["low_dim"], observation["low_dim"])
        assert observation["low_dim"][3:7] @ HAND_DOWN > 0.5  # one pose has not two quaternions
    env.close()


def test_the_hands_quaternion_does_not_jump_however_far_it_turns() -> None:
    env = CanEnv(cameras=False, robot="UR5e")
    quaternions = [env.reset(seed=0)[0]["low_dim"][3:7]]
    for _ in range(25):
        quaternions.append(env.step(np.array([0, 0, 0, 0, 0, 0.5, -1], np.float32))[0]["low_dim"][3:7])
    assert quaternions[-1] @ HAND_DOWN < 0  # more than half a turn
    assert (np.einsum("ki,ki->k", quaternions[1:], quaternions[:-1]) > 0.9).all()
    env.close()


def test_actions_one_step_off_do_not_give_the_states_back(blind: ArmEnv[Any], demonstration: Demonstration) -> None:
    blind.reset(options={"state": demonstration.states[0]})
    joints = slice(1, 1 + len(blind.joint_names))
    reached = [blind.step(action)[4]["state"][joints] for action in demonstration.actions[1:16]]
    errors = [np.abs(a - b[joints]).max() for a, b in zip(reached, demonstration.states[1:], strict=False)]
    assert max(errors) > 0.01  # rad


def test_looking_does_not_change_what_happens(blind: ArmEnv[Any], demonstration: Demonstration) -> None:
    blind.reset(options={"state": demonstration.states[0]})
    for action, expected in zip(demonstration.actions[:15], demonstration.states[1:], strict=False):
        blind.scene.refresh_kinematics()
        blind.is_solved()
        assert np.array_equal(blind.step(action)[4]["state"], expected)


def test_what_is_drawn_between_two_looks_changes_nothing(task: str, demonstration: Demonstration) -> None:
    kind, _, options = TASKS[task]
    env = kind(**options)
    env.reset(options={"state": demonstration.states[0]})
    for step, action in enumerate(demonstration.actions[:6]):
        env.set_drawing(step % 3 == 2)
        observation, *_, info = env.step(action)
        assert np.array_equal(info["state"], demonstration.states[step + 1])
        assert set(observation) == {"low_dim", *(env.views if step % 3 == 2 else ())}
    late = {view: observation[view] for view in env.views}
    env.reset(options={"state": demonstration.states[0]})
    for action in demonstration.actions[:6]:
        observation, *_ = env.step(action)
    assert all(np.array_equal(observation[view], late[view]) for view in env.views)
    env.close()


def test_a_seed_gives_the_same_start_in_any_environment(task: str, blind: ArmEnv[Any]) -> None:
    kind, _, options = TASKS[task]
    another = kind(**options, cameras=False)
    another.reset(seed=0)
    states = [env.reset(seed=7)[1]["state"] for env in (blind, another)]
    assert np.array_equal(*states)
    assert not np.array_equal(blind.reset(seed=8)[1]["state"], states[0])
    another.close()


def test_an_action_moves_the_hand_its_way_in_metres(blind: ArmEnv[Any]) -> None:
    before = blind.reset(seed=0)[0]["low_dim"]
    action = np.array([0, 0.02, 0, 0, 0, 0, -1], np.float32)
    for _ in range(5):
        after = blind.step(action)[0]["low_dim"]
    moved = after[:3] - before[:3]
    assert 0.02 < moved[1] < 0.10
    assert np.abs(moved[[0, 2]]).max() < 0.01
    assert after[7] > 0.035  # open


def test_same_state_gives_the_same_pixels(task: str) -> None:
    kind, _, options = TASKS[task]
    env = kind(**options)
    first, info = env.reset(seed=4)
    env.reset(seed=8)
    second, _ = env.reset(options={"state": info["state"]})
    assert env.observation_space.contains(first)
    assert len(env.views) == 2
    for view in env.views:
        assert first[view].shape == (env.height, env.width, 3)
        assert np.array_equal(first[view], second[view])
        assert first[view].std() > 10
    assert np.array_equal(env.render(), np.concatenate([second[view] for view in env.views], axis=1))
    env.close()


def test_proprioception_comes_at_twenty_hertz_and_ends_at_the_observation(blind: ArmEnv[Any]) -> None:
    _, info = blind.reset(seed=0)
    assert [sample.time_s for sample in info["proprioception"]] == [0.0]
    observation, _, _, _, info = blind.step(np.zeros(7, np.float32))
    assert np.allclose([sample.time_s for sample in info["proprioception"]], [0.05, 0.1])
    assert np.array_equal(observation["low_dim"][:3], info["proprioception"][-1].ee_position.astype(np.float32))


def test_states_and_actions_of_another_shape_are_refused(task: str, blind: ArmEnv[Any]) -> None:
    kind, _, options = TASKS[task]
    with pytest.raises(UsageError, match="options of the recording"):
        blind.reset(options={"state": np.zeros(3)})
    with pytest.raises(UsageError, match="Panda or UR5e"):
        kind(**options, robot="Sawyer", cameras=False)
    blind.reset(seed=0)
    with pytest.raises(ValueError, match="seven finite numbers"):
        blind.step(np.full(7, np.nan, np.float32))
