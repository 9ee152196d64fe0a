"""Replay: actions played through the simulator give the recorded states back, and one step off does not."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from tests.pusht_human import N_EPISODES, human_episode, simulator
from vilp_data.errors import UsageError
from vilp_data.task_toml import parse_task
from vilp_data.types import Episode
from vilp_models.replay import format_replay, format_replays, replay
from vilp_models.simulator import make_env

TOLERANCE_PX = 1e-3


class Integrator:
    """A simulator whose state is the sum of its actions, an angle, and its seed."""

    metadata = {"state_periods": (np.inf, 2 * np.pi, np.inf)}  # noqa: RUF012

    def reset(self, *, seed=None, options):
        self.state = np.array(options["state"])
        self.state[2] = -1.0 if seed is None else seed
        return {}, {"state": self.state}

    def step(self, action):
        self.state = self.state + np.array([action[0], action[0], 0])
        return {}, 0.0, True, False, {"state": self.state}


@pytest.fixture
def integrated() -> Episode:
    """An episode that `Integrator` replays exactly, its angle stored in [0, 2 pi)."""
    total = np.array([0.0, 1.0, 3.0, 7.0])
    return Episode(
        id="integrated",
        frames={},
        source_index={},
        log_time_ns=np.arange(4),
        low_dim=np.zeros((4, 0), np.float32),
        action=np.array([[1.0], [2.0], [4.0], [8.0]], np.float32),
        state=np.stack([total, total % (2 * np.pi), np.full(4, 5.0)], axis=1),
        valid=np.ones(4, np.bool_),
        age_s={},
        rate_hz=10.0,
        tags={"seed": "5"},
        outcome="unknown",
    )


def test_replay_gives_states_back_with_the_tagged_seed_and_angles_that_wrap(integrated):
    report = replay(integrated, Integrator())
    assert report.n_steps == 3
    assert report.error.max_abs == pytest.approx((0, 0, 0), abs=1e-12)
    assert report.shifted.max_abs[0] == pytest.approx(7)  # 2 + 4 + 8 against 1 + 2 + 4
    assert report.proves(1e-9)
    assert not report.proves(10.0)  # a tolerance that one step off would meet proves nothing


def test_a_seed_that_is_none_is_not_handed_to_the_simulator(integrated):
    named = replace(integrated, tags={"seed": "blue"}, state=integrated.state * [1, 1, 0] - [0, 0, 1])
    assert replay(named, Integrator()).proves(1e-9)


def test_an_episode_that_cannot_show_a_shift_neither_proves_nor_fails(integrated):
    """One step whose next action is the same: played a step early it is the same step."""
    short = replace(integrated, action=np.ones((2, 1), np.float32), state=integrated.state[:2])
    report = replay(short, Integrator())
    assert not report.proves(1e-6)
    assert not report.fails(1e-6)
    [line] = [line for line in format_replay(report, tolerance=1e-6) if "replayed" in line]
    assert "1 step replayed" in line
    assert "(within 1e-06, but too alike to tell a step's shift)" in line
    wrong = replay(replace(short, state=short.state * [[1.0], [2.0]]), Integrator())
    assert wrong.fails(1e-6)
    assert "NOT within 1e-06" in format_replay(wrong, tolerance=1e-6)[0]


def test_replay_reports_progress_through_both_plays(integrated):
    told = []
    replay(integrated, Integrator(), progress=lambda done, total: told.append((done, total)))
    assert told == [(done, 6) for done in range(1, 7)]


def test_replay_refuses_what_it_cannot_play(integrated):
    for broken, message in [
        (replace(integrated, action=None), "no actions"),
        (replace(integrated, state=None), "no simulator states"),
        (replace(integrated, action=np.full((4, 1), np.nan, np.float32)), "step 0"),
    ]:
        with pytest.raises(UsageError, match=message):
            replay(broken, Integrator())


def test_replay_refuses_a_simulator_with_another_state(integrated):
    class Longer(Integrator):
        metadata = {}  # noqa: RUF012

        def step(self, action):
            return {}, 0.0, False, False, {"state": np.zeros(7)}

    with pytest.raises(UsageError, match="7 values, recorded 3"):
        replay(integrated, Longer())


class Judged(Integrator):
    """Succeeds where the sum is 3, and goes on."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, {**info, "is_success": self.state[0] == 3}


