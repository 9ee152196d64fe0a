"""Demonstrations in the diffusion-policy zarr layout: arrays under data/, one row a step, and meta/episode_ends.

Rows carry no time, so row i of the whole store is given log time round(i * 1e9 / array_rate_hz). Zarr chunks have no checksum:
a missing chunk is refused (zarr would hand out its fill value), a damaged one only where its codec notices.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import zarr
from zarr.errors import BaseZarrError, ZarrUserWarning

from vilp_data import limits
from vilp_data.errors import LogError, copy_again, nearest, reason
from vilp_data.sources.folder_hash import array_bytes, folder_sha256
from vilp_data.sources.row_clock import RowClock
from vilp_data.sources.zarr_chunks import chunk_files, inflated_bytes
from vilp_data.types import I64, LogEpisode, Message, TopicInfo

RECOPY = copy_again("folder")
LAYOUT = "expected the diffusion-policy layout: arrays under data/ and row counts in meta/episode_ends"

# What zarr and its codecs raise for damaged metadata or chunks.
BROKEN = (
    BaseZarrError,
    KeyError,
    ValueError,
    RuntimeError,
    TypeError,
    OSError,
    SystemError,
    MemoryError,
    OverflowError,
)


def is_zarr(path: Path) -> bool:
    return (path / ".zgroup").is_file() or (path / "zarr.json").is_file()


class ZarrLog:
    """A `LogReader` over one zarr store.

    The store does not tell the rate its rows were recorded at: `array_rate_hz` is taken for it, and callers pass their task's rate.
    So every row is one step whatever rate the task asks for; a wrong one resamples nothing, it only says the wrong times."""

    format = "zarr"

    def __init__(self, path: Path, *, array_rate_hz: float) -> None:
        self._clock = RowClock.at(array_rate_hz, path)
        self.assumed_rate_hz = array_rate_hz
        self.path = path
        self._arrays, self._ends = _open_store(path)
        self._cached: dict[str, tuple[int, npt.NDArray[Any]]] = {}  # topic -> (chunk number, its rows)

    def sha256(self) -> str:
        return folder_sha256(self.path)

    def demonstration_sha256(self, name: str) -> str:
        """SHA-256 of one demonstration: where its rows begin, and their values in every array under data/, whatever the chunks and
        compression. So a store that grows leaves it as it is. Rows that cannot be read count as such; reading them will say why.
        """
        first, stop = self._row_ranges()[name]
        digest = hashlib.sha256()
        for topic in sorted(self._arrays):
            array = self._arrays[topic]
            digest.update(f"{topic} {array.dtype.str} {array.shape[1:]} {first}:{stop};".encode())
            size = array.chunks[0]
            for number in range(first // size, -(-stop // size)):
                try:
                    rows = self._chunk(topic, number)[max(first - number * size, 0) : stop - number * size]
                except LogError:
                    digest.update(b"unreadable")
                else:
                    digest.update(array_bytes(rows))
        return digest.hexdigest()

    def topics(self) -> list[TopicInfo]:
        return [TopicInfo(name, "array", "array", self.n_rows) for name in sorted(self._arrays)]

    def metadata(self) -> dict[str, dict[str, str]]:
        return {}

    @property
    def n_rows(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def episodes(self) -> list[LogEpisode]:
        return [
            LogEpisode(name, self._clock.time_ns(start), self._clock.time_ns(end))
            for name, (start, end) in self._row_ranges().items()
        ]

    def doubts(self) -> list[str]:
        """Where arrays have rows behind the last episode's end (of an episode whose writer crashed, or whose end is cut off the list), and
        where a folder in data/ holds none: zarr passes over one whose metadata it cannot read."""
        behind = {name: int(array.shape[0]) - self.n_rows for name, array in self._arrays.items()}
        folders = {entry.name for entry in (self.path / "data").iterdir() if entry.is_dir()}
        return [
            *(
                f"data/{name} is read as no array: its metadata is missing or damaged, or it holds others"
                for name in sorted(folders - behind.keys())
            ),
            *(
                f"data/{name} has {rows:,} rows in no demonstration, behind the last end in meta/episode_ends, {self.n_rows:,}"
                for name, rows in sorted(behind.items())
                if rows > 0
            ),
        ]

    def _row_ranges(self) -> dict[str, tuple[int, int]]:
        """Name of each demonstration -> its first row, and the row after its last."""
        digits = max(3, len(str(len(self._ends) - 1)))
        starts, ends = [0, *self._ends[:-1].tolist()], self._ends.tolist()
        return {f"episode_{n:0{digits}d}": span for n, span in enumerate(zip(starts, ends, strict=True))}

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        for topic in topics:
            if topic not in self._arrays:
                raise LogError(f"no topic {topic!r} in this log", where=self.path, remedy=nearest(topic, self._arrays))
        first = 0 if start_ns is None else self._clock.first_row_at(start_ns)
        stop = self.n_rows if end_ns is None else min(self._clock.first_row_at(end_ns), self.n_rows)
        return self._rows(sorted(set(topics)), first, stop)

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n]; and True, for they are all."""
        return dict.fromkeys(self._arrays, self._clock.times_ns(0, self.n_rows)), True

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """The first `limit` rows of one array."""
        return list(self._rows([topic], 0, min(limit, self.n_rows)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._cached.clear()

    def _rows(self, topics: list[str], first: int, stop: int) -> Iterator[Message]:
        for row in range(first, stop):
            time_ns = self._clock.time_ns(row)
            for topic in topics:
                number, offset = divmod(row, self._arrays[topic].chunks[0])
                yield Message(topic, "array", time_ns, time_ns, self._chunk(topic, number)[offset])

    def _chunk(self, topic: str, number: int) -> npt.NDArray[Any]:
        """All rows of one chunk (of the leading axis), read-only. The latest is kept: neighbouring episodes often share it."""
        cached = self._cached.get(topic)
        if cached is not None and cached[0] == number:
            return cached[1]
        array = self._arrays[topic]
        rows_bytes = array.chunks[0] * int(np.prod(array.shape[1:], dtype=object)) * array.dtype.itemsize
        limits.check(f"chunk {number} of data/{topic}", "ARRAY_CHUNK_BYTES", rows_bytes, where=self.path)
        try:
            self._refuse_missing(topic, number)
            rows = np.asarray(array[number * array.chunks[0] : (number + 1) * array.chunks[0]])
        except BROKEN as error:
            where = f"chunk {number} of data/{topic}"
            raise LogError(f"{where} cannot be read", where=self.path, found=reason(error), remedy=RECOPY) from error
        rows.flags.writeable = False
        self._cached[topic] = number, rows
        return rows

    def _refuse_missing(self, topic: str, number: int) -> None:
        """LogError where a file that the rows need is not there, or inflates to more than any array's chunk."""
        for key in chunk_files(self._arrays[topic], number):
            file = self.path / "data" / topic / key
            if not file.is_file():
                raise LogError(
                    f"data/{topic} lacks its chunk {key}",
                    where=self.path,
                    found="no such file; zarr would read it as its fill value",
                    remedy=f"{RECOPY}; if those rows really are empty, write the store with write_empty_chunks=True",
                )
            size = inflated_bytes(self._arrays[topic], file)
            limits.check(f"data/{topic}, chunk {key},", "ARRAY_CHUNK_BYTES", size, where=self.path)


def _open_store(path: Path) -> tuple[dict[str, Any], I64]:
    try:
        root = zarr.open_group(path, mode="r")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ZarrUserWarning)  # of arrays that are passed over: `doubts` names them
            arrays = dict(root["data"].arrays()) if "data" in root else {}
        ends = np.asarray(root["meta/episode_ends"][:]) if "meta/episode_ends" in root else None
    except BROKEN as error:
        raise LogError("the zarr store cannot be opened", where=path, found=reason(error), remedy=RECOPY) from error
    if not arrays or ends is None:
        missing = "data/ holds no array" if not arrays else "there is no meta/episode_ends"
        raise LogError("not a zarr store of demonstrations", where=path, found=missing, remedy=LAYOUT)
    _check_rows(path, arrays, ends)
    return arrays, ends.astype(np.int64)


def _check_rows(path: Path, arrays: dict[str, Any], ends: npt.NDArray[Any]) -> None:
    if (
        ends.ndim != 1
        or ends.dtype.kind not in "iu"
        or not len(ends)
        or int(ends[0]) <= 0
        or (np.diff(ends.astype(np.int64)) <= 0).any()
    ):
        found = f"shape {ends.shape}, {ends.dtype}, {ends.ravel()[:5].tolist()} …"
        raise LogError("meta/episode_ends must rise, one row count an episode", where=path, found=found, remedy=LAYOUT)
    for name, array in arrays.items():
        if array.ndim == 0 or array.shape[0] < int(ends[-1]):
            found = f"shape {array.shape}, while meta/episode_ends counts {int(ends[-1])} rows"
            raise LogError(f"data/{name} is shorter than its episodes", where=path, found=found, remedy=RECOPY)
