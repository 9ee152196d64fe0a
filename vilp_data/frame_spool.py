"""Frames of one size that come one by one and may be too many for the memory: kept in it up to a limit, then in a file without a
name, which is gone whatever ends the process."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from vilp_data.errors import StoreError
from vilp_data.types import I64, U8

IN_MEMORY_BYTES = 32 << 20
"""More than this, of one view, goes to the file."""

BLOCK_BYTES = 8 << 20


class FrameSpool:
    """Append frames uint8 [H,W,C], then take those that are wanted. The file lies in `folder`, or where temporary files do."""

    def __init__(self, folder: Path | None = None, *, in_memory_bytes: int = IN_MEMORY_BYTES) -> None:
        self._folder, self._limit = folder, in_memory_bytes
        self._frames: list[U8] = []
        self._file: BinaryIO | None = None
        self._count = 0
        self._shape: tuple[int, ...] = ()

    def __len__(self) -> int:
        return self._count

    def append(self, frame: U8) -> int:
        """Keep a frame; its row. Raises StoreError where the disk is full."""
        self._shape = frame.shape
        if self._file is not None:
            self._write(self._file, np.ascontiguousarray(frame))
        else:
            # A copy, where the frame is a view of a message that would be kept with it.
            self._frames.append(frame if frame.base is None else frame.copy())
            if (self._count + 1) * frame.nbytes > self._limit:
                self._file = self._new_file()
                for kept in self._frames:
                    self._write(self._file, np.ascontiguousarray(kept))
                self._frames.clear()
        self._count += 1
        return self._count - 1

    def take(self, rows: I64) -> U8:
        """uint8 [n,H,W,C] of these rows, in this order. Beyond the limit it is a map of a file, read as it is touched."""
        if self._file is None:
            return np.stack([self._frames[row] for row in rows.tolist()])
        if np.array_equal(rows, np.arange(self._count)):
            return self._mapped(self._file, self._count)
        everything, chosen = self._mapped(self._file, self._count), self._new_file()
        step = max(1, BLOCK_BYTES // max(1, everything[0].nbytes))
        for start in range(0, len(rows), step):
            self._write(chosen, everything[rows[start : start + step]])
        return self._mapped(chosen, len(rows))

    def _new_file(self) -> BinaryIO:
        try:
            return cast(BinaryIO, tempfile.TemporaryFile(dir=self._folder, buffering=BLOCK_BYTES))
        except OSError as error:
            raise self._refused(error) from error

    def _write(self, file: BinaryIO, frames: U8) -> None:
        try:
            file.write(frames.data)
        except OSError as error:
            raise self._refused(error) from error

    def _mapped(self, file: BinaryIO, count: int) -> U8:
        try:
            file.flush()
        except OSError as error:
            raise self._refused(error) from error
        return np.memmap(file, np.uint8, mode="r", shape=(count, *self._shape))

    def _refused(self, error: OSError) -> StoreError:
        where, remedy = (
            self._folder or tempfile.gettempdir(),
            "free some space there, or cut the log into demonstrations",
        )
        return StoreError("no room for an episode's frames", where=where, found=error.strerror, remedy=remedy)
