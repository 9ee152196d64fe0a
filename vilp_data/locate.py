"""Which dataset a command means when none is named."""

from __future__ import annotations

import shlex
from pathlib import Path

from vilp_data.errors import UsageError

DATA = Path("data")
_LAST = Path(".vilp") / "last-dataset"


def default_root(task: str, preset: str | None) -> Path:
    """data/<task>; the tiny preset keeps a folder of its own, since its short recordings would spoil a real dataset."""
    return DATA / (f"{task}-tiny" if preset == "tiny" else task)


def find_dataset(given: Path | None, *, emptied: bool = False) -> Path:
    """The dataset given; else the one the working folder lies in, the last one used here, the only one under data/. `emptied`: one of
    which every ingest was taken back counts too, since its history can bring them again.

    Raises UsageError, naming those there are."""
    counts = has_been_dataset if emptied else is_dataset
    if given is not None:
        if not counts(given):
            remedy = _bring_again(given) if has_been_dataset(given) else _known()
            raise UsageError("not a dataset: it has no dataset.json", where=given, remedy=remedy)
        return given
    here = Path.cwd()
    for folder in (here, *here.parents):
        if counts(folder):
            return folder
    if _LAST.is_file() and counts(last := Path(_LAST.read_text(encoding="utf-8").strip())):
        return last
    under_data = _datasets() or (_emptied() if emptied else [])
    if len(under_data) == 1:
        return under_data[0]
    raise UsageError("which dataset?", remedy=_known())


def remember(root: Path) -> None:
    """Note `root` as the last dataset used from this folder. A folder that cannot be written just forgets."""
    try:
        _LAST.parent.mkdir(exist_ok=True)
        _LAST.write_text(f"{root}\n", encoding="utf-8")
    except OSError:
        return


def is_dataset(folder: Path) -> bool:
    return (folder / "dataset.json").is_file()


def has_been_dataset(folder: Path) -> bool:
    """Whether a folder is a dataset, or holds the history of one whose every ingest was taken back."""
    return is_dataset(folder) or any((folder / "history").glob("[0-9]*.json"))


def a_dataset(folder: Path) -> UsageError:
    """What a verb that takes a log says of a dataset."""
    if not is_dataset(folder):
        return UsageError("not a dataset any more, and no log", where=folder, remedy=_bring_again(folder))
    quoted = shlex.quote(str(folder))
    remedy = f"`vilp-data check {quoted}` or `vilp-data card {quoted}` for the whole, `vilp-data view EPISODE --data {quoted}` for one"
    return UsageError("a dataset, not a log", where=folder, remedy=remedy)


def _datasets() -> list[Path]:
    return sorted(path.parent for path in DATA.glob("*/dataset.json"))


def _emptied() -> list[Path]:
    return sorted(folder for folder in DATA.glob("*/") if has_been_dataset(folder) and not is_dataset(folder))


def _bring_again(folder: Path) -> str:
    quoted = shlex.quote(str(folder))
    return (
        f"every ingest of it was taken back: `vilp-data log {quoted}` says by which operation, and `vilp-data undo {quoted} "
        "--operation N` brings again what that one took"
    )


def _known() -> str:
    known = ", ".join(map(str, _datasets()))
    return (
        f"name its folder; under data/ there are: {known}"
        if known
        else "make one with `vilp-data ingest LOGS… --task NAME`"
    )
