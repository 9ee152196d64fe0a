"""The hash of a log, be it a folder or a file."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from vilp_data.errors import LogError


def folder_sha256(folder: Path) -> str:
    """SHA-256 of the sorted relative paths of all files in a folder, their sizes and bytes; lower-case hex."""
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*"), key=lambda file: file.relative_to(folder).as_posix()):
        if file.is_file():
            name = file.relative_to(folder).as_posix().encode()
            digest.update(name + b"\0" + file.stat().st_size.to_bytes(8, "little"))
            _add(digest, file)
    return digest.hexdigest()


def file_sha256(file: Path) -> str:
    """SHA-256 of a file's bytes, lower-case hex."""
    digest = hashlib.sha256()
    _add(digest, file)
    return digest.hexdigest()


def _add(digest: Any, file: Path) -> None:
    try:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise LogError("cannot be read", where=file, found=error.strerror, remedy="check its permissions") from error
