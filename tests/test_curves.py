"""Curves of a page: where lines break, and what is left of single points."""

from __future__ import annotations

import re

import numpy as np

from vilp_data.viewer.curves import MOST_MARKS, Line, curve


def paths(drawn: str, kind: str) -> list[str]:
    return re.findall(rf'<path class="{kind}" d="([^"]*)"/>', drawn)


def test_a_line_breaks_where_it_is_told_to_and_where_nothing_is_known() -> None:
    at, values = np.linspace(0, 1, 5), np.array([0.0, 1.0, np.nan, 1.0, 0.0])
    (path,) = paths(curve("x", [Line("made", at, values, frozenset({0, 1}))], np.empty(0), digits=1), "made")
    assert path == "M-3.0 112.0h6M247.0 8.0h6M750.0 8.0L1000.0 112.0"  # single points are dashes


def test_the_scale_is_that_of_all_lines_together() -> None:
    lines = [Line("a", np.array([0.0, 1.0]), np.array([2.0, 3.0])), Line("b", np.array([0.5]), np.array([-1.25]))]
    assert "-1.25 to 3.00" in curve("x", lines, np.empty(0), digits=2)


def test_a_constant_and_an_empty_line_have_a_scale_too() -> None:
    assert "6.5 to 7.5" in curve("x", [Line("a", np.array([0.0]), np.array([7.0]))], np.empty(0), digits=1)
    assert "0.0 to 1.0" in curve("x", [Line("a", np.array([0.0]), np.array([np.nan]))], np.empty(0), digits=1)


def test_a_line_of_which_nothing_is_known_is_not_drawn() -> None:
    unknown = Line("a", np.array([0.0, 1.0]), np.array([np.nan, np.nan]), frozenset({0}))
    assert paths(curve("x", [unknown], np.empty(0), digits=1), "a") == [""]


def test_marks_that_would_be_one_band_are_left_out() -> None:
    line = Line("a", np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    for count, drawn in ((3, 1), (MOST_MARKS, 1), (MOST_MARKS + 1, 0)):
        assert len(paths(curve("x", [line], np.linspace(0, 1, count), digits=1), "mark")) == drawn


def test_names_are_escaped() -> None:
    assert "<b>" not in curve("<b>", [Line("a", np.array([0.0]), np.array([1.0]))], np.empty(0), digits=1)
