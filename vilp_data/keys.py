"""Keys: what a stored file depends on, as one digest. A file whose key is not today's is stale."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy.typing as npt

FORMAT_VERSION = 1
"""Version of the episode and latent files. Raised when their bytes for the same input change."""


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
        sha.update(array.tobytes())
    return sha.hexdigest()


def episode_key(*, source_sha256: str, source_episode: str, ingest_fields: Mapping[str, Any]) -> str:
    """Key of an ingested episode: the log's bytes, which demonstration in it, the resolved ingest spec, the format version."""
    return digest(
        {"format": FORMAT_VERSION, "source": source_sha256, "episode": source_episode, "ingest": dict(ingest_fields)}
    )
