"""A folder that appears whole, or not at all: written beside its name, synced, renamed; what had the name steps aside first.

`.NAME.KIND.tmp` is being written, `.NAME.KIND.old` is what it takes the place of, and `.NAME.KIND.lock` is held by the process that does
so. What a killed one left is put back, or cleared away, by the next that writes the same folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from vilp_data import shards
from vilp_data.errors import BusyError, StoreError


@contextlib.contextmanager
def whole_folder(target: Path, *, kind: str) -> Iterator[Path]:
    """A new empty folder that takes the name `target` when the block ends without an exception, and is gone otherwise: a folder that
    is there stays until then. `kind` is what it is, in file names and messages: "export", "rollout".

    Raises BusyError where another process is writing the same one, StoreError for what the operating system refuses outside the block."""
    making, aside = _beside(target, kind, "tmp"), _beside(target, kind, "old")
    with _only_writer(target, kind):
        with _refusals(target, kind):
            _settle(target, aside)
            if making.exists():
                shutil.rmtree(making)
            making.mkdir()
        try:
            yield making
            with _refusals(target, kind):
                _sync(making)
                _take_place(making, target, aside)
        except BaseException:
            shutil.rmtree(making, ignore_errors=True)
            raise
        with _refusals(target, kind):
            shards.sync_folder(target.parent)


def put_back(target: Path, *, kind: str) -> None:
    """Where a process was killed after the folder `target` had stepped aside and before the new one had its name: give it back. To be
    asked before reading `target`.

    Raises BusyError where another process is writing the folder, StoreError where it cannot be renamed."""
    aside = _beside(target, kind, "old")
    if aside.is_dir() and _is_free(target):
        with _only_writer(target, kind), _refusals(target, kind):
            _settle(target, aside)


def _beside(target: Path, kind: str, suffix: str) -> Path:
    return target.parent / f".{target.name}.{kind}.{suffix}"


def _is_free(target: Path) -> bool:
    return not target.exists() or (target.is_dir() and not any(target.iterdir()))


@contextlib.contextmanager
def _only_writer(target: Path, kind: str) -> Iterator[None]:
    """Hold the lock file, which goes with the block. The system lets go of it where the process is killed."""
    lock = _beside(target, kind, "lock")
    with _refusals(target, kind):
        target.parent.mkdir(parents=True, exist_ok=True)
        descriptor = _locked(lock)
    if descriptor is None:
        remedy = "wait until it is done, or stop it"
        raise BusyError(f"another process is writing this {kind}", where=target, remedy=remedy)
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)  # before it is let go: whoever opened it meanwhile sees that the name is gone
        os.close(descriptor)


def _locked(lock: Path) -> int | None:
    """A descriptor that holds the lock; None where another process does."""
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        with contextlib.ExitStack() as opened:
            opened.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return None
            with contextlib.suppress(FileNotFoundError):  # its holder was just done, and took the name away
                if os.path.samestat(os.fstat(descriptor), lock.stat()):
                    opened.pop_all()
                    return descriptor


def _settle(target: Path, aside: Path) -> None:
    """Finish what a killed process left: the earlier folder has its name again where the kill came before the new one took it, else it
    is gone."""
    if not aside.is_dir():
        return
    if _is_free(target):
        aside.replace(target)
        shards.sync_folder(target.parent)
    else:
        shutil.rmtree(aside, ignore_errors=True)


def _take_place(making: Path, target: Path, aside: Path) -> None:
    """Two renames, since a folder that is not empty cannot be renamed over."""
    if not target.is_dir():
        making.rename(target)
        return
    target.rename(aside)
    try:
        making.rename(target)
    except BaseException:
        aside.rename(target)
        raise
    shards.sync_folder(target.parent)  # the old one goes when the new one has its name for good
    shutil.rmtree(aside, ignore_errors=True)


def _sync(folder: Path) -> None:
    """Every file and folder below, on disk."""
    for path in [folder, *folder.rglob("*")]:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def _refusals(target: Path, kind: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"the {kind} cannot be written",
            where=error.filename or target,
            found=error.strerror or str(error),
            remedy="free some space, or check the folder's permissions; nothing was replaced",
        ) from error
