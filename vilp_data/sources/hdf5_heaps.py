"""The heaps in which HDF5 keeps texts, checked before the library follows them: a size that was damaged sends it round for ever."""

from __future__ import annotations

import mmap
from pathlib import Path

from vilp_data.errors import LogError, copy_again

SEARCHED_BYTES = 64 << 20
"""How much of a file is searched: texts lie beside the first groups, and a search costs a read."""

_START = b"GCOL\x01\0\0\0"  # signature, version 1, reserved
_HEADER, _OBJECT = 16, 16


def refuse_damaged_heaps(path: Path) -> None:
    """LogError where a global heap collection among the first SEARCHED_BYTES of a file holds an object that leaves it.

    A collection: `GCOL`, version, its size [8 bytes]; then objects: index [2], references [2], reserved [4], size [8], and as many
    bytes rounded up to 8. Index 0 is the room left, its size counted with the object's header."""
    with path.open("rb") as stream:
        if not path.stat().st_size:
            return
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            at = data.find(_START, 0, SEARCHED_BYTES)
            while at >= 0:
                size = int.from_bytes(data[at + 8 : at + _HEADER], "little")
                if not _is_whole(data, at, size):
                    found, remedy = f"at byte {at}", copy_again("file")
                    raise LogError("the HDF5 file is damaged: a heap of texts", where=path, found=found, remedy=remedy)
                at = data.find(_START, at + _HEADER, SEARCHED_BYTES)


def _is_whole(data: mmap.mmap, start: int, size: int) -> bool:
    end = start + size
    if end > len(data):
        return False
    at = start + _HEADER
    while end - at >= _OBJECT:
        index = int.from_bytes(data[at : at + 2], "little")
        length = int.from_bytes(data[at + 8 : at + _OBJECT], "little")
        need = _OBJECT + -(-length // 8) * 8 if index else length
        if need < _OBJECT or need > end - at:
            return False
        at += need
    return True
