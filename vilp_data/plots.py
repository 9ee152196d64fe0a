"""What a plot holds and in which order plots come: pure, and free of any plotting library."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vilp_data.types import F64, U8

COMMAND_WORDS = ("action", "command", "cmd", "target", "desired")
STATE_WORDS = ("joint", "pose", "gripper", "state")


@dataclass
class Plot:
    """One time series panel: the values of each series over time, NaN where a message lacked one.

    `over` are drawn into the same panel, each in its own style; their colours begin anew, so that what belongs together can look so."""

    title: str
    entity: str
    names: list[str] = field(default_factory=list)
    times_ns: list[int] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    style: Literal["line", "faint", "points"] = "line"
    over: tuple[Plot, ...] = ()

    def add(self, time_ns: int, values: Mapping[str, float]) -> None:
        self.names += [name for name in values if name not in self.names]
        self.times_ns.append(time_ns)
        self.rows.append([values.get(name, np.nan) for name in self.names])

    def table(self) -> F64:
        """float64 [n, series]."""
        return np.array([row + [np.nan] * (len(self.names) - len(row)) for row in self.rows], np.float64)


def panel_rank(topic: str, commands: Collection[str]) -> int:
    """Order of panels: what the task calls an action, what is named like one, joints and poses, the rest."""
    name = topic.lower()
    if topic in commands:
        return 0
    if any(word in name for word in COMMAND_WORDS):
        return 1
    known = [rank for rank, word in enumerate(STATE_WORDS, start=2) if word in name]
    # Simulator state is for replaying, and says little in a plot.
    return known[0] if known and "sim" not in name.split("/") else 2 + len(STATE_WORDS)


def frame_psnr(real: U8, rebuilt: U8) -> F64:
    """Peak signal to noise ratio of each frame in dB, float64 [n], of uint8 [n,H,W,3] against [n,H,W,3]; NaN for equal frames."""
    squared = (real.astype(np.float32) - rebuilt) ** 2
    error = squared.mean(axis=(1, 2, 3), dtype=np.float64)
    return 10 * np.log10(255.0**2 / np.where(error > 0, error, np.nan))
