"""The folder of an export: another takes its place only once it is whole, and with --force."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from vilp_data.errors import StoreError, UsageError
from vilp_data.whole_folder import put_back, whole_folder

MANIFEST = "export.json"
"""The file that makes a folder an export: the only kind of folder that --force replaces."""

KIND = "export"

HEADROOM = 1.05


@contextlib.contextmanager
def out_folder(out: Path, *, force: bool, needed_bytes: int) -> Iterator[Path]:
    """A new empty folder that takes the name `out` when the block ends without an exception, and is gone otherwise.

    An `out` that holds an earlier export is replaced with `force`, and stays as it was until the new one is whole. Raises UsageError
    where `out` is in the way, StoreError where the disk has no room for `needed_bytes` or cannot be written, BusyError where another
    process is writing the same export."""
    out = out.absolute()
    put_back(out, kind=KIND)
    require_free(out, force=force)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        require_space(out.parent, int(HEADROOM * needed_bytes))
        with whole_folder(out, kind=KIND) as folder:
            yield folder
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
