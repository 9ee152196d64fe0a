"""Damaged logs into clean MCAP files, as far as their bytes go: `salvage_log` reads one log of any format that it knows."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO

from vilp_data.errors import LogError, UsageError
from vilp_data.salvage_report import SalvageReport
from vilp_data.shards import atomic_file
from vilp_data.sources.db3_log import MAGIC as SQLITE_MAGIC
from vilp_data.sources.db3_salvage import Db3Salvage
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.line_endings import is_converted, restore
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_plausible import next_run
from vilp_data.sources.mcap_records import MAGIC
from vilp_data.sources.mcap_salvage import McapSalvage
from vilp_data.sources.rosbag1_records import MAGIC as BAG_MAGIC
from vilp_data.sources.rosbag1_records import bag_record
from vilp_data.sources.rosbag1_salvage import Rosbag1Salvage

SALVAGE_RECORD = "vilp.salvage"
"""Name of the metadata record in which a salvaged log says what it is; a log that was whole does not get one."""


def salvage_log(log: Path, out: Path, *, force: bool = False, drop_suspicious: bool = False) -> SalvageReport:
    """Write every message that `log` still gives to `out`, a clean MCAP, and say what was lost. `log` is never changed.

    A whole log is copied: an MCAP byte for byte, another format into MCAP. Messages keep their bytes, times and sequence numbers;
    those over which a checksum fails are kept and counted as suspicious, or with `drop_suspicious` left out.

    UsageError where `log` is not there, or `out` is (unless `force`). LogError where nothing can be recovered: then `out` is left as it
    was. `out` appears only when it is complete."""
    _check_paths(log, out, force)
    report = SalvageReport(str(log), str(out), "mcap", log.stat().st_size)
    with ExitStack() as stack:
        source = stack.enter_context(FileBytes(log))
        if source.size == 0:
            raise LogError(
                "the log is empty", where=log, found="0 bytes", remedy="record it again, or look for another copy"
            )
        if is_converted(source.at(0, 16)):
            source = stack.enter_context(_unconverted(source, report))
        with atomic_file(out) as stream:
            _salvage(source, stream, report, drop_suspicious)
            if not report.whole and not (report.recovered or report.attachments or report.metadata_records):
                found = "; ".join([*report.doubts, *report.notes]) or f"{report.size_bytes:,} bytes"
                remedy = "look for another copy; no message of it is left here"
                raise LogError("nothing can be recovered", where=log, found=found, remedy=remedy)
    return report


def _unconverted(source: FileBytes, report: SalvageReport) -> FileBytes:
    """The log with its line endings as they were, in a file that has no name."""
    copy = tempfile.TemporaryFile()  # noqa: SIM115 - the reader closes it
    report.repaired = restore(source, copy)
    report.note(
        "a transfer converted the log's line endings: copy it again in binary mode if the original still exists"
    )
    return FileBytes(source.path, stream=copy)


def _check_paths(log: Path, out: Path, force: bool) -> None:
    if not log.exists():
        raise UsageError("no such log", where=log, remedy="check the path")
    if log.is_dir():
        raise UsageError("a folder, not a log", where=log, remedy="name the damaged file in it")
    if out.is_dir():
        raise UsageError("a folder is in the way", where=out, remedy="name a file, such as clean.mcap")
    if out.exists() and out.samefile(log):
        raise UsageError("the log itself would be overwritten", where=out, remedy="name another file with -o")
    if out.exists() and not force:
        raise UsageError(
            "the file is there already", where=out, remedy="name another file, or overwrite it with --force"
        )


def _salvage(source: FileBytes, stream: BinaryIO, report: SalvageReport, drop_suspicious: bool) -> None:
    head, clean = source.at(0, 16), CleanMcap(stream)
    if head.startswith(SQLITE_MAGIC):
        report.format = "db3"
        Db3Salvage(source, clean, report).run()
    elif head.startswith(BAG_MAGIC[:8]) or bag_record(source.at, len(BAG_MAGIC)) is not None:
        report.format = "bag"
        Rosbag1Salvage(source, clean, report, drop_suspicious=drop_suspicious).run()
    elif head.startswith(MAGIC) or next_run(source, 0, (), None) < source.size:
        McapSalvage(source, clean, report, drop_suspicious=drop_suspicious).run()
    else:
        raise LogError(
            "not a log that can be salvaged",
            where=source.path,
            found=f"it begins with {head!r}",
            remedy="salvage reads MCAP, ROS 1 bags and db3",
        )
    if report.whole and report.format == "mcap":
        _copy(source, stream)
        return
    if not report.whole:
        clean.add_metadata(SALVAGE_RECORD, _about(source, report))
    clean.finish()


def _about(source: FileBytes, report: SalvageReport) -> dict[str, str]:
    """What the clean file says of itself; nothing in it depends on when or where it was made."""
    about = {
        "source": source.path.name,
        "salvaged_by": f"vilp {version('vilp')}",
        "recovered": str(report.recovered),
        "lost": "unknown" if report.lost is None else str(report.lost),
        "suspicious": str(report.suspicious),
    }
    about |= {f"suspicious {name}": str(topic.suspicious) for name, topic in report.topics.items() if topic.suspicious}
    return about


def _copy(source: FileBytes, stream: BinaryIO) -> None:
    stream.seek(0)
    stream.truncate()
    for begin in range(0, source.size, 1 << 20):
        stream.write(source.at(begin, 1 << 20))
