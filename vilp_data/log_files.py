"""Which files and folders are logs: what `ingest` takes when it is given a folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vilp_data.errors import LogError, UsageError
from vilp_data.sources.lerobot_meta import is_lerobot
from vilp_data.sources.rosbag2_metadata import is_bag_folder, lone_file, read_metadata

READ_LOGS = (".mcap", ".bag", ".db3", ".mcap.zstd", ".db3.zstd", ".h5", ".hdf5")
OTHER_LOGS = (".mcap.active", ".bag.active")
"""Ends of the names of files that surely are logs, but of a format (or in a state) that is not read."""


@dataclass
class FoundLogs:
    """`logs` in sorted order within each folder, each once; `passed_over`: files in those folders that look like logs and are not
    read."""

    logs: list[Path] = field(default_factory=list)
    passed_over: list[Path] = field(default_factory=list)


def find_logs(paths: Sequence[Path]) -> FoundLogs:
    """The logs at `paths`: a path that is a log itself, or every log in a folder.

    Hidden files are nobody's logs. The folder of a ROS 2 bag is one log: its parts alone would become episodes that a split could
    tear apart. Files in it that its metadata.yaml does not list are logs of their own. Raises UsageError for a path without any log."""
    found = FoundLogs()
    for path in paths:
        if not path.exists():
            raise UsageError("no such file or folder", where=path, remedy="check the path")
        if not path.is_dir() or is_one_log(path):
            found.logs.append(path)
            continue
        inside = list(_walk(path))
        logs = [entry for entry in inside if not entry.name.endswith(OTHER_LOGS)]
        others = [entry for entry in inside if entry.name.endswith(OTHER_LOGS)]
        if not logs:
            raise UsageError(
                "no logs in this folder",
                where=path,
                found=", ".join(other.name for other in others[:5])
                or "no *.mcap, *.bag, *.db3 or *.hdf5 file, and no zarr or LeRobot folder",
                remedy="`vilp-data salvage` closes what a recorder left open"
                if others
                else "give the logs themselves, or their folder",
            )
        found.logs += logs
        found.passed_over += others
    found.logs, found.passed_over = list(dict.fromkeys(found.logs)), list(dict.fromkeys(found.passed_over))
    return found


def is_zarr(path: Path) -> bool:
    return (path / ".zgroup").is_file() or (path / "zarr.json").is_file()


def is_one_log(folder: Path) -> bool:
    """Whether a folder as a whole is one log: a zarr store, a LeRobot dataset."""
    return is_zarr(folder) or is_lerobot(folder)


def _walk(folder: Path) -> Iterator[Path]:
    """Every log below a folder, readable or not, in sorted order. Folders that are one log are not looked into."""
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
    for entry in entries:
        if entry.is_dir():
            if not entry.is_symlink():  # which may lead back here
                yield from _walk(entry)
        elif entry.name.endswith((*READ_LOGS, *OTHER_LOGS)) and entry not in parts:
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
