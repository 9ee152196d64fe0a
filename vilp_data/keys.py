"""Keys: what a stored file depends on, as one digest. A file whose key is not today's is stale."""

from __future__ import annotations

import hashlib
import json
import mmap
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

FORMAT_VERSION = 1
"""Version of the episode and latent files. Raised when their bytes for the same input change."""

BLOCK_BYTES = 16 << 20


def digest(value: Any) -> str:
    """SHA-256 of plain data (dicts, lists, strings, numbers, None) in canonical JSON, lower-case hex."""
    return hashlib.sha256(
        json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    ).hexdigest()


def content_digest(*arrays: npt.NDArray[Any]) -> str:
    """SHA-256 over dtypes, shapes and bytes of arrays, in order."""
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(f"{array.dtype.str}{array.shape};".encode())
        for part in byte_blocks(array):
            sha.update(part)
    return sha.hexdigest()


def byte_blocks(array: npt.NDArray[Any]) -> Iterator[memoryview]:
    """The bytes of an array, row after row, some at a time. Of a mapped file only the block at hand is kept in memory: an episode's
    frames may be many times larger."""
    flat = np.asarray(array, order="C").reshape(-1).view(np.uint8)
    for start in range(0, len(flat), BLOCK_BYTES):
        yield flat[start : start + BLOCK_BYTES].data
        if isinstance(mapped := getattr(array, "_mmap", None), mmap.mmap):
            mapped.madvise(mmap.MADV_DONTNEED)


def episode_key(*, source_sha256: str, source_episode: str, ingest_fields: Mapping[str, Any]) -> str:
    """Key of an ingested episode: the SHA-256 of its source (a log, or one demonstration of a log that can tell its demonstrations
    apart), the demonstration's name, the resolved ingest spec, the format version."""
    return digest(
        {"format": FORMAT_VERSION, "source": source_sha256, "episode": source_episode, "ingest": dict(ingest_fields)}
    )


def trimmed_key(key: str, first_step: int, end_step: int) -> str:
    """Key of an episode of which some steps were left out since: that of its ingest, and which steps of the whole it keeps."""
    return f"{ingest_key(key)}:{first_step}-{end_step}"


def ingest_key(key: str) -> str:
    """The key that ingest gave an episode, whatever was trimmed since."""
    return key.partition(":")[0]


def first_difference(old: Any, new: Any, path: str = "") -> str | None:
    """`views.front.height: 96 -> 128`, for the first place in sorted order where plain data differs; None where nothing does."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in sorted({*old, *new}):
            place = f"{path}.{key}" if path else str(key)
            if key not in old or key not in new:
                return f"{place}: {'added' if key not in old else 'removed'}"
            difference = first_difference(old[key], new[key], place)
            if difference is not None:
                return difference
        return None
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        differences = (first_difference(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip(old, new, strict=True)))
        return next((difference for difference in differences if difference is not None), None)
    return None if old == new else f"{path}: {json.dumps(old)} -> {json.dumps(new)}"
