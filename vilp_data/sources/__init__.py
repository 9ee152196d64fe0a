"""Logs of every format through one door: `open_log(path)` looks at the content and returns a reader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from vilp_data.errors import LogError, UsageError, mangled
from vilp_data.sources.db3_log import MAGIC as SQLITE_MAGIC
from vilp_data.sources.db3_log import Db3Log
from vilp_data.sources.file_bytes import first_bytes
from vilp_data.sources.hdf5_log import Hdf5Log
from vilp_data.sources.hdf5_tree import MAGIC as HDF5_MAGIC
from vilp_data.sources.lerobot_log import LeRobotLog
from vilp_data.sources.lerobot_meta import is_lerobot
from vilp_data.sources.mcap_log import McapLog
from vilp_data.sources.mcap_records import MAGIC as MCAP_MAGIC
from vilp_data.sources.message_decoders import ZSTD_MAGIC, MessageError
from vilp_data.sources.rosbag1_log import Rosbag1Log
from vilp_data.sources.rosbag2_log import Rosbag2Log
from vilp_data.sources.rosbag2_metadata import is_bag_folder, lone_file
from vilp_data.sources.zarr_log import ZarrLog, is_zarr
from vilp_data.types import I64, LogReader, Message

__all__ = ["FORMATS", "IndexedLog", "LogFormat", "MessageError", "open_log"]


class IndexedLog(LogReader, Protocol):
    """A `LogReader` that can also be looked at quickly, without reading it all."""

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n] in file order, as the index gives them; and whether they are all (else the first part)."""
        ...

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """Up to `limit` early messages of a topic, reading as little as possible."""
        ...

    def doubts(self) -> list[str]:
        """Sentences on what seems to be missing, though all that is there can be read: what says so, and how much there is."""
        ...


@dataclass(frozen=True)
class LogFormat:
    """One row of the table: how to tell a format by its path and first bytes, and how to open it."""

    name: str
    matches: Callable[[Path, bytes], bool]
    open: Callable[[Path, float], IndexedLog]


# The first match wins. A new format is one reader and one line here.
FORMATS = (
    LogFormat("MCAP", lambda path, head: head.startswith(MCAP_MAGIC), lambda path, rate_hz: McapLog(path)),
    LogFormat("zarr", lambda path, head: is_zarr(path), lambda path, rate_hz: ZarrLog(path, array_rate_hz=rate_hz)),
    LogFormat("LeRobot", lambda path, head: is_lerobot(path), lambda path, rate_hz: LeRobotLog(path)),
    LogFormat("ROS 1 bag", lambda path, head: head.startswith(b"#ROSBAG V"), lambda path, rate_hz: Rosbag1Log(path)),
    LogFormat("ROS 2 bag", lambda path, head: _is_rosbag2(path, head), lambda path, rate_hz: Rosbag2Log(path)),
    LogFormat("ROS 2 db3", lambda path, head: head.startswith(SQLITE_MAGIC), lambda path, rate_hz: Db3Log(path)),
    LogFormat(
        "HDF5",
        lambda path, head: head.startswith(HDF5_MAGIC),
        lambda path, rate_hz: Hdf5Log(path, array_rate_hz=rate_hz),
    ),
)


def open_log(path: Path, *, array_rate_hz: float = 10.0) -> IndexedLog:
    """A reader for the log at `path`, its format told by content, not by suffix. Use it as a context manager.

    The folder of a ROS 2 bag (metadata.yaml beside its files) is one log; one of a single plain file stands for that file.
    `array_rate_hz` is the rate of rows in logs that carry no time (zarr). UsageError where nothing is there; LogError where it
    is empty, not a log, a log of a format that is not read, or cut off."""
    if not path.exists():
        raise UsageError("no such log", where=path, remedy="check the path")
    if is_bag_folder(path):
        path = lone_file(path) or path
    head = first_bytes(path)
    for log_format in FORMATS:
        if log_format.matches(path, head):
            return log_format.open(path, array_rate_hz)
    raise _not_a_log(path, head)


def _is_rosbag2(path: Path, head: bytes) -> bool:
    """A bag's folder, or one compressed file of a bag."""
    return is_bag_folder(path) or head.startswith(ZSTD_MAGIC)


def _not_a_log(path: Path, head: bytes) -> LogError:
    if path.is_dir():
        inside = ", ".join(sorted(entry.name for entry in path.iterdir())[:5]) or "nothing"
        return LogError(
            "the folder is no log",
            where=path,
            found=f"no metadata.yaml of a bag, no .zgroup; inside: {inside}",
            remedy=f"name the logs in it; {_readable()}",
        )
    if not head:
        return LogError(
            "the log is empty", where=path, found="0 bytes", remedy="record it again, or copy it again from its source"
        )
    if MCAP_MAGIC.startswith(head):
        return LogError(
            "the log is cut off inside its first mark",
            where=path,
            found=f"{len(head)} bytes",
            remedy="copy it again from its source",
        )
    if head.startswith(MCAP_MAGIC[:5]):
        return mangled("an MCAP file", path, head[:9])
    return LogError("not a log", where=path, found=f"it begins with {head!r}", remedy=_readable())


def _readable() -> str:
    return f"readable: {', '.join(log_format.name for log_format in FORMATS)}"
