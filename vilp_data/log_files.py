"""Which files and folders are logs: what `ingest` takes when it is given a folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vilp_data.errors import UsageError

OTHER_LOGS = (".bag", ".db3", ".h5", ".hdf5", ".mcap.zstd", ".db3.zstd", ".mcap.active", ".bag.active")
"""Ends of the names of files that surely are logs, but of a format (or in a state) that is not read."""


@dataclass
class FoundLogs:
    """`logs` in sorted order within each folder, each once; `passed_over`: files in those folders that look like logs and are not
    read."""

    logs: list[Path] = field(default_factory=list)
    passed_over: list[Path] = field(default_factory=list)


def find_logs(paths: Sequence[Path]) -> FoundLogs:
    """The logs at `paths`: a path that is a log itself, or every log in a folder.

    Hidden files are nobody's logs. A rosbag2 folder of several files is given as that folder, which `open_log` refuses in words:
    its parts would become episodes that a split could tear apart. Raises UsageError for a path without any log."""
    found = FoundLogs()
    for path in paths:
        if not path.exists():
            raise UsageError("no such file or folder", where=path, remedy="check the path")
        if not path.is_dir() or is_zarr(path):
            found.logs.append(path)
            continue
        inside = list(_walk(path))
        logs = [entry for entry in inside if not entry.name.endswith(OTHER_LOGS)]
        others = [entry for entry in inside if entry.name.endswith(OTHER_LOGS)]
        if not logs:
            raise UsageError(
                "no logs in this folder",
                where=path,
                found=", ".join(other.name for other in others[:5]) or "no *.mcap file and no zarr folder",
                remedy="convert them to MCAP" if others else "give the logs themselves, or their folder",
            )
        found.logs += logs
        found.passed_over += others
    found.logs, found.passed_over = list(dict.fromkeys(found.logs)), list(dict.fromkeys(found.passed_over))
    return found


def is_zarr(path: Path) -> bool:
    return (path / ".zgroup").is_file() or (path / "zarr.json").is_file()


def _walk(folder: Path) -> Iterator[Path]:
    """Every log below a folder, readable or not, in sorted order. Zarr folders and split bags are not looked into."""
    if is_zarr(folder) or _is_split_bag(folder):
        yield folder
        return
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
        elif entry.name.endswith((".mcap", *OTHER_LOGS)):
            yield entry


def _is_split_bag(folder: Path) -> bool:
    metadata = folder / "metadata.yaml"
    if not metadata.is_file() or len(list(folder.glob("[!.]*.mcap"))) < 2:
        return False
    return b"rosbag2_bagfile_information" in metadata.read_bytes()
