"""Which dataset a command means when none is named."""

from __future__ import annotations

from pathlib import Path

from vilp_data.errors import UsageError

DATA = Path("data")
_LAST = Path(".vilp") / "last-dataset"


def default_root(task: str, preset: str | None) -> Path:
    """data/<task>; the tiny preset keeps a folder of its own, since its short recordings would spoil a real dataset."""
    return DATA / (f"{task}-tiny" if preset == "tiny" else task)


def find_dataset(given: Path | None) -> Path:
    """The dataset given; else the one the working folder lies in, the last one used here, the only one under data/.

    Raises UsageError, naming those there are."""
    if given is not None:
        if not is_dataset(given):
            raise UsageError("not a dataset: it has no dataset.json", where=given, remedy=_known())
        return given
    here = Path.cwd()
    for folder in (here, *here.parents):
        if is_dataset(folder):
            return folder
    if _LAST.is_file() and is_dataset(last := Path(_LAST.read_text(encoding="utf-8").strip())):
        return last
    under_data = _datasets()
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


def _datasets() -> list[Path]:
    return sorted(path.parent for path in DATA.glob("*/dataset.json"))


def _known() -> str:
    known = ", ".join(map(str, _datasets()))
    return (
        f"name its folder; under data/ there are: {known}"
        if known
        else "make one with `vilp-data ingest LOGS… --task NAME`"
    )