def test_replay_says_whether_an_episode_ends_as_recorded(integrated):
    won, lost = (replace(integrated, outcome=outcome) for outcome in ("success", "failure"))
    assert replay(integrated, Integrator()).success is None
    assert replay(replace(won, action=won.action + 1), Judged()).success is False
    reports = [replay(episode, Judged()) for episode in (won, lost, integrated)]
    assert [report.success for report in reports] == [True, True, True]
    line = format_replays(reports, [True, True, False])
    assert line == "2 of 3 episodes replay as recorded; 1 of 2 end as recorded (1 in success)"
    assert format_replays([replay(won, Integrator())], [True]) == "1 of 1 episodes replay as recorded"


class Plain(gymnasium.Env):
    """A user's simulator that knows nothing of cameras."""

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain
        self.observation_space = self.action_space = gymnasium.spaces.Box(-1, 1, (1,))


class WithCameras(Plain):
    def __init__(self, gain: float = 1.0, cameras: bool = True) -> None:
        super().__init__(gain)
        self.cameras = cameras


@pytest.fixture
def task():
    """A task of a given simulator, which is registered for the length of a test."""

    def of(entry_point, options=""):
        gymnasium.registry.pop("test/Own-v0", None)
        gymnasium.register("test/Own-v0", entry_point=entry_point, disable_env_checker=True)
        text = (
            f'name = "own"\n[views.top]\ntopic = "/top"\nheight = 8\nwidth = 8\n[sim]\nenv = "test/Own-v0"\n{options}'
        )
        return parse_task(text, where="test")

    yield of
    gymnasium.registry.pop("test/Own-v0", None)


def test_a_users_simulator_is_made_with_its_options_and_told_of_cameras_only_to_leave_them_out(task):
    assert make_env(task(Plain, "options = { gain = 2.0 }")).unwrapped.gain == 2.0
    assert make_env(task(WithCameras)).unwrapped.cameras
    assert not make_env(task(WithCameras), cameras=False).unwrapped.cameras


@pytest.mark.parametrize(
    ("options", "cameras", "says"), [("", False, "cameras"), ("options = { gian = 2.0 }", True, "gian")]
)
def test_a_simulator_that_does_not_take_its_options_is_told_the_contract(task, options, cameras, says):
    with pytest.raises(
        UsageError, match=rf"test/Own-v0: the simulator does not take these options(.|\n)*{says}(.|\n)*must take"
    ):
        make_env(task(Plain, options), cameras=cameras)


@pytest.mark.sim
@pytest.mark.parametrize("number", [0, 30, 60, 205])
def test_human_actions_give_the_recorded_agent_back(number):
    report = replay(human_episode(number), simulator())
    assert report.error.worst(report.controlled) < TOLERANCE_PX
    assert report.shifted.worst(report.controlled) > 10
    assert report.proves(TOLERANCE_PX)
    assert "within 0.001" in format_replay(report, tolerance=TOLERANCE_PX)[0]


@pytest.mark.sim
def test_human_actions_give_the_whole_scene_back_where_contacts_are_benign():
    report = replay(human_episode(0), simulator())
    assert max(report.error.max_abs) < TOLERANCE_PX


@pytest.mark.sim
@pytest.mark.parametrize("shift", [-1, 1])
def test_actions_stored_one_step_off_fail_the_proof(shift):
    episode = human_episode(0)
    report = replay(replace(episode, action=np.roll(episode.action, shift, axis=0)), simulator())
    assert not report.proves(TOLERANCE_PX)
    assert report.error.worst(report.controlled) > 10
    assert "NOT within" in format_replay(report, tolerance=TOLERANCE_PX)[0]


@pytest.mark.sim
@pytest.mark.slow
def test_every_human_episode_replays():
    env = simulator()
    reports = [replay(human_episode(number), env) for number in range(N_EPISODES)]
    block = np.array([report.error.worst((2, 3)) for report in reports])
    print(f"agent: at most {max(report.error.worst((0, 1)) for report in reports):.2g} px")
    print(f"one step early: at least {min(report.shifted.worst((0, 1)) for report in reports):.2g} px")
    print(
        f"block: {np.mean(block < TOLERANCE_PX):.0%} of episodes within {TOLERANCE_PX:g} px, worst {block.max():.2g} px"
    )
    assert all(report.proves(TOLERANCE_PX) for report in reports)
    assert np.mean(block < TOLERANCE_PX) > 0.7
