"""The off-by-one detector: actions shifted by s are found to be, others are left alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.faulty_logs import robot
from tests.followers import follower
from tests.pusht_human import human_episode
from vilp_data.check.action import action_findings
from vilp_data.check.action_fit import SHIFTS, Trajectory, fit_action
from vilp_data.check.text import said_of


def trajectories(
    shift: int, *, seed: int = 0, n: int = 200, episodes: int = 2, follow: float = 0.6
) -> list[Trajectory]:
    """Demonstrations whose actions are stored `shift` steps late."""
    found = []
    for number in range(episodes):
        state, action = robot(n + 10, seed * 100 + number, follow=follow)
        late = np.roll(action, shift, axis=0)
        found.append(Trajectory(f"e{number}", state[5:-5], late[5:-5], np.ones(n, np.bool_)))
    return found


@settings(max_examples=15)
@given(st.sampled_from(SHIFTS), st.integers(0, 1000), st.floats(0.2, 1.0))
def test_actions_shifted_by_s_are_found_as_s(shift: int, seed: int, follow: float) -> None:
    fit = fit_action(trajectories(shift, seed=seed, follow=follow))
    assert fit is not None
    assert fit.best == shift
    assert fit.gain[shift] > 0.7
    found = [finding.kind for finding in action_findings(fit, topic="/action", rate_hz=10.0, certain=True)]
    assert found == {1: ["action-late"], 0: [], -1: ["action-early"]}[int(np.sign(shift))]


def test_what_is_said_of_early_actions_does_not_call_one_shift_the_best() -> None:
    """Of slow robots an action alone may explain more the earlier it is; what tells the shift is what later ones add."""
    fit = fit_action(trajectories(-2))
    assert fit is not None
    slow = replace(fit, gain={**fit.gain, -3: 0.9, -2: 0.7})
    (found,) = action_findings(slow, topic="/action", rate_hz=30.0, certain=True)
    assert "best" not in found.what
    assert f"up to that of step k-2: together they explain {slow.up_to[-2]:.0%}" in found.what
    assert "add nothing to the earlier ones" in said_of(slow)


def verdicts(found: list[Trajectory], *, rate_hz: float = 10.0) -> list[tuple[str, str]]:
    fit = fit_action(found)
    assert fit is not None
    return [(f.severity, f.kind) for f in action_findings(fit, topic="/action", rate_hz=rate_hz, certain=True)]


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 30.0])
@pytest.mark.parametrize("lag_s", [0.1, 0.2])
@pytest.mark.parametrize("command_noise", [0.0, 1e-3, 1e-2])
def test_a_robot_that_follows_smooth_commands_is_not_called_late(
    rate_hz: float, lag_s: float, command_noise: float
) -> None:
    found = verdicts(follower(rate_hz=rate_hz, lag_s=lag_s, command_noise=command_noise), rate_hz=rate_hz)
    assert {severity for severity, _ in found} <= {"note"}


@pytest.mark.parametrize("rate_hz", [10.0, 30.0, 50.0])
@pytest.mark.parametrize("recorded_noise", [1e-3, 1e-2, 3e-2])
def test_commands_recorded_with_noise_that_the_robot_never_saw_are_not_called_late(
    rate_hz: float, recorded_noise: float
) -> None:
    """Every command near a step tells a little of the true one, later ones too; so does a state that serves as the action."""
    rng, followed = np.random.default_rng(0), follower(rate_hz=rate_hz, recorded_noise=recorded_noise)
    shifted = [
        replace(
            one, state=one.state[2:-2], valid=one.valid[2:-2],
            action=one.state[3:-1] + rng.normal(0, recorded_noise, one.state[3:-1].shape),
        )
        for one in followed
    ]  # fmt: skip
    for demonstrations in (followed, shifted):
        assert "error" not in {severity for severity, _ in verdicts(demonstrations, rate_hz=rate_hz)}


@pytest.mark.parametrize("late", [1, 2, 3])
def test_smooth_commands_that_are_late_are_found(late: int) -> None:
    assert verdicts(follower(late=late)) == [("error", "action-late")]
    fit = fit_action(follower(late=late))
    assert fit is not None
    assert fit.best == late


def test_commands_too_smooth_to_tell_are_said_to_be_and_not_guessed_at() -> None:
    for late in (0, 1):
        slow = follower(rate_hz=50, lag_s=0.4, segment_s=2, state_noise=1e-3, late=late)
        assert verdicts(slow, rate_hz=50) == [("note", "action-shift-untold")]


def test_a_controller_that_answers_to_noise_is_not_called_late() -> None:
    """Its next command tells what the robot did meanwhile, better than its own command foretold: an effect, no cause."""
    rng, found = np.random.default_rng(0), []
    for number in range(6):
        state, action = np.zeros((200, 2)), np.zeros((200, 2))
        for k in range(199):
            goal = np.array([np.sin((k // 40) * (number + 1)), np.cos(k // 40)])
            action[k] = 0.5 * (goal - state[k])
            state[k + 1] = state[k] + 0.6 * action[k] + rng.normal(0, 0.05, 2)
        found.append(Trajectory(f"e{number}", state[:-1], action[:-1], np.ones(199, np.bool_)))
    assert verdicts(found) == []


def test_the_finding_says_both_numbers_and_an_offset_that_undoes_it() -> None:
    fit = fit_action(trajectories(1))
    assert fit is not None
    (found,) = action_findings(fit, topic="/action", rate_hz=10.0, certain=True)
    assert found.severity == "error"
    assert "the action is stored one step late" in found.what
    assert f"{fit.gain[1]:.0%}" in found.what
    assert f"{max(fit.gain[0], 0):.0%}" in found.what
    assert "offset_s = -0.1 " in str(found.remedy)


def test_where_topics_were_guessed_it_is_no_error() -> None:
    fit = fit_action(trajectories(2))
    assert fit is not None
    (found,) = action_findings(fit, topic="/action", rate_hz=10.0, certain=False)
    assert found.severity == "warning"


@settings(max_examples=5)
@given(st.integers(0, 1000))
def test_an_action_that_drives_nothing_is_said_to(seed: int) -> None:
    moving = [
        Trajectory(s.name, s.state, np.random.default_rng([seed, i]).standard_normal(s.action.shape), s.valid)
        for i, s in enumerate(trajectories(0, seed=seed))
    ]
    fit = fit_action(moving)
    assert fit is not None
    (found,) = action_findings(fit, topic="/action", rate_hz=10.0, certain=True)
    assert found.kind == "action-says-nothing"


def test_one_episode_unlike_the_others_is_named() -> None:
    several = trajectories(0, episodes=8)
    several[5] = Trajectory("odd", several[5].state, np.roll(several[5].action, 1, axis=0), several[5].valid)
    fit = fit_action(several)
    assert fit is not None
    (found,) = action_findings(fit, topic="/action", rate_hz=10.0, certain=True)
    assert (found.kind, found.place.episode) == ("action-odd-episode", "odd")


def test_where_most_episodes_are_odd_none_is() -> None:
    several = trajectories(0, episodes=8)
    mixed = [replace(one, action=np.roll(one.action, number % 2, axis=0)) for number, one in enumerate(several)]
    fit = fit_action(mixed)
    assert fit is not None
    assert fit.odd == ()


def test_too_few_steps_give_no_fit() -> None:
    assert fit_action(trajectories(0, n=40, episodes=1)) is None
    assert fit_action([]) is None


def test_a_state_that_never_changes_gives_no_fit() -> None:
    still = Trajectory(
        "e", np.ones((400, 3)), np.random.default_rng(0).standard_normal((400, 2)), np.ones(400, np.bool_)
    )
    assert fit_action([still]) is None


def test_invalid_and_nan_steps_are_left_out() -> None:
    (one,) = trajectories(0, episodes=1, n=400)
    one.valid[100:120] = False
    one.state[100:120] = 1e9
    one.action[200] = np.nan
    fit = fit_action([one])
    assert fit is not None
    assert fit.best == 0
    assert fit.n_steps == 400 - 6 - 26 - 7


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 30.0, 50.0])
@pytest.mark.parametrize("state_noise", [0.0, 1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.05, 0.12])
def test_no_follower_is_called_late_and_none_that_is_late_is_moved_the_wrong_way(
    rate_hz: float, state_noise: float, delay_s: float
) -> None:
    cases = list(product((0.05, 0.1, 0.2, 0.4), (1, 2), (0.0, 1e-3, 1e-2, 5e-2), (False, True)))
    for number, (lag_s, segment_s, command_noise, second_order) in enumerate(cases[round(rate_hz / 10) % 5 :: 5]):
        for late in (-1, 0, 1, 2):
            fit = fit_action(
                follower(
                    rate_hz=rate_hz, state_noise=state_noise, delay_s=delay_s, lag_s=lag_s, segment_s=segment_s, late=late,
                    recorded_noise=(0.0, 1e-3, 1e-2, 3e-2)[number % 4],
                    command_noise=command_noise, second_order=second_order, seed=number, episodes=4,
                )
            )  # fmt: skip
            assert fit is not None
            if fit.is_late:
                assert late > 0
                assert fit.best <= late  # an offset too small leaves it better than it was
            if late <= 0:
                assert not [name for name, shift, _, _ in fit.odd if shift > 0]


@pytest.mark.slow
@pytest.mark.parametrize("shift", SHIFTS)
def test_human_demonstrations_are_right_as_recorded_and_found_when_shifted(shift: int) -> None:
    found = []
    for number in range(30):
        episode = human_episode(number)
        assert episode.action is not None
        action = np.roll(episode.action.astype(np.float64), shift, axis=0)
        found.append(Trajectory(episode.id, episode.low_dim.astype(np.float64), action, episode.valid))
    fit = fit_action(found)
    assert fit is not None
    assert fit.best == shift
    assert fit.gain[shift] > 0.8
