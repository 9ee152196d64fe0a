"""Vectors judged: motion is left alone; NaN, stuck and saturated columns and idle ends are found where they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vilp_data.check.findings import Finding
from vilp_data.check.motion import (
    Series,
    idle_ends,
    idle_findings,
    moved_between,
    series_findings,
)
from vilp_data.idle import IDLE_S, moving_columns

NAMES = ("position.a", "position.b", "position.c")


def motion(n: int = 600, seed: int = 0, rate_hz: float = 20.0, *, command: bool = False) -> Series:
    """Three joints that swing, with a sensor's noise."""
    rng = np.random.default_rng(seed)
    at_s = np.arange(n) / rate_hz
    phase = rng.uniform(0, 6, 3)
    values = np.sin(at_s[:, None] * (0.7, 1.1, 1.6) + phase) + 1e-4 * rng.standard_normal((n, 3))
    return Series("/joints", NAMES, at_s, values, command)


def judged(series: Series, **options: Series) -> list[Finding]:
    return list(series_findings(series, **options))


@settings(max_examples=40)
@given(st.integers(0, 600), st.integers(0, 999), st.booleans())
def test_motion_gives_no_finding(n: int, seed: int, command: bool) -> None:
    assert judged(motion(n, seed, command=command)) == []


@settings(max_examples=40)
@given(st.integers(0, 2), st.integers(1, 400), st.integers(1, 60), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_values_that_are_no_numbers_are_found(column: int, first: int, n: int, value: float) -> None:
    series = motion()
    series.values[first : first + n, column] = value
    (found,) = judged(series)
    assert (found.kind, found.severity, found.evidence["n_messages"]) == ("nan", "warning", n)
    assert NAMES[column] in found.what
    assert found.place.start_s == first / 20


def test_a_column_that_is_never_filled_in_is_a_note_and_a_topic_of_them_an_error() -> None:
    series = motion()
    series.values[:, 1] = np.nan
    assert [(f.kind, f.severity) for f in judged(series)] == [("nan-throughout", "note")]
    series.values[:] = np.nan
    assert [f.severity for f in judged(series)] == ["error"]


@settings(max_examples=30)
@given(st.integers(50, 400), st.integers(30, 140))
def test_a_source_that_repeats_itself_is_found_at_its_place(first: int, n: int) -> None:
    series = motion()
    series.values[first : first + n] = series.values[first]
    found = [f for f in judged(series) if f.kind == "stuck"]
    assert [(f.place.start_s, f.place.end_s) for f in found] == [(first / 20, (first + n - 1) / 20)]


def test_a_robot_at_rest_at_the_end_is_not_stuck_unless_it_is_told_to_move() -> None:
    series = motion()
    series.values[400:] = series.values[400]
    assert judged(series) == []
    assert [f.kind for f in judged(series, busy=motion(seed=5, command=True))] == ["stuck"]


@settings(max_examples=30)
@given(st.integers(0, 2), st.integers(20, 300), st.integers(150, 250))
def test_one_joint_that_stops_among_moving_ones_is_found(column: int, first: int, n: int) -> None:
    series = motion()
    series.values[first : first + n, column] = series.values[first, column]
    (found,) = judged(series)
    assert found.kind == "stuck-joint"
    assert NAMES[column] in found.what
    assert found.place.start_s == first / 20


def test_bodies_that_nothing_touches_are_not_stuck() -> None:
    series = motion()
    for column in (1, 2):
        series.values[100:400, column] = series.values[100, column]
    assert judged(series) == []


@pytest.mark.parametrize("digits", [1, 2])
def test_a_coarse_encoder_is_neither_stuck_nor_saturated(digits: int) -> None:
    series = motion()
    assert judged(Series("/joints", NAMES, series.at_s, np.round(series.values, digits))) == []


@settings(max_examples=30)
@given(st.floats(0.5, 0.9), st.sampled_from([-1, 1]), st.booleans())
def test_clipped_values_are_found_with_their_limit(limit: float, side: int, command: bool) -> None:
    series = motion(command=command)
    series.values[:, 0] = (
        np.minimum(series.values[:, 0], limit) if side > 0 else np.maximum(series.values[:, 0], -limit)
    )
    (found,) = judged(series)
    assert (found.kind, found.severity) == ("saturated", "note")
    assert found.evidence["value"] == pytest.approx(side * limit)


def test_a_gripper_that_opens_and_closes_is_not_saturated() -> None:
    series = motion(command=True)
    series.values[:, 2] = np.sign(series.values[:, 2])
    assert judged(series) == []


@settings(max_examples=40)
@given(st.floats(0, 8), st.floats(0, 8), st.integers(0, 99))
def test_idle_ends_are_measured(start_s: float, end_s: float, seed: int) -> None:
    series = motion(900, seed)
    first, last = round(start_s * 20), 900 - round(end_s * 20)
    rng = np.random.default_rng(seed)
    series.values[:first] = series.values[first] + 1e-4 * rng.standard_normal((first, 3))
    series.values[last:] = series.values[last - 1] + 1e-4 * rng.standard_normal((900 - last, 3))
    found = idle_ends(series.values, series.at_s)
    assert found is not None
    assert abs(found[0] - start_s) < 0.3
    assert abs(found[1] - end_s) < 0.3
    notes = list(idle_findings((start_s, end_s), 45.0, None))
    assert bool(notes) == (max(start_s, end_s) >= IDLE_S)


def test_noise_alone_is_no_motion() -> None:
    at_s = np.arange(300) / 20
    noise = np.random.default_rng(0).standard_normal((300, 3))
    assert not moving_columns(noise).any()
    assert idle_ends(noise, at_s) is None
    assert not moved_between(Series("/joints", NAMES, at_s, noise), 0, 10)


def test_motion_is_seen_where_it_is() -> None:
    series = motion()
    series.values[200:300] = series.values[200]
    assert moved_between(series, 0, 5)
    assert not moved_between(series, 10.1, 14.9)
