"""Plots keep every value at its place, whatever series come and go; parts of a stored vector add up to it."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vilp_data.plots import Plot, frame_psnr, panel_rank
from vilp_data.types import U8

VALUES = st.dictionaries(st.sampled_from("abcde"), st.floats(-1e6, 1e6), max_size=5)
FRAMES = hnp.arrays(np.uint8, (2, 3, 4, 3))


@given(rows=st.lists(VALUES, min_size=1, max_size=8))
def test_every_value_lies_in_its_series_at_its_time_and_nothing_else_does(rows: list[dict[str, float]]) -> None:
    plot = Plot("title", "entity")
    for time_ns, values in enumerate(rows):
        plot.add(time_ns, values)
    assert plot.times_ns == list(range(len(rows)))
    assert sorted(plot.names) == sorted(set().union(*rows))
    for row, values in zip(plot.table(), rows, strict=True):
        shown = {name: value for name, value in zip(plot.names, row.tolist(), strict=True) if not np.isnan(value)}
        assert shown == values


@given(real=FRAMES, rebuilt=FRAMES)
def test_psnr_of_a_frame_is_that_of_the_formula_and_the_same_both_ways(real: U8, rebuilt: U8) -> None:
    errors = [float(np.mean((a.astype(float) - b.astype(float)) ** 2)) for a, b in zip(real, rebuilt, strict=True)]
    expected = [20 * np.log10(255) - 10 * np.log10(error) if error else np.nan for error in errors]
    np.testing.assert_allclose(frame_psnr(real, rebuilt), expected, rtol=1e-5)
    np.testing.assert_array_equal(frame_psnr(real, rebuilt), frame_psnr(rebuilt, real))


@given(topics=st.lists(st.text("acdeginopst/_", max_size=12), max_size=6), command=st.text("abc/", max_size=6))
def test_what_the_task_calls_an_action_comes_before_everything_else(topics: list[str], command: str) -> None:
    ranked = sorted({*topics, command}, key=lambda topic: panel_rank(topic, {command}))
    assert ranked[0] == command
