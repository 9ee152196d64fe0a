"""Move-the-Stack: what the environment promises, that its expert solves it, and that what it records plays back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from vilp_data.types import F32, F64

pytestmark = pytest.mark.sim

pytest.importorskip("gymnasium", reason="the simulators are not installed (make setup)")
pytest.importorskip("robosuite", reason="the simulators are not installed (make setup)")

from vilp_data.assemble import assemble_episode  # noqa: E402
from vilp_data.errors import UsageError  # noqa: E402
from vilp_data.sims.arm_motion import raised  # noqa: E402
from vilp_data.sims.move_the_stack import APART, HANDS, PLACES, MoveTheStackEnv  # noqa: E402
from vilp_data.sims.move_the_stack_expert import MoveTheStackExpert  # noqa: E402
from vilp_data.sims.move_the_stack_scene import BOARD_SIZE, NEST_STEP, TABLE_HEIGHT  # noqa: E402
from vilp_data.sims.record import record_task  # noqa: E402
from vilp_data.sources import open_log  # noqa: E402
from vilp_data.task_toml import load_task  # noqa: E402
from vilp_models.replay import render_match, replay  # noqa: E402

BOARD_TOP = TABLE_HEIGHT + BOARD_SIZE[2]
STAY = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def env() -> Iterator[MoveTheStackEnv]:
    env = MoveTheStackEnv(cameras=False)
    yield env
    env.close()


@pytest.fixture(scope="module")
def watched() -> Iterator[MoveTheStackEnv]:
    env = MoveTheStackEnv()
    yield env
    env.close()


def put(env: MoveTheStackEnv, cup: int, position: F64, quaternion: tuple[float, ...] = UPRIGHT) -> None:
    data, joint = env.scene.sim.data, env.scene.cups[cup].joints[0]
    data.set_joint_qpos(joint, np.array([*position, *quaternion]))
    data.set_joint_qvel(joint, np.zeros(6))
    env.scene.refresh_kinematics()


def put_stack(env: MoveTheStackEnv, foot: F64) -> None:
    for cup in range(env.n_cups):
        put(env, cup, raised(foot, cup * NEST_STEP))


def on_board(env: MoveTheStackEnv, *, along: float = 0.0) -> F64:
    """A place on the board, so many metres from its middle along its side."""
    x, y, turn = env.scene.board_pose
    return np.array([x + along * np.cos(turn), y + along * np.sin(turn), BOARD_TOP])


def lifted(env: MoveTheStackEnv) -> F64:
    """How high each cup is above where it stood at first."""
    return np.array([env.scene.cup_position(cup)[2] - TABLE_HEIGHT - cup * NEST_STEP for cup in range(env.n_cups)])


def demonstrate(env: MoveTheStackEnv, seed: int) -> bool:
    _, info = env.reset(seed=seed)
    for action in MoveTheStackExpert(env, seed=seed).actions():
        *_, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    return bool(info["is_success"])


def test_expert_carries_all_cups_as_one_and_lets_go(env: MoveTheStackEnv) -> None:
    env.reset(seed=3)
    actions: list[F32] = []
    heights = []
    for action in MoveTheStackExpert(env, seed=3).actions():
        *_, terminated, _, info = env.step(action)
        actions.append(action)
        heights.append(lifted(env))
        if terminated:
            break
    assert info["is_success"]
    assert 30 < len(actions) < 80
    assert all(action.dtype == np.float32 and env.action_space.contains(action) for action in actions)
    assert np.max(heights) > 0.03
    assert np.ptp(heights, axis=1).max() < 0.004  # no cup stayed behind, at any time
    assert not env.scene.gripper_touches_cups()


def test_expert_takes_the_stack_again_when_it_is_lost_on_the_way(env: MoveTheStackEnv) -> None:
    env.reset(seed=3)
    home = np.array([*env.scene.stack_pose[:2], TABLE_HEIGHT])
    lost = False
    for action in MoveTheStackExpert(env, seed=3).actions():
        *_, terminated, _, info = env.step(action)
        if not lost and lifted(env).min() > 0.02:
            put_stack(env, home)
            lost = True
        if terminated:
            break
    assert lost
    assert info["is_success"]


def test_expert_gives_up_on_cups_that_are_no_stack_any_more(env: MoveTheStackEnv) -> None:
    env.reset(seed=0)
    put(env, 2, on_board(env))
    assert list(MoveTheStackExpert(env).actions()) == []


def test_styles_are_drawn_from_the_experts_seed_and_told(env: MoveTheStackEnv) -> None:
    env.reset(seed=0)
    told = [MoveTheStackExpert(env, seed=seed).tags() for seed in range(30)]
    assert told[7] == MoveTheStackExpert(env, seed=7).tags()
    assert {tags["style_path"] for tags in told} == {"straight", "left", "right"}
    assert {tags["style_fingers"] for tags in told} == {"0", "1", "2", "3"}
    assert len({tags["style_carry"] for tags in told}) > 20


def test_seed_sets_where_stack_board_and_hand_are(env: MoveTheStackEnv) -> None:
    stacks, boards, hands = [], [], []
    for seed in range(30):
        env.reset(seed=seed)
        assert not env.is_solved()
        np.testing.assert_allclose(env.scene.grip_position(), env.scene.hand_pose[:3], atol=1e-3)
        stacks.append(env.scene.cup_position(0)[:2])
        boards.append(env.scene.board_pose[:2])
        hands.append(env.scene.hand_pose)
    for places in (stacks, boards):
        assert (np.min(places, axis=0) >= PLACES[0]).all()
        assert (np.max(places, axis=0) <= PLACES[1]).all()
        assert (np.ptp(places, axis=0) > 0.15).all()
    assert np.hypot(*(np.array(stacks) - boards).T).min() > APART
    assert (np.ptp(hands, axis=0) > 0.7 * (HANDS[1] - HANDS[0])).all()


def test_a_stack_that_nobody_touches_stands_still(env: MoveTheStackEnv) -> None:
    env.reset(seed=1)
    before = np.array([env.scene.cup_position(cup) for cup in range(env.n_cups)])
    for _ in range(15):
        env.step(STAY)
    after = np.array([env.scene.cup_position(cup) for cup in range(env.n_cups)])
    assert np.abs(after - before).max() < 0.0015
    assert env.is_stacked()


def test_only_a_whole_stack_that_stands_on_the_board_alone_is_a_success(env: MoveTheStackEnv) -> None:
    env.reset(seed=0)
    assert not env.is_solved()
    put_stack(env, on_board(env))
    assert env.is_solved()
    put_stack(env, on_board(env, along=0.04))
    assert env.is_solved()
    put_stack(env, on_board(env, along=0.055))  # its foot reaches over the edge
    assert not env.is_solved()
    put_stack(env, raised(on_board(env), 0.02))  # in the air
    assert not env.is_solved()
    put_stack(env, on_board(env))
    put(env, 2, env.scene.cup_position(1))  # stuck in another
    assert not env.is_solved()
    put_stack(env, on_board(env))
    put(env, 1, on_board(env, along=-0.05))  # beside the others
    assert not env.is_solved()
    put_stack(env, on_board(env))
    put(env, 2, raised(on_board(env), 2 * NEST_STEP), (np.cos(0.1), np.sin(0.1), 0.0, 0.0))  # leans by 11 degrees
    assert not env.is_solved()


def test_a_stack_in_the_gripper_is_no_success_even_on_the_board(env: MoveTheStackEnv) -> None:
    env.reset(seed=3)
    held_there = 0
    for action in MoveTheStackExpert(env, seed=3).actions():
        *_, terminated, _, _ = env.step(action)
        held_there += env.stands_on_board() and env.is_stacked() and not terminated
        if terminated:
            break
    assert held_there > 0


def test_views_show_the_black_board_and_the_cups_upright(watched: MoveTheStackEnv) -> None:
    observation, _ = watched.reset(seed=0)
    x, y, turn = watched.scene.placement()
    for view in ("front", "side"):
        image = observation[view].astype(int)
        assert image.shape == (96, 128, 3)
        assert centre_row(image, 2) < centre_row(image, 0)  # blue above red, and the top row first
        watched.scene.place(np.array([x, y, turn + 1.0]))
        watched.scene.refresh_kinematics()
        turned = np.abs(watched._image(view).astype(int) - image).max(axis=2) > 60
        assert turned.sum() > 50
        watched.scene.place(np.array([x, y, turn]))


def centre_row(image: np.ndarray, channel: int) -> float:
    """Mean row of the pixels in which one colour channel stands out."""
    others = np.delete(image, channel, axis=2).max(axis=2)
    rows = np.nonzero(image[..., channel] > others + 50)[0]
    assert len(rows) > 30
    return float(rows.mean())


def test_a_number_of_cups_that_it_does_not_have_is_refused() -> None:
    with pytest.raises(UsageError, match="2 or 3 cups"):
        MoveTheStackEnv(4)


def test_what_was_recorded_plays_back_and_succeeds(
    tmp_path: Path, env: MoveTheStackEnv, watched: MoveTheStackEnv
) -> None:
    spec = load_task("move_the_stack")
    [one] = record_task(spec, tmp_path, episodes=1, first_seed=3, workers=1)
    assert one.success
    with open_log(one.path) as log:
        episode = assemble_episode(log, log.episodes()[0], spec, episode_id="e")
    assert episode.n_steps == one.n_steps + 1
    assert episode.valid.all()
    assert episode.findings == ()
    assert {"goal": "board", "object": "cups", "success": "true"}.items() <= episode.tags.items()
    assert {"style_fingers", "style_path", "style_carry", "style_step", "board"} <= set(episode.tags)

    assert render_match(episode, watched, every=15).proves()
    assert replay(episode, env).proves(env.metadata["replay_tolerance"])
    env.reset(options={"state": episode.state[0]})
    for action in episode.action[:-1]:
        *_, info = env.step(action)
    assert info["is_success"]


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"n_cups": 2}, {"robot": "UR5e"}])
def test_expert_moves_nine_of_ten_stacks(options) -> None:
    env = MoveTheStackEnv(cameras=False, **options)
    assert sum(demonstrate(env, seed) for seed in range(20)) >= 18
    env.close()
