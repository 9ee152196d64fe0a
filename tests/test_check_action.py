"""The off-by-one detector: actions shifted by s are found to be, others are left alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.faulty_logs import robot
from tests.pusht_human import human_episode
from vilp_data.check.action import SHIFTS, Stretch, action_findings, fit_action


def stretches(shift: int, *, seed: int = 0, n: int = 200, episodes: int = 2, follow: float = 0.6) -> list[Stretch]:
    """Demonstrations whose actions are stored `shift` steps late."""
    found = []
    for number in range(episodes):
        state, action = robot(n + 10, seed * 100 + number, follow=follow)
        late = np.roll(action, shift, axis=0)
        found.append(Stretch(f"e{number}", state[5:-5], late[5:-5], np.ones(n, np.bool_)))
    return found


@settings(max_examples=15)
@given(st.sampled_from(SHIFTS), st.integers(0, 1000), st.floats(0.2, 1.0))
def test_actions_shifted_by_s_are_found_as_s(shift: int, seed: int, follow: float) -> None:
    fit = fit_action(stretches(shift, seed=seed, follow=follow))
    assert fit is not None
    assert fit.best == shift
    assert fit.gain[shift] > 0.7
    found = [finding.kind for finding in action_findings(fit, topic="/action", rate_hz=10.0, certain=True)]
    assert found == {1: ["action-late"], 0: [], -1: ["action-early"]}[int(np.sign(shift))]


def test_the_finding_says_both_numbers_and_an_offset_that_undoes_it() -> None:
    fit = fit_action(stretches(1))
    assert fit is not None
    (found,) = action_findings(fit, topic="/action", rate_hz=10.0, certain=True)
    assert found.severity == "error"
    assert "the action fits best one step late" in found.what
    assert f"{fit.gain[1]:.0%}" in found.what
    assert f"{max(fit.gain[0], 0):.0%}" in found.what
    assert "offset_s = -0.1 " in str(found.remedy)


def test_where_topics_were_guessed_it_is_no_error() -> None:
    fit = fit_action(stretches(2))
    assert fit is not None
    (found,) = action_findings(fit, topic="/action", rate_hz=10.0, certain=False)
    assert found.severity == "warning"


@settings(max_examples=5)
@given(st.integers(0, 1000))
def test_an_action_that_drives_nothing_is_said_to(seed: int) -> None:
    moving = [
        Stretch(s.name, s.state, np.random.default_rng([seed, i]).standard_normal(s.action.shape), s.valid)
        for i, s in enumerate(stretches(0, seed=seed))
    ]
    fit = fit_action(moving)
    assert fit is not None
    (found,) = action_findings(fit, topic="/action", rate_hz=10.0, certain=True)
    assert found.kind == "action-says-nothing"


def test_one_episode_unlike_the_others_is_named() -> None:
    several = stretches(0, episodes=8)
    several[5] = Stretch("odd", several[5].state, np.roll(several[5].action, 1, axis=0), several[5].valid)
    fit = fit_action(several)
    assert fit is not None
    (found,) = action_findings(fit, topic="/action", rate_hz=10.0, certain=True)
    assert (found.kind, found.place.episode) == ("action-odd-episode", "odd")


def test_too_few_steps_give_no_fit() -> None:
    assert fit_action(stretches(0, n=40, episodes=1)) is None
    assert fit_action([]) is None


def test_a_state_that_never_changes_gives_no_fit() -> None:
    still = Stretch("e", np.ones((400, 3)), np.random.default_rng(0).standard_normal((400, 2)), np.ones(400, np.bool_))
    assert fit_action([still]) is None


def test_invalid_and_nan_steps_are_left_out() -> None:
    (one,) = stretches(0, episodes=1, n=400)
    one.valid[100:120] = False
    one.state[100:120] = 1e9
    one.action[200] = np.nan
    fit = fit_action([one])
    assert fit is not None
    assert fit.best == 0
    assert fit.n_steps == 400 - 6 - 26 - 7


@pytest.mark.slow
@pytest.mark.parametrize("shift", SHIFTS)
def test_human_demonstrations_are_right_as_recorded_and_found_when_shifted(shift: int) -> None:
    found = []
    for number in range(30):
        episode = human_episode(number)
        assert episode.action is not None
        action = np.roll(episode.action.astype(np.float64), shift, axis=0)
        found.append(Stretch(episode.id, episode.low_dim.astype(np.float64), action, episode.valid))
    fit = fit_action(found)
    assert fit is not None
    assert fit.best == shift
    assert fit.gain[shift] > 0.8
