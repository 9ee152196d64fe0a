"""The clock of logs whose rows carry no time: row i of all rows, demonstration after demonstration, is at round(i * 1e9 / rate)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePath

import numpy as np

from vilp_data.errors import UsageError
from vilp_data.types import I64

SLOWEST_HZ, FASTEST_HZ = 1e-6, 100_000.0
"""A row in twelve days, and one in 10 us. Outside of that, times would all be one or leave 64 bits."""


def is_rate(rate_hz: float) -> bool:
    """Whether rows can be as fast as that; no for NaN."""
    return SLOWEST_HZ <= rate_hz <= FASTEST_HZ


@dataclass(frozen=True)
class RowClock:
    """Times of rows at `rate_hz`, in integer nanoseconds."""

    rate_hz: float

    @classmethod
    def at(cls, rate_hz: float, where: PurePath) -> RowClock:
        """The clock of a rate that a caller asks for. UsageError where rows cannot be as fast."""
        if not is_rate(rate_hz):
            raise UsageError(
                f"array_rate_hz must lie between {SLOWEST_HZ:g} and {FASTEST_HZ:g}, not at {rate_hz}", where=where
            )
        return cls(rate_hz)

    def time_ns(self, row: int) -> int:
        return round(row * 1e9 / self.rate_hz)

    def times_ns(self, first: int, stop: int) -> I64:
        """int64 [stop - first]: the times of rows first, …, stop - 1."""
        return np.asarray(np.rint(np.arange(first, stop) * 1e9 / self.rate_hz), np.int64)

    def first_row_at(self, time_ns: int) -> int:
        """The first row at or after a time, not below 0."""
        row = max(int(time_ns * self.rate_hz / 1e9) - 1, 0)
        while self.time_ns(row) < time_ns:
            row += 1
        return row
