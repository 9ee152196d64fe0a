"""The folder of a rollout: another takes its place only once it is whole, and nothing but a rollout is ever replaced."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vilp_data.errors import StoreError, UsageError
from vilp_data.locate import is_dataset

VIDEOS = ("best", "median", "worst")


@contextlib.contextmanager
def new_rollout(folder: Path) -> Iterator[Path]:
    """A new folder beside `folder`, which takes its place when the block ends without an exception, and else is removed: an earlier
    rollout stays until then.

    Raises as `require_replaceable` does, and StoreError for what the operating system refuses."""
    require_replaceable(folder)
    target = folder.resolve()
    making = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    with _refusals(folder):
        making.mkdir(parents=True)
    try:
        yield making
        require_replaceable(folder)  # someone may have written there meanwhile
        with _refusals(folder):
            _replace(target, making)
    except BaseException:
        shutil.rmtree(making, ignore_errors=True)
        raise


def _replace(target: Path, making: Path) -> None:
    """Two renames, since a folder that is not empty cannot be renamed over; a crash between them leaves both under other names."""
    before = making.with_suffix(".old")
    if target.exists():
        target.rename(before)
    try:
        making.rename(target)
    except BaseException:
        if before.exists():
            before.rename(target)
        raise
    shutil.rmtree(before, ignore_errors=True)


@contextlib.contextmanager
def _refusals(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        remedy = "name another folder with --out, or make room"
        raise StoreError("the rollout cannot be written", where=folder, found=error, remedy=remedy) from error


def require_replaceable(folder: Path) -> None:
    """Raise UsageError unless `folder` is new, empty, or holds a finished rollout and nothing else."""
    remedy = "name another folder with --out"
    if is_dataset(folder):
        raise UsageError("a rollout cannot take the place of a dataset", where=folder, remedy=remedy)
    if not folder.exists():
        return
    there = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if not path.is_dir()]
    table = find_rollout(folder)
    if not folder.is_dir() or (there and table is None):
        raise UsageError(
            "a rollout takes the place of another one alone, and this is something else: it has no rollout's report.json",
            where=folder,
            found=str(there[0]) if there else "a file",
            remedy=f"{remedy}, or empty this one yourself",
        )
    names = [episode["name"] for episode in table["episodes"]] if table is not None else []
    own = {Path("report.json"), Path("report.md"), *(Path("logs") / f"{name}.mcap" for name in names)}
    own |= {Path("videos") / f"{name}.mp4" for name in VIDEOS}
    if others := [path for path in there if path not in own]:
        raise UsageError(
            "this rollout cannot be replaced: files that are not its own lie beside it",
            where=folder,
            found=", ".join(map(str, others[:3])) + (", …" if len(others) > 3 else ""),
            remedy=f"{remedy}, or move them away",
        )


def find_rollout(folder: Path) -> dict[str, Any] | None:
    """The report.json of the finished rollout in `folder`; None where there is none, or a report of another kind."""
    try:
        table = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    is_rollout = isinstance(table, dict) and {"policy", "starts", "max_steps", "episodes"} <= table.keys()
    return table if is_rollout else None
