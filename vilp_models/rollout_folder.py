"""The folder of a rollout: another takes its place only once it is whole, and nothing but a rollout is ever replaced."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vilp_data.errors import BusyError, UsageError
from vilp_data.locate import is_dataset
from vilp_data.whole_folder import put_back, whole_folder

KIND = "rollout"
VIDEOS = ("best", "median", "worst")


@contextlib.contextmanager
def new_rollout(folder: Path) -> Iterator[Path]:
    """A new folder that takes the place of `folder` when the block ends without an exception, and else is removed: an earlier rollout
    stays until then. What a killed one left there is put back, or cleared away.

    Raises as `require_replaceable` and `whole_folder` do."""
    require_replaceable(folder)
    with whole_folder(folder.resolve(), kind=KIND) as making:
        yield making
        require_replaceable(folder)  # someone may have written there meanwhile


def require_replaceable(folder: Path) -> None:
    """Raise UsageError unless `folder` is new, empty, or holds a finished rollout and nothing else."""
    remedy = "name another folder with --out"
    if is_dataset(folder):
        raise UsageError("a rollout cannot take the place of a dataset", where=folder, remedy=remedy)
    table = find_rollout(folder)
    if not folder.exists():
        return
    there = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if not path.is_dir()]
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
    with contextlib.suppress(BusyError):  # then there is none yet
        put_back(folder.resolve(), kind=KIND)
    try:
        table = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    is_rollout = isinstance(table, dict) and {"policy", "starts", "max_steps", "episodes"} <= table.keys()
    return table if is_rollout else None
