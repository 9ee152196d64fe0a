"""What vectors of numbers tell: NaN, joints that are stuck or at their limit, a robot that stands still at either end. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vilp_data.check.findings import Finding, Place, Severity
from vilp_data.idle import IDLE_S, IDLE_SHARE, moving_columns, moving_range
from vilp_data.types import F64, Bool

STUCK_S = 1.0
"""All columns bit for bit the same for so long, in a vector that never repeats otherwise: its source sends its last value again."""

JOINT_STUCK_S = 3.0
JOINT_STUCK_SHARE = 0.2
"""One column alone, bit for bit the same for so long and for such a share of the time: a joint that is held may well not tremble
for a while."""

REPEATS = 0.1
"""A column that repeats its last value more often than this (coarse encoders, commands sent on change) tells nothing by repeating."""

SIBLINGS_MOVE = 0.2
"""Share of their range that other columns must cover meanwhile."""

SATURATED_SHARE = 0.1
SATURATED_VISITS = 3
SATURATED_VALUES = 20
SATURATED_OVER_NEXT = 3
"""A column sits at its limit where it takes its very lowest or highest value this often, on several visits, and so many times as often
as the value next to it, of the many that it takes."""

MIN_ROWS = 20

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Series:
    """A topic's vectors: names [D] of its columns, times float64 [n] (s, ascending), values float64 [n,D]. `command`: what the robot is
    told, which may rest or be clipped with good reason, rather than what it does."""

    topic: str
    names: Sequence[str]
    at_s: F64
    values: F64
    command: bool = False


def series_findings(series: Series, *, busy: Series | None = None) -> Iterator[Finding]:
    """What is wrong with a segment of vectors. `busy`: commands meant for this state, if they are known."""
    finite = np.isfinite(series.values)
    yield from _not_finite(series, finite)
    whole = np.asarray(finite.all(axis=0))
    if len(series.at_s) < MIN_ROWS or not whole.any():
        return
    names = [name for name, ok in zip(series.names, whole.tolist(), strict=True) if ok]
    kept = Series(series.topic, names, series.at_s, series.values[:, whole], series.command)
    if not kept.command:
        yield from _stuck_vector(kept, busy)
        yield from _stuck_columns(kept)
    yield from _saturated(kept)


def idle_ends(values: F64, at_s: F64, valid: Bool | None = None) -> tuple[float, float] | None:
    """Seconds in which nothing of `values` float64 [n,D] at `at_s` float64 [n] moves, at the start and at the end, as `vilp-data trim`
    finds them; None where nothing moves in between. Steps that are not `valid` say nothing."""
    moving = moving_range(values, valid)
    if moving is None:
        return None
    first, end = moving
    return float(at_s[first] - at_s[0]), float(at_s[-1] - at_s[end - 1])


def idle_findings(idle_s: tuple[float, float], length_s: float, remedy: str | None) -> Iterator[Finding]:
    """A demonstration of `length_s` whose robot stands still at its ends."""
    start_s, end_s = (value if value >= IDLE_S else 0.0 for value in idle_s)
    if not start_s + end_s:
        return
    ends = [f"the first {start_s:.1f} s"] * bool(start_s) + [f"the last {end_s:.1f} s"] * bool(end_s)
    place = Place(start_s=0.0, end_s=start_s) if start_s >= end_s else Place(start_s=length_s - end_s, end_s=length_s)
    yield Finding(
        severity="note", kind="idle-ends", place=place, what=f"nothing moves in {' and '.join(ends)}",
        evidence={"idle_start_s": round(start_s, 2), "idle_end_s": round(end_s, 2), "length_s": round(length_s, 2)},
        remedy=remedy,
    )  # fmt: skip


def moved_between(series: Series, start_s: float, end_s: float) -> bool:
    """Whether any moving column covers IDLE_SHARE of its range between two times."""
    inside = (series.at_s >= start_s) & (series.at_s <= end_s)
    values = series.values[:, np.isfinite(series.values).all(axis=0)]
    values = values[:, moving_columns(values)]
    if not values.shape[1] or inside.sum() < 2:
        return False
    return bool((np.ptp(values[inside], axis=0) > IDLE_SHARE * np.ptp(values, axis=0)).any())


# --- one judge each ---------------------------------------------------------------------------------------------------


def _not_finite(series: Series, finite: Bool) -> Iterator[Finding]:
    never = np.asarray(~finite.any(axis=0))
    if never.any() and len(finite):
        yield Finding(
            severity="error" if never.all() else "note", kind="nan-throughout", place=Place(topic=series.topic),
            what=f"{_names(series.names, never)} never {'hold' if never.sum() > 1 else 'holds'} a number",
            evidence={"n_columns": int(never.sum()), "n_messages": len(finite)},
            remedy="leave these fields out of the task",
        )  # fmt: skip
    some = np.asarray(~finite.all(axis=0) & ~never)
    if some.any():
        rows = np.flatnonzero(~finite[:, some].all(axis=1))
        yield Finding(
            severity="warning", kind="nan",
            place=Place(topic=series.topic, start_s=float(series.at_s[rows[0]]), end_s=float(series.at_s[rows[-1]])),
            what=f"NaN or infinity in {_names(series.names, some)}",
            evidence={"n_messages": len(rows), "of_messages": len(finite)},
            remedy="ingest masks the steps that see them; find out what the driver means by them",
        )  # fmt: skip


def _stuck_vector(series: Series, busy: Series | None) -> Iterator[Finding]:
    """All columns at once, bit for bit, where they never repeat otherwise."""
    same = (np.diff(series.values, axis=0) == 0).all(axis=1)
    first, last = _longest_run(same)
    seconds = float(series.at_s[last] - series.at_s[first])
    others = _without_ends(same, first, last)
    if seconds < STUCK_S or len(others) < MIN_ROWS or others.mean() > REPEATS:
        return
    touches_end = first == 0 or last == len(series.at_s) - 1
    told_to_move = busy is not None and moved_between(busy, float(series.at_s[first]), float(series.at_s[last]))
    if touches_end and not told_to_move:
        return  # a robot that is not switched on yet, or not any more
    severity: Severity = "error" if told_to_move and seconds > series.at_s[-1] / 2 else "warning"
    yield Finding(
        severity=severity, kind="stuck", place=_between(series, first, last),
        what=f"all its values stand still, bit for bit, for {seconds:.1f} s" + (", while commands change" if told_to_move else ""),
        evidence={"seconds": round(seconds, 2), "n_messages": last - first + 1, "repeats_otherwise": round(float(others.mean()), 3)},
        remedy="its source sent its last value again: cut those seconds out, and look at the driver",
    )  # fmt: skip


def _stuck_columns(series: Series) -> Iterator[Finding]:
    """Single columns that stop, where their siblings go on. Several that stop together are a body that nothing touches, or two
    fingers that hold something."""
    span = np.ptp(series.values, axis=0)
    moving = moving_columns(series.values)
    positions = np.array([name.startswith("position") for name in series.names])
    if positions.any():
        moving &= positions  # a joint that stands still has no velocity either
    for column in np.flatnonzero(moving).tolist():
        same = np.diff(series.values[:, column]) == 0
        first, last = _longest_run(same)
        seconds = float(series.at_s[last] - series.at_s[first])
        others = _without_ends(same, first, last)
        if seconds < max(JOINT_STUCK_S, JOINT_STUCK_SHARE * float(series.at_s[-1] - series.at_s[0])):
            continue
        if len(others) < MIN_ROWS or others.mean() > REPEATS:
            continue
        siblings = moving.copy()
        siblings[column] = False
        covered = np.ptp(series.values[first : last + 1], axis=0)
        if (covered[siblings] == 0).any():
            continue
        if not (covered[siblings] > SIBLINGS_MOVE * span[siblings]).any():
            continue
        yield Finding(
            severity="warning", kind="stuck-joint", place=_between(series, first, last),
            what=f"{series.names[column]} stands still, bit for bit, for {seconds:.1f} s while others move",
            evidence={"seconds": round(seconds, 2), "value": float(series.values[first, column])},
            remedy="look at its encoder or motor; leave these episodes out if it should have moved",
        )  # fmt: skip


def _saturated(series: Series) -> Iterator[Finding]:
    for column, name in enumerate(series.names):
        values = series.values[:, column]
        taken, often = np.unique(values, return_counts=True)
        if len(taken) < SATURATED_VALUES:
            continue
        for limit, side, end, inner in ((taken[0], "lowest", 0, 1), (taken[-1], "highest", -1, -2)):
            if often[end] < SATURATED_OVER_NEXT * often[inner]:
                continue  # a coarse scale: its values repeat everywhere
            there = values == limit
            visits = int(np.count_nonzero(np.diff(there.astype(np.int8)) == 1)) + int(there[0])
            if there.mean() < SATURATED_SHARE or visits < SATURATED_VISITS or (series.command and limit == 0):
                continue
            remedy = (
                "commands are clipped there: raise the limit or slow down, or policies learn to push against it"
                if series.command
                else "a joint at its stop or a sensor at the end of its range: check its limits"
            )
            first, last = (int(i) for i in np.flatnonzero(there)[[0, -1]])
            yield Finding(
                severity="note", kind="saturated", place=_between(series, first, last),
                what=f"{name} sits at its {side} value, {limit:.4g}, {there.mean():.0%} of the time",
                evidence={"share": round(float(there.mean()), 3), "value": float(limit), "n_visits": visits}, remedy=remedy,
            )  # fmt: skip


def _longest_run(same: Bool) -> tuple[int, int]:
    """First and last row of the longest run of equal rows, given which rows [n-1] equal the one before; (0, 0) where none does."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    if not len(edges):
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    longest = int(lengths.argmax())
    return int(edges[2 * longest]), int(edges[2 * longest] + lengths[longest])


def _without_ends(same: Bool, first: int, last: int) -> Bool:
    """Which rows repeat, but for the run first … last and for rests at either end: how often a source repeats itself in between."""
    moved = np.flatnonzero(~same)
    kept = np.ones(len(same), np.bool_)
    kept[first:last] = False
    if len(moved):
        kept[: moved[0]] = kept[moved[-1] + 1 :] = False
    return same[kept]


def _between(series: Series, first: int, last: int) -> Place:
    return Place(topic=series.topic, start_s=float(series.at_s[first]), end_s=float(series.at_s[last]))


def _names(names: Sequence[str], chosen: Bool) -> str:
    picked = [name for name, yes in zip(names, chosen.tolist(), strict=True) if yes]
    return ", ".join(picked[:4]) + (f" and {len(picked) - 4} more" if len(picked) > 4 else "")
