"""The drawings of a check's page, as inline SVG: a topic along its log, and an action's fit by shift. Pure.

Lines take their colours from the page's style sheet (`class`), so that light and dark need no second drawing.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from vilp_data.check.action_fit import ActionFit
from vilp_data.check.findings import Finding
from vilp_data.types import F64

LANE_WIDTH, LANE_HEIGHT = 720, 44
LOWEST, HIGHEST = 0.5, 50.0
"""The lane's scale, in usual intervals, logarithmic: below one half and above fifty all are the same."""

STEADY_LAG_S = 2e-3
"""A lag that changes by less is told by its median alone."""

FIT_WIDTH, FIT_HEIGHT = 340, 190


def lane(longest_s: F64, usual_s: float, marks: Sequence[Finding], length_s: float) -> str:
    """A topic along its log: the longest interval of each bin float64 [BINS] over the usual one, logarithmic; findings are bands.

    A silence shows as a tower of its own length: the bins that it spans hold nothing, and are filled with it."""
    filled = _filled(longest_s)
    n = len(filled)
    share = np.log(np.clip(filled / usual_s, LOWEST, HIGHEST) / LOWEST) / np.log(HIGHEST / LOWEST)
    height = np.nan_to_num(share) * (LANE_HEIGHT - 4)
    x = np.linspace(0, LANE_WIDTH, n + 1)
    points = " ".join(
        f"{x[i]:.1f},{LANE_HEIGHT - height[i]:.1f} {x[i + 1]:.1f},{LANE_HEIGHT - height[i]:.1f}" for i in range(n)
    )
    usual_y = LANE_HEIGHT - (LANE_HEIGHT - 4) * np.log(1 / LOWEST) / np.log(HIGHEST / LOWEST)
    bands = "".join(_band(mark, length_s) for mark in marks if mark.place.start_s is not None)
    return (
        f'<svg class="lane" viewBox="0 0 {LANE_WIDTH} {LANE_HEIGHT}" preserveAspectRatio="none" role="img"'
        f' aria-label="intervals along the log">'
        f'<polygon class="area" points="0,{LANE_HEIGHT} {points} {LANE_WIDTH},{LANE_HEIGHT}"/>'
        f'<line class="usual" x1="0" x2="{LANE_WIDTH}" y1="{usual_y:.1f}" y2="{usual_y:.1f}"/>{bands}</svg>'
    )


def _filled(longest_s: F64) -> F64:
    """Empty bins take the next interval that ends after them: it is the one that spans them. Those after the last stay empty."""
    filled = longest_s.copy()
    upcoming = np.nan
    for i in range(len(filled) - 1, -1, -1):
        if np.isnan(filled[i]):
            filled[i] = upcoming
        else:
            upcoming = filled[i]
    return filled


def _band(mark: Finding, length_s: float) -> str:
    start_s = mark.place.start_s or 0.0
    end_s = mark.place.end_s if mark.place.end_s is not None else start_s
    x = LANE_WIDTH * min(max(start_s / length_s, 0), 1)
    width = max(LANE_WIDTH * (end_s - start_s) / length_s, 3.0)
    title = escape(f"{mark.what} ({start_s:.2f} s)")
    return (
        f'<rect class="band {mark.severity}" x="{min(x, LANE_WIDTH - 3):.1f}" y="0" width="{min(width, LANE_WIDTH):.1f}"'
        f' height="{LANE_HEIGHT}"><title>{title}</title></rect>'
    )


def lag_line(lag_s: F64) -> str:
    """The lag (log time minus header stamp) along the log, over its own range; nothing where it does not change, or there is none."""
    known = np.isfinite(lag_s)
    if known.sum() < 2:
        return ""
    low, high = float(lag_s[known].min()), float(lag_s[known].max())
    span = high - low
    if span < STEADY_LAG_S:
        return ""
    x = (np.flatnonzero(known) + 0.5) / len(lag_s) * LANE_WIDTH
    y = LANE_HEIGHT - 4 - (lag_s[known] - low) / span * (LANE_HEIGHT - 8)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        f'<svg class="lane lag" viewBox="0 0 {LANE_WIDTH} {LANE_HEIGHT}" preserveAspectRatio="none" role="img"'
        f' aria-label="lag along the log"><polyline class="line" points="{points}"/></svg>'
        f'<span class="scale">lag {low * 1e3:.1f} to {high * 1e3:.1f} ms</span>'
    )


def fit_bars(fit: ActionFit) -> str:
    """How much of the motion the action explains at each shift; the one that drives it is filled, its own step is marked."""
    shifts = list(fit.gain)
    left, bottom, top = 8, FIT_HEIGHT - 34, 22
    step = (FIT_WIDTH - 2 * left) / len(shifts)
    parts = []
    for i, shift in enumerate(shifts):
        gain = min(max(fit.gain[shift], 0.0), 1.0)
        height = max((bottom - top) * gain, 1.5)
        x = left + i * step + step * 0.16
        kind = "best" if shift == fit.off else "other"
        middle = x + step * 0.34
        parts.append(
            f'<rect class="bar {kind}" x="{x:.1f}" y="{bottom - height:.1f}" width="{step * 0.68:.1f}" height="{height:.1f}" rx="3"/>'
            f'<text x="{middle:.1f}" y="{bottom - height - 6:.1f}">{gain:.0%}</text>'
            f'<text class="{"own" if shift == 0 else ""}" x="{middle:.1f}" y="{bottom + 16}">{shift:+d}</text>'
        )
    parts.append(f'<line class="base" x1="{left}" x2="{FIT_WIDTH - left}" y1="{bottom}" y2="{bottom}"/>')
    parts.append(f'<text class="axis" x="{FIT_WIDTH / 2}" y="{FIT_HEIGHT - 3}">shift of the action, in steps</text>')
    return (
        f'<svg class="fit" viewBox="0 0 {FIT_WIDTH} {FIT_HEIGHT}" role="img" aria-label="motion explained by shift">'
        f"{''.join(parts)}</svg>"
    )
