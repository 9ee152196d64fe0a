"""A folder that appears whole, or not at all: written beside its name, synced, renamed."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from vilp_data import shards
from vilp_data.errors import BusyError, StoreError, UsageError

MANIFEST = "export.json"
"""The file that makes a folder an export: the only kind of folder that --force replaces."""

HEADROOM = 1.05


@contextlib.contextmanager
def out_folder(out: Path, *, force: bool, needed_bytes: int) -> Iterator[Path]:
    """A new empty folder that takes the name `out` when the block ends without an exception, and is gone otherwise.

    An `out` that holds an earlier export is replaced with `force`, and stays as it was until the new one is whole. Raises UsageError
    where `out` is in the way, StoreError where the disk has no room for `needed_bytes` or cannot be written, BusyError where another
    process is writing the same export."""
    out = out.absolute()
    require_free(out, force=force)
    temporary, aside = out.with_name(f".{out.name}.export.tmp"), out.with_name(f".{out.name}.export.old")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        require_space(out.parent, int(HEADROOM * needed_bytes))
        with _owned(temporary):
            try:
                if _put_back(aside, out):
                    require_free(out, force=force)
                yield temporary
                _sync(temporary)
                _take_place(temporary, out, aside)
            except BaseException:
                shutil.rmtree(temporary, ignore_errors=True)
                raise
        shards.sync_folder(out.parent)
    except OSError as error:
        remedy = "free some space, or check the folder's permissions; nothing was replaced"
        raise StoreError(
            "cannot be written", where=error.filename or out, found=error.strerror or str(error), remedy=remedy
        ) from error


def require_free(out: Path, *, force: bool) -> None:
    """UsageError where `out` exists: unless it is an empty folder, or an earlier export and `force` is given."""
    if not out.exists() and not out.is_symlink():
        return
    if out.is_dir() and not out.is_symlink():
        inside = sorted(entry.name for entry in out.iterdir())
        if not inside:
            return
        if MANIFEST in inside:
            if force:
                return
            raise UsageError(
                "there is an export already", where=out, remedy="--force replaces it, or name another folder with -o"
            )
        found = f"it holds {', '.join(inside[:5])}{' …' if len(inside) > 5 else ''}"
    else:
        found = "a link" if out.is_symlink() else "a file"
    raise UsageError(
        "in the way, and not an earlier export", where=out, found=found, remedy="name another folder with -o"
    )


def require_space(folder: Path, needed_bytes: int) -> None:
    """StoreError where the disk of `folder` has less room."""
    free = shutil.disk_usage(folder).free
    if free < needed_bytes:
        raise StoreError(
            "not enough room on the disk",
            where=folder,
            found=f"{free / 1e9:.2f} GB free, about {needed_bytes / 1e9:.2f} GB needed",
            remedy="free some space, or name another disk with -o",
        )


@contextlib.contextmanager
def _owned(temporary: Path) -> Iterator[None]:
    """The temporary folder, empty, and locked for this process; what a killed one left in it is cleared away."""
    temporary.mkdir(exist_ok=True)
    descriptor = os.open(temporary, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            remedy = "wait until it is done, or stop it"
            raise BusyError("another process is writing this export", where=temporary, remedy=remedy) from error
        for leftover in temporary.iterdir():
            shutil.rmtree(leftover) if leftover.is_dir() and not leftover.is_symlink() else leftover.unlink()
        yield
    finally:
        os.close(descriptor)


def _sync(folder: Path) -> None:
    """Every file and folder below, on disk."""
    for path in [folder, *folder.rglob("*")]:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _put_back(aside: Path, out: Path) -> bool:
    """Finish what a killed export left: the earlier export has its name again where the kill came before the new one took it, else is gone.
    Whether it came back."""
    if not aside.is_dir():
        return False
    if out.exists() and any(out.iterdir()):
        shutil.rmtree(aside, ignore_errors=True)
        return False
    aside.replace(out)
    shards.sync_folder(out.parent)
    return True


def _take_place(temporary: Path, out: Path, aside: Path) -> None:
    """Rename; an export that was there steps aside first, and comes back where the rename fails."""
    if not out.is_dir():
        temporary.rename(out)
        return
    out.rename(aside)
    try:
        temporary.rename(out)
    except BaseException:
        aside.rename(out)
        raise
    shards.sync_folder(out.parent)  # the old one goes when the new one has its name for good
    shutil.rmtree(aside, ignore_errors=True)
