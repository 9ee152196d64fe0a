"""How often a topic's messages come: one number for whoever asks, whether they keep a rate or come on events. Pure."""

from __future__ import annotations

import numpy as np

from vilp_data.types import F64

MIN_MESSAGES = 20
"""Fewer messages show no rate that a gap or a jitter could be measured against."""

PERIODIC_SPREAD = 0.5
"""A topic has a rate where the middle half of its intervals lies within this share of the median; else it comes on events."""

GAP_FACTOR = 5.0
"""A gap is an interval of more than this many usual ones: fewer are missing messages, which are counted instead."""

BURSTS, BURST_S, BURST_SHARE = 5, 1.0, 0.75
"""With so many gaps, between which runs of messages last less than BURST_S on average and less than BURST_SHARE of the time in all,
messages come in bursts: how fast they follow each other within one says nothing of the topic."""


SHORTEST_S = 1e-3
"""A log that is over sooner was not recorded while anything happened."""


def keeps_rate(intervals_s: F64) -> bool:
    """Whether messages with these intervals, float64 [n] (s, none below 0), come at a rate, which is then 1 / their median."""
    if len(intervals_s) < MIN_MESSAGES - 1:
        return False
    first, median, third = np.percentile(intervals_s, (25, 50, 75))
    if median <= 0 or third - first > PERIODIC_SPREAD * median:
        return False
    gaps = intervals_s > GAP_FACTOR * median
    heard_s, n_gaps = float(intervals_s[~gaps].sum()), int(gaps.sum())
    in_bursts = heard_s / (n_gaps + 1) < BURST_S and heard_s < BURST_SHARE * intervals_s.sum()
    return n_gaps < BURSTS or not in_bursts


def rate_by_count(n_messages: int, duration_s: float) -> float | None:
    """Of a topic that keeps no rate: its messages over the time of the log, in 1/s. None where that is no rate."""
    return (n_messages - 1) / duration_s if n_messages > 1 and duration_s >= SHORTEST_S else None
