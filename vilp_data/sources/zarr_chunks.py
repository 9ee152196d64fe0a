"""The files of a zarr array's chunks, and what they inflate to: the codecs allocate whatever a chunk's own header says."""

from __future__ import annotations

import bz2
import lzma
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from vilp_data import limits

HEAD_BYTES = 32
DEFLATE_RATIO = 1032  # the most that deflate makes of a byte
STEP = 1 << 20


def chunk_files(array: Any, number: int) -> Iterator[str]:
    """Keys of the files that hold the rows of one chunk of the leading axis: chunks, or the shards they are in."""
    sizes = array.shards or array.chunks
    counts = [-(-length // size) for length, size in zip(array.shape, sizes, strict=True)]
    first = number * array.chunks[0] // sizes[0]
    for rest in np.ndindex(*counts[1:]):
        yield array.metadata.encode_chunk_key((first, *rest))


def inflated_bytes(array: Any, file: Path) -> int:
    """How many bytes a chunk's file becomes by its outermost codec; where that does not say, at most one more than
    limits.ARRAY_CHUNK_BYTES. Of a shard, and of codecs that inflate nothing, the file's own size."""
    size, codec = file.stat().st_size, "" if array.shards else _codec(array)
    with file.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
        if codec == "blosc" and len(head) >= 8:
            return int.from_bytes(head[4:8], "little")
        if codec == "lz4" and len(head) >= 4:
            return int.from_bytes(head[:4], "little")
        if codec == "zstd":
            claimed = _zstd_claim(head)
            return (
                claimed if claimed >= 0 else _counted(zstandard.ZstdDecompressor().stream_reader(head + stream.read()))
            )
        if codec in ("gzip", "zlib") and size * DEFLATE_RATIO <= limits.ARRAY_CHUNK_BYTES:
            return size
        stream.seek(0)
        if codec in ("gzip", "zlib"):
            return _counted(_Deflated(stream))
        if codec == "bz2":
            return _counted(bz2.BZ2File(stream))
        if codec == "lzma":
            return _counted(lzma.LZMAFile(stream))
    return size


def _codec(array: Any) -> str:
    """Name of the codec that is undone first, "" where there is none."""
    compressor = array.compressors[-1] if array.compressors else None
    name = getattr(compressor, "codec_id", None) or (compressor.to_dict()["name"] if compressor is not None else "")
    return str(name).removeprefix("numcodecs.")


def _zstd_claim(head: bytes) -> int:
    """Of a frame that is damaged 0: its codec says so. -1 where the frame does not tell."""
    try:
        return zstandard.frame_content_size(head)
    except zstandard.ZstdError:
        return 0


class _Deflated:
    """gzip or zlib, inflated a step at a time."""

    def __init__(self, stream: Any) -> None:
        self._stream, self._inflater = stream, zlib.decompressobj(32 + zlib.MAX_WBITS)

    def read(self, length: int) -> bytes:
        packed = self._inflater.unconsumed_tail or self._stream.read(length)
        return self._inflater.decompress(packed, length)


def _counted(stream: Any) -> int:
    size = 0
    try:
        while size <= limits.ARRAY_CHUNK_BYTES and (part := stream.read(STEP)):
            size += len(part)
    except (OSError, EOFError, zlib.error, lzma.LZMAError, zstandard.ZstdError):
        pass  # damaged: its codec says so
    return size
