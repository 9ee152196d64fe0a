"""Bytes of a file by offset, a damaged or failing one too. Read, not mapped: a bad sector under a map kills the process."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from vilp_data.errors import LogError

WINDOW = 1 << 22  # bytes searched at a time
HEAD_SIZE = 16  # bytes that tell every format apart


def first_bytes(path: Path) -> bytes:
    """The first HEAD_SIZE bytes of a file, none of a folder; LogError where it cannot be opened."""
    try:
        if path.is_dir():
            next(path.iterdir(), None)
            return b""
        with path.open("rb") as stream:
            return stream.read(HEAD_SIZE)
    except OSError as error:
        raise LogError("cannot be opened", where=path, found=error.strerror, remedy="check its permissions") from error


class FileBytes:
    """An open file of fixed size: what is written to it after opening is not seen. LogError where the disk cannot read it."""

    def __init__(self, path: Path, *, stream: BinaryIO | None = None) -> None:
        """`stream`: the open file, where it is another than the one at `path`, which errors name."""
        self.path = path
        try:
            self._stream = stream or path.open("rb")
        except OSError as error:
            raise LogError(
                "cannot be opened", where=path, found=error.strerror, remedy="check its permissions"
            ) from error
        self.size = self._stream.seek(0, os.SEEK_END)

    def at(self, offset: int, length: int) -> bytes:
        """Up to `length` bytes from `offset`: fewer where the file ends."""
        if length <= 0 or offset >= self.size:
            return b""
        try:
            self._stream.seek(offset)
            return self._stream.read(min(length, self.size - offset))
        except OSError as error:
            remedy = "the disk fails: copy the file with ddrescue, which puts zeros where it cannot read, and salvage the copy"
            raise LogError(
                "cannot be read", where=self.path, found=f"{error.strerror} at byte {offset}", remedy=remedy
            ) from error

    def matches(self, pattern: re.Pattern[bytes], begin: int, *, longest: int) -> Iterator[tuple[int, bytes]]:
        """(offset, bytes) of every match from `begin` on, in order; a match has at most `longest` bytes."""
        while begin < self.size:
            window = self.at(begin, WINDOW + longest)
            for match in pattern.finditer(window):
                if match.start() >= WINDOW:
                    break
                yield begin + match.start(), match[0]
            begin += WINDOW

    def close(self) -> None:
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
