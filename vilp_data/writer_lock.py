"""One writer at a time of a dataset folder; and nobody reads an operation that is half done."""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

from vilp_data import journal
from vilp_data.errors import BusyError, StoreError

WAIT_S = 10.0
"""How long a reader waits for another process to finish its renames: these take milliseconds."""

_OWN = ("", "episodes", "latents", "action_sets", "history")
_SHARED = ("logs", "runs", "generated")
_LEFTOVER_AGE_S = 3600.0


@contextlib.contextmanager
def writer_lock(root: Path) -> Iterator[None]:
    """Be the only writer of the dataset at `root` for the length of the block, once what a killed writer had committed is finished.

    Raises BusyError at once where another process is writing."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(root / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise StoreError(
            "the dataset folder cannot be written",
            where=root,
            found=error.strerror,
            remedy="check its permissions, or choose another folder",
        ) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BusyError(
                "another process is writing this dataset", where=root, remedy="wait until it is done, or stop it"
            ) from error
        journal.settle(root)
        yield
    finally:
        os.close(descriptor)


def await_settled(root: Path) -> None:
    """Before reading: see that no operation is half done. Where its process is gone, this one finishes it.

    Raises BusyError where another process takes longer than WAIT_S, StoreError where the folder cannot be written."""
    deadline = time.monotonic() + WAIT_S
    while journal.is_pending(root):
        try:
            with writer_lock(root):
                return
        except BusyError:
            if time.monotonic() > deadline:
                raise
        time.sleep(0.01)


def leftovers(root: Path) -> list[Path]:
    """Temporary files that a killed writer left of what the lock is for. Call inside `writer_lock(root)`."""
    return [path for folder in _OWN for path, _ in _temporary(root, folder)]


def remove_leftovers(root: Path) -> None:
    """Delete them: whoever is about to write much makes room first. Recorders, trainers and `generate` write into
    logs/, runs/ and generated/ without the lock: there only what is old is surely nobody's."""
    oldest = time.time() - _LEFTOVER_AGE_S
    others = [path for folder in _SHARED for path, changed in _temporary(root, folder) if changed < oldest]
    for path in (*leftovers(root), *others):
        path.unlink(missing_ok=True)


def _temporary(root: Path, folder: str) -> list[tuple[Path, float]]:
    """Files, each with the time of its last change. Folders are others', who clear theirs away under locks of their own: see
    `whole_folder`."""
    found = []
    for path in sorted((root / folder).glob("**/.*.tmp" if folder else ".*.tmp")):
        with contextlib.suppress(FileNotFoundError):  # its owner was just done
            status = path.stat()
            if stat.S_ISREG(status.st_mode):
                found.append((path, status.st_mtime))
    return found
