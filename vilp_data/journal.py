"""Files of a dataset that take each other's place together: prepared first, then renamed, all or none of them.

The commit is one file, `history/pending.json`: a list of renames to be done. Before it is there, nothing has changed; once it is,
the renames are done by the process that wrote it or, where that was killed, by whoever opens the dataset next. Each can be tried
again: it is done where its source is gone. New files wait in `history/staged/`; a rename puts one in the place of an old one, so that
no name is ever without its file. What leaves the dataset waits in `history/held/<operation>/`, from where `undo` brings it back.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from vilp_data import shards
from vilp_data.errors import StoreError

JOURNAL_FORMAT = 1
Move = tuple[str, str]
"""A file's name now and the one to come, both below the dataset."""


def pending_path(root: Path) -> Path:
    return root / "history" / "pending.json"


def staged_folder(root: Path) -> Path:
    return root / "history" / "staged"


def held_folder(root: Path, number: int) -> Path:
    """Where files wait that operation `number` took out of the dataset."""
    return root / "history" / "held" / f"{number:04d}"


def commit(root: Path, moves: Sequence[Move], *, drop_index: bool = False) -> None:
    """Do all these renames, in order, or none, and delete the index of episodes before where it will be wrong. Every source must be on
    disk, whole. Call inside `writer_lock(root)`."""
    for folder in sorted({(root / now).parent for now, _ in moves}):
        shards.sync_folder(folder)
    table = {"format": JOURNAL_FORMAT, "moves": [list(move) for move in moves], "drop_index": drop_index}
    shards.write_atomic(pending_path(root), (json.dumps(table, indent=1) + "\n").encode())
    _finish(root)


def is_pending(root: Path) -> bool:
    """Whether an operation was committed whose renames are not all done."""
    return pending_path(root).is_file()


def settle(root: Path) -> None:
    """Finish what a killed process had committed, and clear away what it had only prepared. Call inside `writer_lock`."""
    if is_pending(root):
        _finish(root)
    shutil.rmtree(staged_folder(root), ignore_errors=True)


def keep_link(source: Path, target: Path) -> None:
    """Give a file a second name, under which it stays when the first one gets other content; a copy where links cannot be made.
    A `target` that is there already is left alone."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        return
    try:
        target.hardlink_to(source)
    except OSError:
        with source.open("rb") as file, shards.atomic_file(target) as copy:
            shutil.copyfileobj(file, copy)
    shards.sync_folder(target.parent)


def _finish(root: Path) -> None:
    path = pending_path(root)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        if table["format"] != JOURNAL_FORMAT:
            raise ValueError(f"format {table['format']!r}, this is {JOURNAL_FORMAT}")
        moves = [(str(now), str(then)) for now, then in table["moves"]]
        drop_index = bool(table.get("drop_index", True))  # not said by an older version
    except (ValueError, KeyError, TypeError) as error:
        remedy = "finish with the version that began it, or restore the folder from a backup"
        raise StoreError(
            "an operation was left half done, and cannot be read", where=path, found=str(error), remedy=remedy
        ) from error
    if drop_index:
        (root / "episodes" / "index.parquet").unlink(missing_ok=True)  # derived; one that is wrong would be believed
    try:
        _rename_all(root, moves)
    except OSError as error:
        found, remedy = error.strerror, "check the folder's permissions; any command on this dataset then finishes it"
        raise StoreError(
            "an operation was left half done", where=error.filename or root, found=found, remedy=remedy
        ) from error
    path.unlink()
    shards.sync_folder(path.parent)


def _rename_all(root: Path, moves: Sequence[Move]) -> None:
    for now, then in moves:
        source, target = root / now, root / then
        if source.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            source.replace(target)
        elif not target.exists():
            remedy = f"put it back, or strike it from {pending_path(root)}, and run any command again"
            raise StoreError("a file is gone that an operation was about to move", where=source, remedy=remedy)
    names = [Path(name) for move in moves for name in move]
    for folder in sorted({parent for name in names for parent in name.parents}):  # up to the root: some may be new
        if (root / folder).is_dir():
            shards.sync_folder(root / folder)
