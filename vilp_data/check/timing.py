"""What a topic's stamps tell: rate, gaps, jitter, clocks that jump, lag or drift, stamps that repeat or fall. Pure.

Two clocks meet here: the log time, when the recorder received a message, and the header stamp, when the sensor says it was made.
Gaps and jitter are judged by the sensor's clock where there is one, since that is the clock that ingest uses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from vilp_data.align import BACKWARD_JUMP_NS, LONGEST_GAP_NS
from vilp_data.check.findings import Finding, Place, Severity
from vilp_data.decode import is_wall_clock
from vilp_data.message_rate import GAP_FACTOR, MIN_MESSAGES, keeps_rate
from vilp_data.types import F64, I64

FEW = 5
"""Fewer messages than this tell nothing of a clock."""

STEADY = 0.5
"""A lag whose quartiles lie further apart than this share of it is no difference between two clocks."""

GAP_FLOOR_S = 0.1
"""Shorter silences are no gap at any rate: one step of a 10 Hz control clock bridges them."""

MISSING_SHARE = 0.02
"""More missing messages than this (single intervals of about two, three or four usual ones) deserve a word."""

JITTER = 0.5
"""Half the spread of intervals (5th to 95th percentile) over the median. From here on a camera at the control rate shows steps twice."""

SKEW_S = 1.0
"""A header this far from the log time was stamped by another clock: no transport takes so long."""

AHEAD_S = 0.005
"""A stamp later than its arrival cannot be true; this much is left to rounding and to clocks that are kept in step (NTP)."""

DRIFT_S = 0.02
"""A lag that changes by more than this over a log shifts observations against actions by half a step at 25 Hz."""

DRIFT_OVER_SPREAD = 3.0
"""The change must also be this many times the scatter of the lag: a busy network alone scatters it."""

SILENT_S = 1.0
SILENT_SHARE = 0.02
"""A topic that starts so late, or ends so early, in seconds and as a share of the log, does so for a reason."""

DUPLICATE_SHARE = 0.01
"""More repeated stamps than this are a fault of the publisher rather than a hiccup."""

TOLD = 5
"""Gaps of one topic that get a finding of their own, longest first."""


@dataclass(frozen=True)
class Timing:
    """Figures of one topic: over one segment of a log, or joined over several.

    rate_hz          1 / median interval, None where it keeps no rate; of a whole log, `message_rate.rate_by_count` then stands in
    periodic         whether it keeps a rate: else it comes on events
    jitter           half the spread of intervals over the median; None where that is 0
    max_gap_s        the longest interval; lag_s the median of log time minus header stamp
    header_clock     "none", "zero", "constant", "wall", "simulated"
    """

    n_messages: int
    rate_hz: float | None
    periodic: bool
    jitter: float | None
    max_gap_s: float | None
    header_clock: str
    lag_s: float | None


def header_clock(header_ns: I64 | None) -> str:
    """What kind of stamps int64 [n] these are; None where messages carry none."""
    if header_ns is None or not len(header_ns):
        return "none"
    if not header_ns.any():
        return "zero"
    if len(header_ns) > 2 and (header_ns == header_ns[0]).all():
        return "constant"
    return "wall" if is_wall_clock(int(np.median(header_ns))) else "simulated"


def measure(log_ns: I64, header_ns: I64 | None) -> Timing:
    """The figures of a segment: log times int64 [n] ascending, header stamps [n] in the same order or None."""
    clock = header_clock(header_ns)
    has_clock = header_ns is not None and clock in ("wall", "simulated")
    stamps = np.sort(header_ns) if has_clock and header_ns is not None else log_ns
    intervals = np.diff(stamps) / 1e9
    lag_s = float(np.median(log_ns - header_ns)) / 1e9 if has_clock and header_ns is not None else None
    if len(intervals) == 0:
        return Timing(len(log_ns), None, False, None, None, clock, lag_s)
    low, median, high = np.percentile(intervals, (5, 50, 95))
    longest = float(intervals.max())
    if median <= 0:
        return Timing(len(log_ns), None, False, None, longest, clock, lag_s)
    periodic, jitter = keeps_rate(intervals), float((high - low) / (2 * median))
    return Timing(len(log_ns), float(1 / median) if periodic else None, periodic, jitter, longest, clock, lag_s)


def joined(one: Timing | None, other: Timing) -> Timing:
    """The figures of two segments of one topic together: medians weighted by messages."""
    if one is None:
        return other
    n = one.n_messages + other.n_messages

    def mean(a: float | None, b: float | None) -> float | None:
        return (
            (a * one.n_messages + b * other.n_messages) / n
            if a is not None and b is not None
            else a
            if b is None
            else b
        )

    longest = [gap for gap in (one.max_gap_s, other.max_gap_s) if gap is not None]
    clock = one.header_clock if one.n_messages >= other.n_messages else other.header_clock
    return Timing(
        n, mean(one.rate_hz, other.rate_hz), one.periodic or other.periodic, mean(one.jitter, other.jitter),
        max(longest, default=None), clock, mean(one.lag_s, other.lag_s),
    )  # fmt: skip


def timing_findings(
    topic: str, log_ns: I64, header_ns: I64 | None, *, origin_ns: int, camera: bool = False, matters: bool = True
) -> Iterator[Finding]:
    """What is wrong with a segment of one topic's stamps, as `measure` takes them. Places count seconds from `origin_ns`, by log time.

    Of commands, which come when there is something to command, and of topics that no task is likely to read, nothing `matters`: all is
    but a note."""
    for finding in _stamp_findings(topic, log_ns, header_ns, origin_ns=origin_ns, camera=camera):
        yield finding if matters else replace(finding, severity="note")


def _stamp_findings(
    topic: str, log_ns: I64, header_ns: I64 | None, *, origin_ns: int, camera: bool
) -> Iterator[Finding]:
    figures = measure(log_ns, header_ns)
    at_s = (log_ns - origin_ns) / 1e9
    usable = header_ns is not None and figures.header_clock in ("wall", "simulated")
    if figures.header_clock in ("zero", "constant") and len(log_ns) > 1:
        yield _useless_header(topic, figures, header_ns)
    if usable and header_ns is not None and len(log_ns) >= FEW:
        jumps = list(_jumps(topic, log_ns, header_ns, at_s))
        yield from jumps
        yield from _falls(topic, header_ns, at_s)
        if any(jump.kind.startswith("clock-jump") for jump in jumps):
            header_ns, usable = None, False  # what it says of lags and gaps is the jump again
            figures = measure(log_ns, None)
    stamps = header_ns if usable and header_ns is not None else log_ns
    yield from _duplicates(topic, stamps, at_s, usable)
    if usable and header_ns is not None and figures.lag_s is not None and len(log_ns) >= FEW:
        yield from _skew(topic, log_ns, header_ns, figures.lag_s)
    order = np.argsort(stamps, kind="stable")
    stamps = stamps[order]
    if figures.periodic and figures.rate_hz is not None:
        yield from _gaps(topic, np.diff(stamps) / 1e9, at_s[order], 1 / figures.rate_hz, camera)
        yield from _jitter(topic, figures, camera)
    elif camera and len(log_ns) >= MIN_MESSAGES and figures.jitter is not None:
        mean_s = float(stamps[-1] - stamps[0]) / 1e9 / (len(stamps) - 1)
        evidence = {"mean_interval_s": mean_s, "longest_interval_s": figures.max_gap_s or 0.0}
        yield Finding(
            severity="warning", kind="irregular-camera", place=Place(topic=topic), evidence=evidence,
            what="the camera keeps no rate: its intervals lie far from each other, or its images come in bursts",
            remedy=f"state the task's rate_hz well below {1 / mean_s:.3g}: a step then has an image of its own",
        )  # fmt: skip


# --- one judge each ---------------------------------------------------------------------------------------------------


def _useless_header(topic: str, figures: Timing, header_ns: I64 | None) -> Finding:
    told = "are all zero" if figures.header_clock == "zero" else "are all the same"
    evidence = {"n_messages": figures.n_messages, "stamp_ns": int(header_ns[0]) if header_ns is not None else 0}
    return Finding(
        severity="warning", kind="header-unset", place=Place(topic=topic), what=f"its header stamps {told}",
        evidence=evidence, remedy=f'read it by its arrival: topic = "{topic}", clock = "log"',
    )  # fmt: skip


def _jumps(topic: str, log_ns: I64, header_ns: I64, at_s: F64) -> Iterator[Finding]:
    """The sensor's clock against the recorder's, from one message to the next."""
    header_steps, log_steps = np.diff(header_ns), np.diff(log_ns)
    slip = header_steps - log_steps
    for i in np.flatnonzero(header_steps < -BACKWARD_JUMP_NS)[:TOLD].tolist():
        yield Finding(
            severity="error", kind="clock-jump", place=Place(topic=topic, start_s=float(at_s[i + 1])),
            what=f"the header's clock jumps back by {-header_steps[i] / 1e9:.3f} s",
            evidence={"jump_s": float(header_steps[i] / 1e9), "log_step_s": float(log_steps[i] / 1e9)},
            remedy=f'read it by its arrival (topic = "{topic}", clock = "log"), or cut the log there',
        )  # fmt: skip
    ahead = (slip > BACKWARD_JUMP_NS) & (header_steps > 2 * log_steps)
    for i in np.flatnonzero(ahead)[:TOLD].tolist():
        yield Finding(
            severity="warning", kind="clock-jump-ahead", place=Place(topic=topic, start_s=float(at_s[i + 1])),
            what=f"the header's clock jumps ahead by {slip[i] / 1e9:.3f} s while the log goes on",
            evidence={"jump_s": float(slip[i] / 1e9), "log_step_s": float(log_steps[i] / 1e9)},
            remedy=f'read it by its arrival (topic = "{topic}", clock = "log"), or cut the log there',
        )  # fmt: skip
    stalled = (slip < -BACKWARD_JUMP_NS) & (header_steps >= 0)
    for i in np.flatnonzero(stalled)[:TOLD].tolist():
        yield Finding(
            severity="note", kind="recorder-stall",
            place=Place(topic=topic, start_s=float(at_s[i]), end_s=float(at_s[i + 1])),
            what=f"arrivals stall for {log_steps[i] / 1e9:.2f} s; by their own stamps messages are {header_steps[i] / 1e9:.2f} s apart",
            evidence={"log_step_s": float(log_steps[i] / 1e9), "header_step_s": float(header_steps[i] / 1e9)},
            remedy='keep clock = "header" (the default): arrival tells no time here',
        )  # fmt: skip


def _falls(topic: str, header_ns: I64, at_s: F64) -> Iterator[Finding]:
    steps = np.diff(header_ns)
    fallen = np.flatnonzero((steps < 0) & (steps >= -BACKWARD_JUMP_NS))
    if len(fallen):
        yield Finding(
            severity="note", kind="out-of-order", place=Place(topic=topic, start_s=float(at_s[fallen[0] + 1])),
            what="header stamps arrive out of order; ingest sorts them",
            evidence={"n_out_of_order": len(fallen), "n_messages": len(header_ns), "largest_s": float(-steps.min() / 1e9)},
        )  # fmt: skip


def _duplicates(topic: str, stamps: I64, at_s: F64, of_header: bool) -> Iterator[Finding]:
    if len(stamps) < MIN_MESSAGES:
        return
    order = np.argsort(stamps, kind="stable")
    again = np.flatnonzero(np.diff(stamps[order]) == 0)
    if not len(again):
        return
    often = len(again) >= DUPLICATE_SHARE * len(stamps)
    clock = "header stamp" if of_header else "log time"
    yield Finding(
        severity="warning" if often and of_header else "note", kind="duplicate-stamps",
        place=Place(topic=topic, start_s=float(at_s[order[again[0] + 1]])),
        what=f"messages share a {clock} with the one before; of such, ingest uses the last",
        evidence={"n_repeated": len(again), "n_messages": len(stamps)},
        remedy="two publishers on one topic, or a driver that sends twice: look at who publishes it" if often and of_header else None,
    )  # fmt: skip


def _skew(topic: str, log_ns: I64, header_ns: I64, lag_s: float) -> Iterator[Finding]:
    log_wall, header_wall = is_wall_clock(int(log_ns[0])), is_wall_clock(int(np.median(header_ns)))
    if log_wall != header_wall:
        header, log = ("wall", "simulated") if header_wall else ("simulated", "wall")
        yield Finding(
            severity="note", kind="two-clocks", place=Place(topic=topic),
            what=f"its header is on {header} time, the log on {log} time",
            evidence={"lag_s": lag_s}, remedy="give every topic of a task the same clock",
        )  # fmt: skip
    elif abs(lag_s) > SKEW_S:
        low, high = np.percentile(log_ns - header_ns, (25, 75)) / 1e9
        if high - low > STEADY * abs(lag_s):
            return
        yield Finding(
            severity="warning", kind="skew", place=Place(topic=topic),
            what=f"header stamps lie {abs(lag_s):.2f} s {'before' if lag_s > 0 else 'after'} their arrival: another clock",
            evidence={"lag_s": lag_s},
            remedy=f'topic = "{topic}", clock = "log"; or, where the difference is known to be constant, offset_s = {lag_s:.3f}',
        )  # fmt: skip
    elif lag_s < -AHEAD_S:
        yield Finding(
            severity="warning", kind="stamped-ahead", place=Place(topic=topic),
            what=f"header stamps lie {-lag_s * 1e3:.0f} ms after their arrival: the sensor's clock runs ahead of the recorder's",
            evidence={"lag_s": lag_s}, remedy=f'topic = "{topic}", offset_s = {lag_s:.3f}; and keep both clocks in step (NTP, PTP)',
        )  # fmt: skip


def _gaps(topic: str, intervals_s: F64, at_s: F64, period_s: float, camera: bool) -> Iterator[Finding]:
    floor_s = max(GAP_FACTOR * period_s, GAP_FLOOR_S)
    gaps = np.flatnonzero(intervals_s > floor_s)
    for i in gaps[np.argsort(-intervals_s[gaps], kind="stable")][:TOLD].tolist():
        refused = camera and intervals_s[i] * 1e9 > max(LONGEST_GAP_NS, 1e11 * period_s)
        severity: Severity = "error" if refused else "warning"
        remedy = "cut the log there: ingest refuses it" if refused else _gap_remedy(camera)
        yield Finding(
            severity=severity, kind="gap", place=Place(topic=topic, start_s=float(at_s[i]), end_s=float(at_s[i + 1])),
            what=f"silent for {intervals_s[i]:.2f} s, where a message comes every {1e3 * period_s:.3g} ms",
            evidence={"gap_s": float(intervals_s[i]), "usual_interval_s": period_s, "n_gaps": len(gaps)}, remedy=remedy,
        )  # fmt: skip
    small = intervals_s[intervals_s <= floor_s]
    missing = int(np.maximum(np.rint(small / period_s) - 1, 0).sum())
    if missing > MISSING_SHARE * len(intervals_s):
        where = int(np.flatnonzero((intervals_s > 1.5 * period_s) & (intervals_s <= floor_s))[0])
        yield Finding(
            severity="warning" if camera else "note", kind="missing-messages",
            place=Place(topic=topic, start_s=float(at_s[where])),
            what=f"about {missing / (len(intervals_s) + missing):.0%} of its messages are missing, a few at a time",
            evidence={"n_missing": missing, "n_messages": len(intervals_s) + 1, "usual_interval_s": period_s},
            remedy="a full disk buffer or network: record fewer topics at once, or state a lower rate_hz",
        )  # fmt: skip


def _gap_remedy(camera: bool) -> str:
    hold = "steps without a fresh value are masked (stale_after_s)"
    return f'{hold}; where the log holds several demonstrations, [episodes] by = "gap"' if camera else hold


def _jitter(topic: str, figures: Timing, camera: bool) -> Iterator[Finding]:
    if figures.jitter is None or figures.rate_hz is None or figures.jitter <= JITTER:
        return
    yield Finding(
        severity="warning" if camera else "note", kind="jitter", place=Place(topic=topic),
        what=f"intervals scatter by {figures.jitter:.0%} around {1e3 / figures.rate_hz:.3g} ms",
        evidence={"jitter": figures.jitter, "rate_hz": figures.rate_hz},
        remedy=f"state a rate_hz below {figures.rate_hz:.3g}, so that each step has an image of its own" if camera else None,
    )  # fmt: skip


# --- over the whole log -------------------------------------------------------------------------------------------------


def silence_findings(
    topic: str, first_ns: int, last_ns: int, *, span_ns: tuple[int, int], rate_hz: float
) -> Iterator[Finding]:
    """A periodic topic whose messages begin late or stop early within the demonstration `span_ns` (first and last message of any)."""
    span_s = (span_ns[1] - span_ns[0]) / 1e9
    least_s = max(SILENT_S, SILENT_SHARE * span_s, GAP_FACTOR / rate_hz)
    late_s, early_s = (first_ns - span_ns[0]) / 1e9, (span_ns[1] - last_ns) / 1e9
    if early_s > least_s:
        yield Finding(
            severity="warning", kind="ends-early",
            place=Place(topic=topic, start_s=span_s - early_s, end_s=span_s),
            what=f"falls silent {early_s:.1f} s before the end", evidence={"silent_s": early_s, "span_s": span_s},
            remedy="its publisher died or was stopped first: steps after it are masked, or left out where it is a camera",
        )  # fmt: skip
    if late_s > least_s:
        yield Finding(
            severity="note", kind="starts-late", place=Place(topic=topic, start_s=0.0, end_s=late_s),
            what=f"begins {late_s:.1f} s after the start", evidence={"late_s": late_s, "span_s": span_s},
            remedy="episodes begin where every camera has an image" if late_s else None,
        )  # fmt: skip


def drift_findings(topic: str, at_s: F64, lag_s: F64) -> Iterator[Finding]:
    """A lag (log time minus header stamp) that grows or shrinks along the log: float64 [n] each, NaN where there was none."""
    known = np.isfinite(lag_s)
    at_s, lag_s = at_s[known], lag_s[known]
    if len(lag_s) < MIN_MESSAGES:
        return
    tenth = max(len(lag_s) // 10, 2)
    before, after = float(np.median(lag_s[:tenth])), float(np.median(lag_s[-tenth:]))
    spread = float(np.median(np.abs(np.diff(lag_s))))
    moved_s, over_s = after - before, float(np.median(at_s[-tenth:]) - np.median(at_s[:tenth]))
    middle = float(np.median(lag_s[len(lag_s) // 2 - tenth // 2 : len(lag_s) // 2 + tenth // 2 + 1]))
    steady = abs(middle - (before + after) / 2) < abs(moved_s) / 4  # a step, or a queue that fills once, is no drift
    if abs(moved_s) < max(DRIFT_S, DRIFT_OVER_SPREAD * spread) or abs(moved_s) > SKEW_S or over_s <= 0 or not steady:
        return
    yield Finding(
        severity="warning", kind="drift", place=Place(topic=topic),
        what=f"the header's clock drifts: its lag goes from {before * 1e3:.0f} to {after * 1e3:.0f} ms",
        evidence={"drift_s": moved_s, "over_s": over_s, "parts_per_million": 1e6 * moved_s / over_s},
        remedy=f'keep both clocks in step (NTP, PTP); for this log, topic = "{topic}", clock = "log"',
    )  # fmt: skip


def log_order_findings(topic: str, file_order_ns: I64) -> Iterator[Finding]:
    """Log times int64 [n] in the order they lie in the file: recorders with several threads write them a little out of order."""
    fallen = int(np.count_nonzero(np.diff(file_order_ns) < 0))
    if fallen:
        largest_s = float(-np.diff(file_order_ns).min() / 1e9)
        far = largest_s * 1e9 > BACKWARD_JUMP_NS
        yield Finding(
            severity="warning" if far else "note", kind="log-order", place=Place(topic=topic),
            what="log times fall along the file; messages are read in order of log time",
            evidence={"n_falls": fallen, "largest_s": largest_s},
            remedy="the recorder's clock was set back while it ran: distrust the log times around it" if far else None,
        )  # fmt: skip
