"""A long recording in pieces: what Rerun made so far goes to a file without a name, and together the pieces are one .rrd file.

Each reading of a Rerun stream begins with a header and ends with an index of the whole file, which is right only for a recording that
is read once. Of several pieces the first header is kept and no index: Rerun reads such a file from its beginning to its end, and
`rerun rrd optimize` adds one.
"""

from __future__ import annotations

import contextlib
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

from vilp_data.errors import StoreError

MAGIC = b"RRF2"
HEADER_BYTES = 12  # magic, version, options
MESSAGE = struct.Struct("<QQ")  # kind, bytes that follow
END = 0  # the kind of the message that holds the index
BLOCK_BYTES = 8 << 20


class RrdPieces:
    """`add` each reading, then take `blocks`. The file lies in `folder`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file: BinaryIO | None = None

    @property
    def any(self) -> bool:
        return self._file is not None

    def add(self, reading: bytes) -> None:
        """Raises StoreError where the disk is full."""
        messages = without_index(reading)
        try:
            if self._file is None:
                self._file = cast(BinaryIO, tempfile.TemporaryFile(dir=self._folder))  # noqa: SIM115
                messages = reading[:HEADER_BYTES] + messages
            self._file.write(messages)
            self._file.flush()
        except OSError as error:
            raise StoreError(
                "cannot be written",
                where=self._folder,
                found=error.strerror,
                remedy="free some space, or save elsewhere",
            ) from error

    def blocks(self) -> Iterator[bytes]:
        """All of it, some megabytes at a time."""
        if self._file is not None:
            self._file.seek(0)
            while block := self._file.read(BLOCK_BYTES):
                yield block

    def close(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # what a full disk refused once, it refuses again
                self._file.close()


def without_index(reading: bytes) -> bytes:
    """The messages of one reading of a stream, without its header and its index."""
    assert reading.startswith(MAGIC), "an encoding of Rerun's that this reads"
    at = HEADER_BYTES
    while at < len(reading):
        kind, size = MESSAGE.unpack_from(reading, at)
        if kind == END:
            break
        at += MESSAGE.size + size
    return reading[HEADER_BYTES:at]
