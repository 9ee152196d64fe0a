"""The rows of one episode of a LeRobot dataset, out of a Parquet file that may hold others: a few at a time, checked, never guessed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from vilp_data import limits
from vilp_data.errors import LogError, copy_again, reason
from vilp_data.sources.lerobot_meta import EpisodeMeta, Feature
from vilp_data.types import F64, I64

RECOPY = copy_again("file", leave="this episode")
MAX_FILE_ROWS = 100_000_000
BATCH_ROWS, BATCH_IMAGES = 1024, 8  # at most
BATCH_BYTES = 16 << 20
BROKEN = (pa.ArrowException, OSError, KeyError, ValueError, TypeError, IndexError, OverflowError, MemoryError)


class EpisodeTable:
    """An opened Parquet file, and the rows first, …, first + n_rows - 1 of it that are the episode's.

    LogError where the file is missing, cut off, or holds other rows than meta/ says."""

    def __init__(self, root: Path, episode: EpisodeMeta) -> None:
        self.path = root / episode.table
        self._where = f"{self.path}, episode {episode.index}"
        self.n_rows = episode.n_rows
        if not self.path.is_file():
            remedy = "download it; `vilp-data ingest` takes the other episodes without it"
            raise LogError("the episode's table is missing", where=f"{root}, episode {episode.index}",
                           found=f"no file {episode.table}", remedy=remedy)  # fmt: skip
        try:
            self._file = pq.ParquetFile(
                self.path, pre_buffer=False, buffer_size=1 << 20, page_checksum_verification=True
            )
            total = self._file.metadata.num_rows
            if total > MAX_FILE_ROWS:
                raise ValueError(f"{total} rows in one file")
            self._first = self._find_rows(episode)
            self.timestamps_s = self._read_timestamps()
        except LogError:
            self.close()
            raise
        except BROKEN as error:
            self.close()
            raise LogError("the table cannot be read", where=self._where, found=reason(error), remedy=RECOPY) from error

    def close(self) -> None:
        if hasattr(self, "_file"):
            self._file.close()

    def rows(self, features: Sequence[Feature], first: int, stop: int) -> Iterator[Mapping[str, Any]]:
        """Rows first, …, stop - 1 of the episode: feature name -> what its message holds.

        Numbers are an array of the feature's shape, texts a str, images a dict `format`, `data`: the bytes as they were embedded."""
        if not features:
            yield from ({} for _ in range(first, stop))
            return
        try:
            batch_rows = self._batch_rows(features)
            for batch in self._batches([feature.name for feature in features], first, stop, batch_rows):
                columns = {
                    feature.name: _values(batch.column(feature.name), feature, self._where) for feature in features
                }
                for row in range(batch.num_rows):
                    yield {name: values[row] for name, values in columns.items()}
        except BROKEN as error:
            raise LogError("the table cannot be read", where=self._where, found=reason(error), remedy=RECOPY) from error

    def _batch_rows(self, features: Sequence[Feature]) -> int:
        """Rows to read at a time, by the numbers that meta/ states for each; LogError where limits.ARRAY_CHUNK_BYTES do not hold a row."""
        row_bytes = 8 * sum(prod(feature.shape) for feature in features if feature.kind == "numbers")
        limits.check("a row of the table", "ARRAY_CHUNK_BYTES", row_bytes, where=self._where)
        most = BATCH_IMAGES if any(feature.kind == "image" for feature in features) else BATCH_ROWS
        return max(min(most, BATCH_BYTES // max(row_bytes, 1)), 1)

    def _find_rows(self, episode: EpisodeMeta) -> int:
        """The first of the episode's rows in the file, by its own column `episode_index`, which must agree with meta/."""
        here = np.flatnonzero(self._column("episode_index") == episode.index)
        if len(here) != episode.n_rows or (len(here) and here[-1] - here[0] + 1 != len(here)):
            found = f"{len(here)} rows of this episode in the file, {episode.n_rows} by meta/"
            raise LogError("the table does not hold the episode's rows", where=self._where, found=found, remedy=RECOPY)
        return int(here[0]) if len(here) else 0

    def _read_timestamps(self) -> F64:
        parts = [batch.column("timestamp").to_numpy(zero_copy_only=False)
                 for batch in self._batches(["timestamp"], 0, self.n_rows, 65536)]  # fmt: skip
        return np.concatenate([np.empty(0), *parts]).astype(np.float64)

    def _column(self, name: str) -> I64:
        if name not in self._file.schema_arrow.names:
            raise ValueError(f"no column {name!r}")
        return np.asarray(self._file.read(columns=[name]).column(name).to_numpy(), np.int64)

    def _batches(self, names: list[str], first: int, stop: int, batch_rows: int) -> Iterator[pa.RecordBatch]:
        """Record batches that together are rows first, …, stop - 1 of the episode."""
        for name in names:
            if name not in self._file.schema_arrow.names:
                found = ", ".join(self._file.schema_arrow.names)
                raise LogError(f"the table has no column {name!r}", where=self._where, found=found, remedy=RECOPY)
        first, stop = self._first + first, self._first + stop
        groups, skipped, begin = [], 0, 0
        for group in range(self._file.metadata.num_row_groups):
            end = begin + self._file.metadata.row_group(group).num_rows
            if end <= first:
                skipped = end
            elif begin < stop:
                groups.append(group)
            begin = end
        at = skipped
        read = self._file.iter_batches(batch_size=batch_rows, row_groups=groups, columns=names, use_threads=False)
        for batch in read if groups else ():
            low, high = max(first - at, 0), min(stop - at, batch.num_rows)
            at += batch.num_rows
            if low < high:
                yield batch.slice(low, high - low)
            if at >= stop:
                return
        if at < stop:
            raise ValueError(f"{at - skipped} rows where {stop - skipped} were counted")


def _values(column: pa.Array, feature: Feature, where: str) -> Sequence[Any] | npt.NDArray[Any]:
    """One value a row: arrays of the feature's shape, texts, or embedded images."""
    if isinstance(column, pa.ExtensionArray):
        column = column.storage
    if column.null_count:
        found = f"{column.null_count} of {len(column)} rows"
        raise LogError(f"{feature.name} is empty in some rows", where=where, found=found, remedy=RECOPY)
    if feature.kind == "text":
        return [str(text) for text in column.to_pylist()]
    if feature.kind == "image":
        return [_image(cell, feature, where) for cell in column.to_pylist()]
    n_rows, flat = len(column), column
    while pa.types.is_list(flat.type) or pa.types.is_large_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = flat.flatten()
    numbers = flat.to_numpy(zero_copy_only=False)
    if numbers.dtype.kind not in "biuf":
        raise LogError(f"{feature.name} does not hold numbers", where=where, found=str(column.type), remedy=RECOPY)
    shape = _row_shape(column, feature.shape, numbers.size, where)
    values: npt.NDArray[Any] = numbers.reshape(n_rows, *shape)
    values.flags.writeable = False
    return values


def _row_shape(column: pa.Array, stated: tuple[int, ...], n_values: int, where: str) -> tuple[int, ...]:
    """The shape of a row. LogError where rows differ in length, or hold other numbers than meta/info.json says."""
    expected = int(np.prod(stated, dtype=object))
    ragged = (pa.types.is_list(column.type) or pa.types.is_large_list(column.type)) and (
        len(set(np.diff(column.offsets.to_numpy()).tolist())) > 1
    )
    if ragged or n_values != len(column) * expected:
        found = f"{n_values} numbers in {len(column)} rows; meta/info.json says {list(stated)} each"
        raise LogError("rows of another shape than stated", where=where, found=found, remedy=RECOPY)
    return stated


def _image(cell: Any, feature: Feature, where: str) -> dict[str, Any]:
    data = cell.get("bytes") if isinstance(cell, dict) else cell
    if not isinstance(data, bytes):
        found = f"a path, {cell['path']!r}" if isinstance(cell, dict) and cell.get("path") else type(data).__name__
        remedy = "embed the images' bytes (lerobot and datasets do so when they save)"
        raise LogError(f"{feature.name} holds no image", where=where, found=found, remedy=remedy)
    return {"format": "png" if data.startswith(b"\x89PNG") else "jpeg", "data": data}
