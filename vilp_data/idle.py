"""Idle ends of a demonstration: steps before the robot first moves, and after it last did. Pure.

One rule for `check`, which tells of them, and for `trim`, which takes them off: a column has left its resting value once it is a share
of its own range away from it, and columns that only tremble do not count.
"""

from __future__ import annotations

import numpy as np

from vilp_data.types import F64, Bool

NOISE = 1.0
"""Variance of differences over variance of values: 2 for white noise, near 0 for motion. From here on a column only trembles."""

IDLE_SHARE = 0.02
"""A column has left its resting value once it is this share of its range away."""

IDLE_S = 1.0
"""A shorter pause at either end is a person drawing breath."""

MIN_STEPS = 8
"""Fewer steps are too few to tell rest from motion."""


def moving_columns(values: F64) -> Bool:
    """Which columns of float64 [F,D] move, bool [D], rather than rest or only tremble."""
    if len(values) < 3:
        return np.zeros(values.shape[1], np.bool_)
    variance = values.var(axis=0)
    return np.asarray((variance > 0) & (np.diff(values, axis=0).var(axis=0) < NOISE * variance))


def moving_range(values: F64, valid: Bool | None = None, *, threshold: float = IDLE_SHARE) -> tuple[int, int] | None:
    """First step that moves and one past the last, of `values` float64 [F,D]; None where nothing moves.

    `threshold` is the share of a column's range, in this demonstration, that it must be away from its first or last value. Steps that
    are not `valid` (bool [F]) say nothing of motion: they count as the valid one before them. Columns that are not finite are left out."""
    if len(values) < MIN_STEPS or (valid is not None and not valid.any()):
        return None
    values = values if valid is None else _held(values, valid)
    values = values[:, np.isfinite(values).all(axis=0)]
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
