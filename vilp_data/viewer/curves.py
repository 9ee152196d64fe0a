"""Curves of a page as inline SVG: lines over one time axis, where plans begin. Pure; colours come from the page's style sheet."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from vilp_data.types import F64

WIDTH, HEIGHT = 1000, 120
MARGIN = 8
LONE = 6
MOST_MARKS = 250
"""More beginnings of plans than this would be one grey band: they are left out."""


class Line(NamedTuple):
    """Values float64 [n] at places float64 [n] in 0 … 1; it breaks where a value is not finite, and before each row of `breaks`."""

    kind: str
    at: F64
    values: F64
    breaks: frozenset[int] = frozenset()


def curve(name: str, lines: Sequence[Line], marks: F64, *, digits: int) -> str:
    """A panel with a name, the ends of its scale, the lines, a mark at each place of `marks`, and a cursor that a script moves."""
    finite = np.concatenate([line.values[np.isfinite(line.values)] for line in lines])
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    drawn = "".join(f'<path class="{line.kind}" d="{_path(line, low, high)}"/>' for line in lines)
    return (
        f'<div class="plot"><span class="name">{escape(name)}</span>'
        f'<span class="range">{low:.{digits}f} to {high:.{digits}f}</span>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" preserveAspectRatio="none" role="img" aria-label="{escape(name)} over time">'
        f'{mark_lines(marks)}{drawn}</svg><i class="cursor"></i></div>'
    )


def mark_lines(marks: F64) -> str:
    """Upright lines at these places."""
    if not 0 < len(marks) <= MOST_MARKS:
        return ""
    path = "".join(f"M{mark * WIDTH:.1f} 0V{HEIGHT}" for mark in marks.tolist())
    return f'<path class="mark" d="{path}"/>'


def _path(line: Line, low: float, high: float) -> str:
    x = line.at * WIDTH
    y = MARGIN + (high - line.values) / (high - low) * (HEIGHT - 2 * MARGIN)
    known = np.isfinite(y)
    begins = known & np.concatenate([[True], ~known[:-1]])
    begins[[row for row in line.breaks if row < len(known) and known[row]]] = True
    pieces = np.split(np.stack([x, y], axis=1)[known], np.flatnonzero(begins[known])[1:])
    return "".join(_piece(piece.tolist()) for piece in pieces if len(piece))


def _piece(points: list[list[float]]) -> str:
    """An unbroken line. A single point, as of a plan of one frame, is a short one."""
    if len(points) == 1:
        ((x, y),) = points
        return f"M{x - LONE / 2:.1f} {y:.1f}h{LONE}"
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
