"""Logs of every format through one door: `open_log(path)` looks at the content and returns a reader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from vilp_data.errors import LogError, UsageError
from vilp_data.sources.mcap_log import McapLog
from vilp_data.sources.mcap_records import MAGIC as MCAP_MAGIC
from vilp_data.sources.message_decoders import MessageError
from vilp_data.sources.zarr_log import ZarrLog
from vilp_data.types import I64, LogReader, Message

__all__ = ["FORMATS", "IndexedLog", "LogFormat", "MessageError", "open_log"]

HEAD_SIZE = 16  # bytes that tell every format here apart


class IndexedLog(LogReader, Protocol):
    """A `LogReader` that can also be looked at quickly, without reading it all."""

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n] in file order, as the index gives them; and whether they are all (else the first part)."""
        ...

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """Up to `limit` early messages of a topic, reading as little as possible."""
        ...


@dataclass(frozen=True)
class LogFormat:
    """One row of the table: how to tell a format, and how to open it (None: known by sight, not read)."""

    name: str
    matches: Callable[[Path, bytes], bool]
    open: Callable[[Path, float], IndexedLog] | None


# The first match wins. A new format is one reader and one line here.
FORMATS = (
    LogFormat("MCAP", lambda path, head: head.startswith(MCAP_MAGIC), lambda path, rate_hz: McapLog(path)),
    LogFormat("zarr", lambda path, head: _is_zarr(path), lambda path, rate_hz: ZarrLog(path, array_rate_hz=rate_hz)),
    LogFormat("ROS 1 bag", lambda path, head: head.startswith(b"#ROSBAG V"), None),
    LogFormat("SQLite (ROS 2 db3)", lambda path, head: head.startswith(b"SQLite format 3\0"), None),
    LogFormat("HDF5", lambda path, head: head.startswith(b"\x89HDF\r\n\x1a\n"), None),
)


def open_log(path: Path, *, array_rate_hz: float = 10.0) -> IndexedLog:
    """A reader for the log at `path`, its format told by content, not by suffix. Use it as a context manager.

    A rosbag2 folder (metadata.yaml beside one .mcap file) stands for the file in it. Split bags are not joined: a LogError.
    `array_rate_hz` is the rate of rows in logs that carry no time (zarr). UsageError where nothing is there; LogError where it
    is empty, not a log, a log of a format that is not read, or cut off."""
    if not path.exists():
        raise UsageError("no such log", where=path, remedy="check the path")
    if path.is_dir():
        path = _file_of_bag(path) or path
    head = _head(path)
    for log_format in FORMATS:
        if log_format.matches(path, head):
            if log_format.open is None:
                raise LogError(
                    f"a {log_format.name} log: not read yet", where=path, remedy=f"convert it to MCAP; {_readable()}"
                )
            return log_format.open(path, array_rate_hz)
    raise _not_a_log(path, head)


def _file_of_bag(folder: Path) -> Path | None:
    """The one MCAP file of a rosbag2 folder, None where the folder is none; LogError where it holds several."""
    if not (folder / "metadata.yaml").is_file():
        return None
    files = sorted(folder.glob("*.mcap"))
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        remedy = "split bags are not joined yet: name one file, or join them with `mcap merge`"
        raise LogError("the bag is split into several files", where=folder, found=names, remedy=remedy)
    return files[0] if files else None


def _is_zarr(path: Path) -> bool:
    return path.is_dir() and any((path / name).is_file() for name in (".zgroup", "zarr.json"))


def _head(path: Path) -> bytes:
    try:
        if path.is_dir():
            next(path.iterdir(), None)
            return b""
        with path.open("rb") as stream:
            return stream.read(HEAD_SIZE)
    except OSError as error:
        raise LogError("cannot be opened", where=path, found=error.strerror, remedy="check its permissions") from error


def _not_a_log(path: Path, head: bytes) -> LogError:
    if path.is_dir():
        inside = ", ".join(sorted(entry.name for entry in path.iterdir())[:5]) or "nothing"
        return LogError(
            "the folder is no log",
            where=path,
            found=f"no .zgroup; inside: {inside}",
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
        found = f"it begins with {head[:8]!r} instead of {MCAP_MAGIC!r}"
        remedy = "copy it again in binary mode (git: mark *.mcap as binary in .gitattributes)"
        return LogError(
            "an MCAP file mangled in transfer, its line endings converted", where=path, found=found, remedy=remedy
        )
    return LogError("not a log", where=path, found=f"it begins with {head!r}", remedy=_readable())


def _readable() -> str:
    names = [log_format.name for log_format in FORMATS if log_format.open is not None]
    return f"readable: {', '.join(names)}"
