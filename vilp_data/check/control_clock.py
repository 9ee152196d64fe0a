"""Commands and states of a demonstration on one control clock, by ingest's own rules, for the fit of action to motion. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vilp_data import align
from vilp_data.check.action_fit import Trajectory
from vilp_data.check.motion import Series
from vilp_data.types import F64, I64

STALE_S = 0.5  # as the task's stale_after_s is by default


def ticks_s(series: Sequence[Series], count: int, rate_hz: float) -> F64:
    """When the clock's `count` ticks are, float64 [count]: from where all of `series` have begun."""
    return np.asarray(max(one.at_s[0] for one in series) + np.arange(count) / rate_hz)


def on_control_clock(
    name: str, states: Sequence[Series], commands: Sequence[Series], rate_hz: float
) -> Trajectory | None:
    """States and commands over the time that all of them cover; None where that is too short. Of joint states, their positions alone."""
    together, states = [*states, *commands], [positions(one) for one in states]
    covered_s = min(one.at_s[-1] for one in states) - max(one.at_s[0] for one in together)
    count = int(covered_s * rate_hz) + 1
    if count < 2:
        return None
    ticks = np.round(ticks_s(together, count, rate_hz) * 1e9).astype(np.int64)
    valid = np.ones(count, np.bool_)
    last = align.last_instants(ticks, period_ns=round(1e9 / rate_hz))
    state, action = [], []
    for one in states:
        seen = align.observe(_stamps(one), ticks, stale_after_s=STALE_S)
        state.append(one.values[np.maximum(seen.index, 0)])
        valid &= seen.valid
    for one in commands:
        held = np.searchsorted(_stamps(one), last, side="right") - 1
        action.append(one.values[np.maximum(held, 0)])
        valid &= held >= 0
    return Trajectory(name, np.concatenate(state, axis=1), np.concatenate(action, axis=1), valid)


def positions(series: Series) -> Series:
    """The columns that say where a robot is: of joint states their positions, not what they weigh or how fast they are."""
    chosen = [i for i, name in enumerate(series.names) if name.startswith("position")]
    if not chosen or len(chosen) == len(series.names):
        return series
    return Series(series.topic, [series.names[i] for i in chosen], series.at_s, series.values[:, chosen])


def _stamps(series: Series) -> I64:
    return np.round(series.at_s * 1e9).astype(np.int64)
