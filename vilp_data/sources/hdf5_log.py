"""Demonstrations in the robomimic HDF5 layout: data/demo_N/{obs/…, actions, states, rewards, dones}, one row a control step.

Rows carry no time: row i of all rows, demonstration after demonstration, is at round(i * 1e9 / rate), where the rate is the
`control_freq` that the file states, else the `array_rate_hz` asked for. A file that holds one demonstration at its root (`action` or
`actions` beside `observations/…`) is read too. `next_obs/` repeats `obs/` one row on, and is left out.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
import numpy.typing as npt

from vilp_data import limits
from vilp_data.errors import LogError, copy_again, nearest, reason
from vilp_data.sources.folder_hash import array_bytes, file_sha256
from vilp_data.sources.hdf5_tree import (
    BROKEN,
    Demonstrations,
    checked_array,
    find_demonstrations,
    open_file,
)
from vilp_data.sources.row_clock import RowClock, is_rate
from vilp_data.types import I64, LogEpisode, Message, TopicInfo

RECOPY = copy_again("file", leave="this demonstration")
BLOCK_BYTES = 1 << 20  # rows that are read at a time, at least one chunk of them
LISTED_ROWS = 5_000_000  # whose times `message_times` gives

# Where a file may say how fast its rows were taken: attributes of data/, and the path to the number inside their JSON.
STATED_RATES = (("env_args", ("env_kwargs", "control_freq")), ("env_info", ("control_freq",)))


@dataclass(frozen=True)
class _Span:
    """A demonstration's rows among all rows of the file: first, …, first + n_rows - 1."""

    first: int
    n_rows: int

    @property
    def stop(self) -> int:
        return self.first + self.n_rows


