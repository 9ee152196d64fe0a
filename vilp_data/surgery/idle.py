"""Idle ends of an episode: steps before the robot first moves, and after it last did. Pure.

The rule is that of `check`: a column has left its resting value once it is a share of its own range away from it, and columns
that only tremble do not count. Steps that are not valid say nothing of motion: they count as the valid one before them.
"""

from __future__ import annotations

import numpy as np

from vilp_data.check.motion import IDLE_SHARE, moving_columns
from vilp_data.types import F64, Bool

MIN_STEPS = 8
"""Fewer steps are too few to tell rest from motion."""


def moving_range(values: F64, valid: Bool, *, threshold: float = IDLE_SHARE) -> tuple[int, int] | None:
    """First step that moves and one past the last, of `values` float64 [F,D] with `valid` bool [F]; None where nothing moves.

    `threshold` is the share of a column's range, in this episode, that it must be away from its first or last value."""
    if len(values) < MIN_STEPS or not valid.any():
        return None
    values = _held(values, valid)
    values = values[:, moving_columns(values)]
    if not values.shape[1]:
        return None
    few = max(min(len(values) // 20, 5), 1)  # the ends' own medians: the first values alone may be noise
    away = threshold * np.ptp(values, axis=0)
    from_start = (np.abs(values - np.median(values[:few], axis=0)) > away).any(axis=1)
    from_end = (np.abs(values - np.median(values[-few:], axis=0)) > away).any(axis=1)
    if not from_start.any() or not from_end.any():
        return None
    last = len(values) - 1 - int(np.argmax(from_end[::-1]))
    first, end = max(int(np.argmax(from_start)) - 1, 0), min(last + 2, len(values))
    return (first, end) if first < end else None


def _held(values: F64, valid: Bool) -> F64:
    """Values at valid steps, held over the others; before the first valid one, its own."""
    index = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), -1))
    return values[np.where(index < 0, int(np.argmax(valid)), index)]
