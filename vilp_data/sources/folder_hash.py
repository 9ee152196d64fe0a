"""The files of a log, be it a folder or a file, and their hash."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data.errors import LogError


def log_files(log: Path) -> dict[str, Path]:
    """Path below the folder, with slashes -> file, of every file in a folder; linked folders are entered, those that lead back into
    themselves once. Sorted by that path. A file is its own only one."""
    if not log.is_dir():
        return {log.name: log}
    found: dict[str, Path] = {}
    above = {str(log): frozenset({log.resolve()})}  # of each folder still to be entered: itself and those it lies in
    for name, folders, files in os.walk(log, followlinks=True):
        folder, entered = Path(name), above.pop(name)
        inside = {sub: (folder / sub).resolve() for sub in folders}
        folders[:] = [sub for sub in folders if inside[sub] not in entered]
        above |= {str(folder / sub): entered | {inside[sub]} for sub in folders}
        found |= {file.relative_to(log).as_posix(): file for file in map(folder.joinpath, files) if file.is_file()}
    return dict(sorted(found.items()))


def folder_sha256(folder: Path) -> str:
    """SHA-256 of the sorted relative paths of all files in a folder, their sizes and bytes; lower-case hex."""
    digest = hashlib.sha256()
    for name, file in log_files(folder).items():
        digest.update(name.encode(errors="surrogateescape") + b"\0" + file.stat().st_size.to_bytes(8, "little"))
        _add(digest, file)
    return digest.hexdigest()


def file_sha256(file: Path) -> str:
    """SHA-256 of a file's bytes, lower-case hex."""
    digest = hashlib.sha256()
    _add(digest, file)
    return digest.hexdigest()


def array_bytes(rows: npt.NDArray[Any]) -> bytes | memoryview:
    """What an array holds, to be hashed; without a copy where its rows lie together."""
    if rows.dtype.hasobject:
        return repr(rows.tolist()).encode()
    return np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data


def _add(digest: Any, file: Path) -> None:
    try:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise LogError("cannot be read", where=file, found=error.strerror, remedy="check its permissions") from error
