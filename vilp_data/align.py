"""Many rates onto one control clock: which value belongs to which step. Pure.

The rules (docs/time.md), for ticks t_0, t_1, …: the observation at tick k is the latest message at or before t_k; the action of
step k is the command in force over [t_k, t_{k+1}). Replaying an ingested episode in its simulator proves them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vilp_data import rotations
from vilp_data.errors import AlignError
from vilp_data.types import F32, F64, I64, Bool

TOLERANCE_NS = 1_000
"""Stamps this close to a tick count as on it: what rounding to nanoseconds, or a stamp kept as float seconds, moves them by."""

BACKWARD_JUMP_NS = 1_000_000_000
"""A clock that goes back by more than this was reset, not jittered."""

LONGEST_GAP_NS = 60_000_000_000
"""A minute without an image, where images come a hundred times as often, is no pause within a demonstration."""

ALWAYS_NS = -(1 << 62)
"""The stamp of what holds from the beginning of time."""

NEVER_NS = -(1 << 63)
"""The stamp of what has not come."""

Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Observed:
    """For each tick, the message seen: its index (-1: none yet), its age, and whether it is fresh enough to use."""

    index: Index
    age_s: F32
    valid: Bool


@dataclass(frozen=True)
class Latest:
    """What holds at each of F instants: values float64 [F,D], NaN where nothing has come; and since when, int64 [F], ALWAYS_NS for
    what always held, NEVER_NS where nothing has come."""

    values: F64
    stamps_ns: I64

    def age_s(self, ticks_ns: I64) -> F64:
        """How old each is at its tick, float64 [F]: 0 for what is newer or always held, NaN where nothing has come."""
        age = np.full(len(ticks_ns), np.nan)
        stamped = self.stamps_ns > ALWAYS_NS
        age[stamped] = np.maximum(ticks_ns[stamped] - self.stamps_ns[stamped], 0) / 1e9
        age[self.stamps_ns == ALWAYS_NS] = 0
        return age


def in_time(stamps: Sequence[int] | I64, *, topic: str, may_repeat: int = 1) -> tuple[I64, Index]:
    """Stamps int64 [M] as they came, and the order that sorts them. AlignError where more than `may_repeat` of them are one and the
    same, so that they tell no time, or where the clock was reset."""
    stamps_ns = np.array(stamps, np.int64)
    if len(stamps) > may_repeat and stamps_ns.min() == stamps_ns.max():
        found = f"{len(stamps)} messages, all stamped {stamps[0]} ns"
        raise AlignError("its stamps tell no time", where=topic, found=found, remedy='set clock = "log" for this topic')
    return stamps_ns, order_of(stamps_ns, topic=topic)


def order_of(stamps_ns: I64, *, topic: str) -> Index:
    """The order that sorts stamps in time, equal ones as they came. Raises AlignError where the clock was reset."""
    if len(stamps_ns) > 1 and (jump := int(np.diff(stamps_ns).min())) < -BACKWARD_JUMP_NS:
        raise AlignError(
            "the clock jumps back", where=topic, found=f"a stamp {-jump / 1e9:.3f} s before the one that came before it",
            remedy='read this topic by its arrival (clock = "log"), or cut the log at the jump',
        )  # fmt: skip
    return np.argsort(stamps_ns, kind="stable")


def median_rate_hz(stamps_ns: I64) -> float:
    """Messages a second, by the median interval. Needs two distinct stamps (else AlignError)."""
    intervals = np.diff(stamps_ns)
    intervals = intervals[intervals > 0]
    if len(intervals) == 0:
        raise AlignError(
            "a rate needs two messages at different times",
            found=f"{len(stamps_ns)} message(s)",
            remedy="state rate_hz in the task TOML",
        )
    return float(1e9 / np.median(intervals))


def control_ticks(stamps_ns: Mapping[str, I64], rate_hz: float) -> I64:
    """Ticks at `rate_hz` from the first instant at which each of these has come (a task's views; without any, its low_dim parts) to the
    last message of the one that ends first.

    Raises AlignError where they do not overlap, or one is silent for so long that its clock must have been set ahead."""
    for name, stamps in stamps_ns.items():
        gaps = np.diff(stamps)
        if len(gaps) and gaps.max() > max(LONGEST_GAP_NS, 100 * float(np.median(gaps))):
            raise AlignError(
                "the clock jumps ahead, or nothing came for long",
                where=name,
                found=f"{gaps.max() / 1e9:.1f} s of silence, after message {int(gaps.argmax())}",
                remedy='read this topic by its arrival (clock = "log"), or cut the log there ([episodes] by = "gap")',
            )
    first = max(stamps_ns, key=lambda name: int(stamps_ns[name][0]))
    last = min(stamps_ns, key=lambda name: int(stamps_ns[name][-1]))
    start, end = int(stamps_ns[first][0]), int(stamps_ns[last][-1])
    if end < start:
        raise AlignError(
            f"{last} and {first} do not overlap in time",
            found=f"{last} ends {(start - end) / 1e9:.3f} s before {first} begins",
            remedy="check the clocks with `vilp-data inspect`",
        )
    count = int((end + TOLERANCE_NS - start) * rate_hz / 1e9) + 1
    return start + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def observe(stamps_ns: I64, ticks_ns: I64, *, stale_after_s: float) -> Observed:
    """The latest message at or before each tick. `stamps_ns` ascending."""
    index = np.searchsorted(stamps_ns, ticks_ns + TOLERANCE_NS, side="right") - 1
    seen = index >= 0
    age = np.full(len(ticks_ns), np.nan)
    age[seen] = np.maximum(ticks_ns[seen] - stamps_ns[index[seen]], 0) / 1e9
    return Observed(index, age.astype(np.float32), seen & (np.nan_to_num(age, nan=np.inf) <= stale_after_s))


def last_instants(ticks_ns: I64, *, period_ns: int) -> I64:
    """The last instant of each [t_k, t_{k+1}), int64 [F]: of absolute targets the latest one by then is in force, be it issued in the
    interval or held from before."""
    return _interval_ends(ticks_ns, period_ns) - 1


def sum_deltas(stamps_ns: I64, values: F64, ticks_ns: I64, *, period_ns: int) -> F64:
    """Displacements [M,D] issued in each [t_k, t_{k+1}), summed: [F,D]; zero where there was none."""
    first, last = _interval_bounds(stamps_ns, ticks_ns, period_ns)
    out: F64 = np.zeros((len(ticks_ns), values.shape[1]))
    for k in np.flatnonzero(last > first):
        out[k] = values[first[k] : last[k]].sum(axis=0)
    return out


def compose_rotations(stamps_ns: I64, values: F64, ticks_ns: I64, *, period_ns: int, tool_frame: bool) -> F64:
    """Axis-angle rotations [M,3] (radians) issued in each [t_k, t_{k+1}), composed: [F,3]; zero where there was none.

    Later rotations multiply from the left, or from the right where they are given in the tool's own, moving frame."""
    first, last = _interval_bounds(stamps_ns, ticks_ns, period_ns)
    out: F64 = np.zeros((len(ticks_ns), 3))
    for k in np.flatnonzero(last > first):
        if last[k] - first[k] == 1:
            out[k] = values[first[k]]
            continue
        total = np.array([0.0, 0.0, 0.0, 1.0])
        for rotation in values[first[k] : last[k]]:
            q = rotations.from_axis_angle(rotation)
            total = rotations.product(total, q) if tool_frame else rotations.product(q, total)
        out[k] = rotations.to_axis_angle(total)
    return out


def _interval_ends(ticks_ns: I64, period_ns: int) -> I64:
    return np.append(ticks_ns[1:], ticks_ns[-1] + period_ns) - TOLERANCE_NS


def _interval_bounds(stamps_ns: I64, ticks_ns: I64, period_ns: int) -> tuple[Index, Index]:
    """Half-open ranges of messages: those issued in [t_k, t_{k+1})."""
    first = np.searchsorted(stamps_ns, ticks_ns - TOLERANCE_NS, side="left")
    return first, np.searchsorted(stamps_ns, _interval_ends(ticks_ns, period_ns), side="left")
