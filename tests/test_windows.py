"""Window arithmetic, against a reference that walks every step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_data import windows

validity = st.lists(st.booleans(), min_size=1, max_size=60).map(np.array)
mostly_valid = st.lists(st.sampled_from([True] * 9 + [False]), min_size=1, max_size=60).map(np.array)
counts = st.integers(1, 6)


def listed(runs: np.ndarray) -> list[int]:
    return [step for first, end in runs.tolist() for step in range(first, end)]


def slow_plan_windows(valid: np.ndarray, n: int, stride: int, max_goal: int) -> list[int]:
    last, starts = len(valid) - 1, []
    for t in range(len(valid)):
        repeats = sum(t + i * stride > last for i in range(1, n + 1))
        if repeats <= max_goal and all(valid[k] for k in range(t, min(t + n * stride, last) + 1)):
            starts.append(t)
    return starts


@given(validity | mostly_valid, counts, counts, st.integers(0, 8))
def test_plan_windows_are_those_of_the_reference(valid: np.ndarray, n: int, stride: int, max_goal: int) -> None:
    runs = windows.valid_runs(valid)
    starts = windows.plan_windows(runs, len(valid), n_plan_frames=n, frame_stride=stride, max_goal_frames=max_goal)
    assert listed(starts) == slow_plan_windows(valid, n, stride, max_goal)


@given(validity | mostly_valid, counts)
def test_pairs_never_cross_the_end_or_an_invalid_step(valid: np.ndarray, stride: int) -> None:
    pairs = listed(windows.pair_windows(windows.valid_runs(valid), frame_stride=stride))
    expected = [k for k in range(len(valid) - stride) if valid[k : k + stride + 1].all()]
    assert pairs == expected


@given(validity)
def test_runs_are_the_valid_steps(valid: np.ndarray) -> None:
    runs = windows.valid_runs(valid)
    assert listed(runs) == np.flatnonzero(valid).tolist()
    assert (runs[1:, 0] > runs[:-1, 1]).all()


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(1, 40)), min_size=1, max_size=8), counts, counts)
def test_steps_are_held_at_the_end_and_masked(places: list[tuple[int, int]], n: int, stride: int) -> None:
    start = np.array([t % length for t, length in places])
    n_steps = np.array([length for _, length in places])
    planned, frame_mask = windows.plan_steps(start, n_steps, n_plan_frames=n, frame_stride=stride)
    acted, action_mask = windows.action_steps(start, n_steps, n_plan_frames=n, frame_stride=stride)
    for row, (t, length) in enumerate(zip(start.tolist(), n_steps.tolist(), strict=True)):
        frames = [t + i * stride for i in range(1, n + 1)]
        actions = list(range(t, t + n * stride))
        assert planned[row].tolist() == [min(k, length - 1) for k in frames]
        assert frame_mask[row].tolist() == [k < length for k in frames]
        assert acted[row].tolist() == [min(k, length - 1) for k in actions]
        assert action_mask[row].tolist() == [k < length for k in actions]


def test_a_pair_reads_its_goal_and_the_actions_between() -> None:
    goal, actions = windows.pair_steps(np.array([0, 7]), frame_stride=3)
    assert goal.tolist() == [3, 10]
    assert actions.tolist() == [[0, 1, 2], [7, 8, 9]]


@given(st.lists(mostly_valid, max_size=8), counts, counts)
def test_numbers_count_through_all_windows_in_order(episodes: list[np.ndarray], n: int, stride: int) -> None:
    starts = [
        windows.plan_windows(
            windows.valid_runs(valid), len(valid), n_plan_frames=n, frame_stride=stride, max_goal_frames=n
        )
        for valid in episodes
    ]
    episode = np.repeat(np.arange(len(episodes)), [len(runs) for runs in starts])
    index = windows.WindowIndex.of(episode, np.concatenate([np.empty((0, 2), np.int64), *starts]))
    expected = [(place, step) for place, runs in enumerate(starts) for step in listed(runs)]
    assert len(index) == len(expected)
    episode, step = index.locate(np.arange(len(index)))
    assert list(zip(episode.tolist(), step.tolist(), strict=True)) == expected


def test_a_number_outside_is_an_index_error() -> None:
    index = windows.WindowIndex.of(np.array([0, 1]), np.array([[0, 5], [0, 3]]))
    for number in (-1, 8):
        with pytest.raises(IndexError, match="0 to 7"):
            index.locate(np.array([number]))


def test_index_holds_one_row_an_episode_however_long() -> None:
    index = windows.WindowIndex.of(np.arange(3), np.array([[0, 10**9]] * 3))
    assert len(index) == 3 * 10**9
    assert index.first.nbytes + index.end.nbytes + index.episode.nbytes == 3 * 3 * 8
