"""Which files and folders are logs: what `ingest` takes when it is given a folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vilp_data.errors import LogError, UsageError, salvage_command, some_of
from vilp_data.locate import a_dataset, has_been_dataset
from vilp_data.sources.lerobot_meta import is_lerobot
from vilp_data.sources.rosbag2_metadata import is_bag_folder, lone_file, read_metadata
from vilp_data.sources.zarr_log import is_zarr

READ_LOGS = (".mcap", ".bag", ".db3", ".mcap.zstd", ".db3.zstd", ".h5", ".hdf5")
OTHER_LOGS = (".mcap.active", ".bag.active")
"""Ends of the names of recordings that were not closed: logs that only salvage reads."""


@dataclass
class FoundLogs:
    """`logs` in sorted order within each folder, each once; `passed_over`: what those folders hold beside, that looks like a log and is
    not read: recordings left open, and links that lead nowhere or back."""

    logs: list[Path] = field(default_factory=list)
    passed_over: list[Path] = field(default_factory=list)


def find_logs(paths: Sequence[Path]) -> FoundLogs:
    """The logs at `paths`: a path that is a log itself, or every log in a folder.

    Suffixes count in either case, linked folders as any other. Hidden files are nobody's logs. The folder of a ROS 2 bag is one log: its
    parts alone would become episodes that a split could tear apart. Files in it that its metadata.yaml does not list are logs of their
    own. Raises UsageError for a path without any log."""
    found = FoundLogs()
    for path in paths:
        if not path.exists():
            raise UsageError("no such file or folder", where=path, remedy="check the path")
        if not path.is_dir() or is_one_log(path):
            found.logs.append(path)
            continue
        logs: list[Path] = []
        others: list[Path] = []
        for entry in _walk(path, frozenset()):
            (others if _is_passed_over(entry) else logs).append(entry)
        if not logs:
            raise _no_logs(path, others)
        found.logs += logs
        found.passed_over += others
    found.logs, found.passed_over = list(dict.fromkeys(found.logs)), list(dict.fromkeys(found.passed_over))
    return found


def is_one_log(folder: Path) -> bool:
    """Whether a folder as a whole is one log: a zarr store, a LeRobot dataset."""
    return is_zarr(folder) or is_lerobot(folder)


def _no_logs(folder: Path, others: list[Path]) -> UsageError:
    if has_been_dataset(folder):
        return a_dataset(folder)
    if (folder / ".lock").is_file():
        remedy = "run the same `vilp-data ingest` again, or delete the folder"
        return UsageError("a dataset that holds no episode yet: its ingest was stopped", where=folder, remedy=remedy)
    left_open = [other for other in others if other.name.lower().endswith(OTHER_LOGS)]
    if left_open:
        remedy = f"{salvage_command(left_open[0])} closes what a recorder left open"
    else:
        remedy = "mend the links" if others else "give the logs themselves, or their folder"
    nothing = "no *.mcap, *.bag, *.db3 or *.hdf5 file, and no zarr or LeRobot folder"
    found = some_of([other.name for other in others], 5) or nothing
    return UsageError("no logs in this folder", where=folder, found=found, remedy=remedy)


def _is_passed_over(entry: Path) -> bool:
    return entry.name.lower().endswith(OTHER_LOGS) or _leads_nowhere(entry)


def _leads_nowhere(entry: Path) -> bool:
    """Whether a link leads to nothing, or to a folder that it lies in."""
    if not entry.is_symlink():
        return False
    return not entry.exists() or (entry.is_dir() and entry.parent.resolve().is_relative_to(entry.resolve()))


def _walk(folder: Path, entered: frozenset[Path]) -> Iterator[Path]:
    """Every log below a folder, readable or not, in sorted order, and links that cannot be followed. Folders that are one log are not
    looked into, those of `entered` not again."""
    if is_one_log(folder):
        yield folder
        return
    bag, parts = _bag(folder)
    if bag is not None:
        yield bag
    try:
        entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise UsageError(
            "the folder cannot be read", where=folder, found=error.strerror, remedy="check its permissions"
        ) from error
    entered |= {folder.resolve()}
    for entry in entries:
        if _leads_nowhere(entry):
            yield entry
        elif entry.is_dir():
            if entry.resolve() not in entered:
                yield from _walk(entry, entered)
        elif entry.name.lower().endswith((*READ_LOGS, *OTHER_LOGS)) and entry not in parts:
            yield entry


def _bag(folder: Path) -> tuple[Path | None, set[Path]]:
    """The ROS 2 bag that a folder is, or the file it stands for, None where it is none; and the files that belong to it. One whose
    metadata.yaml cannot be understood is given as the folder, with every file in it: `open_log` says what is wrong."""
    if not is_bag_folder(folder):
        return None, set()
    try:
        return lone_file(folder) or folder, set(read_metadata(folder).files)
    except LogError:
        return folder, set(folder.iterdir())