class Hdf5Log:
    """A `LogReader` over one HDF5 file. Topics are the arrays below a demonstration, by path: `actions`, `obs/agentview_image`.

    Whether a demonstration is whole (every array asked for is there, and of its length) is seen when it is read, so that a bad one
    stops no other."""

    format = "hdf5"

    def __init__(self, path: Path, *, array_rate_hz: float) -> None:
        asked = RowClock.at(array_rate_hz, path)
        self.path = path
        self._file = open_file(path)
        try:
            self._demos: Demonstrations = find_demonstrations(self._file, path)
            stated = _stated_rate_hz(self._demos.attributes)
            self._topics = self._demos.arrays()
            self._spans = _spans(self._demos)
        except BaseException:
            self._file.close()
            raise
        self._clock = asked if stated is None else RowClock(stated)
        self.assumed_rate_hz = array_rate_hz if stated is None else None
        self._cached: dict[
            str, tuple[str, int, npt.NDArray[Any]]
        ] = {}  # topic -> (demonstration, block number, its rows)

    def sha256(self) -> str:
        return file_sha256(self.path)

    def demonstration_sha256(self, name: str) -> str:
        """SHA-256 of one demonstration: when its rows begin, and their values in every array, whatever the chunks and compression.
        So a file that grows leaves it as it is. Rows that cannot be read count as such; reading them will say why."""
        span, digest = self._spans[name], hashlib.sha256()
        stated = "" if self.assumed_rate_hz is not None else f" at {self._clock.rate_hz!r} Hz"
        digest.update(f"{span.first}:{span.stop}{stated};".encode())
        for topic in self._topics:
            digest.update(f"{topic} ".encode())
            try:
                array = self._demos.array(name, topic)
                if array is None:
                    continue
                digest.update(f"{array.dtype.str} {array.shape};".encode())
                checked_array(array, f"{self.path}, {name}/{topic}")
                step = _block_rows(array)
                for first in range(0, array.shape[0], step):
                    digest.update(array_bytes(np.asarray(array[first : first + step])))
            except (LogError, *BROKEN):
                digest.update(b"unreadable")
        return digest.hexdigest()

    def topics(self) -> list[TopicInfo]:
        return [
            TopicInfo(topic, "array", "array", sum(self._spans[name].n_rows for name in holders))
            for topic, holders in sorted(self._topics.items())
        ]

    def metadata(self) -> dict[str, dict[str, str]]:
        """The attributes of data/ as text: env_args and the like."""
        return {"data": dict(self._demos.attributes)} if self._demos.attributes else {}

    def episodes(self) -> list[LogEpisode]:
        return [
            LogEpisode(name, self._clock.time_ns(span.first), self._clock.time_ns(span.stop), self._tags(name))
            for name, span in self._spans.items()
        ]

    def doubts(self) -> list[str]:
        """Where the file holds fewer rows than it says: robomimic's `total`."""
        total, there = self._demos.attributes.get("total", ""), sum(span.n_rows for span in self._spans.values())
        lacks = total.isdecimal() and int(total) > there
        return [f"data/ counts {int(total):,} rows (its attribute `total`), where {there:,} are"] if lacks else []

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        for topic in topics:
            if topic not in self._topics:
                raise LogError(f"no topic {topic!r} in this log", where=self.path, remedy=nearest(topic, self._topics))
        first = 0 if start_ns is None else self._clock.first_row_at(start_ns)
        stop = None if end_ns is None else self._clock.first_row_at(end_ns)
        return self._rows(sorted(set(topics)), first, stop)

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n]; and whether they are all, not those of the first demonstrations alone."""
        listed = [name for name, span in self._spans.items() if span.stop <= LISTED_ROWS]
        times = {name: self._clock.times_ns(self._spans[name].first, self._spans[name].stop) for name in listed}
        none = np.empty(0, np.int64)
        by_topic = {
            topic: np.concatenate([none, *(times[name] for name in holders if name in times)])
            for topic, holders in self._topics.items()
        }
        return by_topic, len(listed) == len(self._spans)

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """The first `limit` rows of one array, of the first demonstration that has it."""
        span = self._spans[self._topics[topic][0]]
        return list(self._rows([topic], span.first, min(span.first + limit, span.stop)))

    def model_text(self, name: str) -> str | None:
        """The simulator's model that a demonstration's states are of, as XML: its attribute `model_file`, or the file of that name
        in `models/` beside this one; None where there is neither."""
        return self._demos.model_text(name)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._cached.clear()
        self._file.close()

    # --- reading ---

    def _rows(self, topics: list[str], first: int, stop: int | None) -> Iterator[Message]:
        for name, span in self._spans.items():
            begin, end = max(first, span.first), span.stop if stop is None else min(stop, span.stop)
            if begin >= end:
                continue
            arrays = {topic: self._whole_array(name, topic, span) for topic in topics}
            for row in range(begin, end):
                time_ns = self._clock.time_ns(row)
                for topic, array in arrays.items():
                    yield Message(topic, "array", time_ns, time_ns, self._row(name, topic, array, row - span.first))

    def _whole_array(self, name: str, topic: str, span: _Span) -> h5py.Dataset:
        """An array of a demonstration, as long as the demonstration and wholly written; LogError where it is not."""
        where = f"{self.path}, {name}"
        try:
            array = self._demos.array(name, topic)
        except BROKEN as error:
            raise LogError(f"{topic} cannot be opened", where=where, found=reason(error), remedy=RECOPY) from error
        if array is None:
            others = ", ".join(self._demos.names_of(name)) or "no array"
            raise LogError(
                f"it has no {topic}, which other demonstrations have", where=where, found=others, remedy=RECOPY
            )
        if array.shape[0] != span.n_rows:
            raise LogError(
                "arrays of different lengths: which rows belong together is not known",
                where=where,
                found=f"{topic} has {array.shape[0]} rows, {self._demos.length_source(name)} says {span.n_rows}",
                remedy="write the demonstration again with arrays of one length, or take the topic out of the task TOML",
            )
        checked_array(array, f"{where}/{topic}")
        return array

    def _row(self, name: str, topic: str, array: h5py.Dataset, row: int) -> npt.NDArray[Any]:
        """One row, read-only. A block of rows of each topic is kept, so that every one is read once."""
        step = _block_rows(array)
        number, offset = divmod(row, step)
        cached = self._cached.get(topic)
        if cached is None or cached[:2] != (name, number):
            try:
                rows = np.asarray(array[number * step : (number + 1) * step])
            except BROKEN as error:
                found = f"rows from {number * step} on: {reason(error)}"
                raise LogError(
                    f"{topic} cannot be read", where=f"{self.path}, {name}", found=found, remedy=RECOPY
                ) from error
            rows.flags.writeable = False
            cached = self._cached[topic] = name, number, rows
        return np.asarray(cached[2][offset])

    def _tags(self, name: str) -> dict[str, str]:
        """What the file says of a demonstration: its task, the masks it is in, its own short attributes."""
        tags = self._demos.tags(name)
        if (task := _task_of(self._demos.attributes)) is not None:
            tags.setdefault("task", task)
        return tags


def _spans(demos: Demonstrations) -> dict[str, _Span]:
    spans, first = {}, 0
    for name in demos.names:
        spans[name] = _Span(first, demos.n_rows(name))
        first = spans[name].stop
    return spans


def _block_rows(array: h5py.Dataset) -> int:
    """Rows to read at a time: whole chunks where they fit in memory, BLOCK_BYTES together where rows are small."""
    least: int = array.chunks[0] if array.chunks else 1
    row_bytes: int = max(int(np.prod(array.shape[1:], dtype=object)) * array.dtype.itemsize, 1)
    if least * row_bytes > limits.ARRAY_CHUNK_BYTES:  # chunks that are long in rows, and narrow
        return max(limits.ARRAY_CHUNK_BYTES // row_bytes, 1)
    return least * max(BLOCK_BYTES // (least * row_bytes), 1)


def _stated_rate_hz(texts: Mapping[str, str]) -> float | None:
    """How fast the rows were taken, where an attribute of data/ says it in JSON, and rows can be as fast as that."""
    for attribute, path in STATED_RATES:
        rate = _json(texts.get(attribute, ""))
        for key in path:
            rate = rate.get(key) if isinstance(rate, dict) else None
        if isinstance(rate, int | float) and not isinstance(rate, bool) and is_rate(rate):
            return float(rate)
    return None


def _task_of(texts: Mapping[str, str]) -> str | None:
    """The name of the environment that the demonstrations were made in."""
    arguments = _json(texts.get("env_args", ""))
    name = arguments.get("env_name") if isinstance(arguments, dict) else None
    return name if isinstance(name, str) else texts.get("env")


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None
