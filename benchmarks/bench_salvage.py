"""Salvage against what the Python readers and rerun get out of the same damaged logs: how many messages, and how fast.

    python benchmarks/bench_salvage.py

The mcap library's stream reader (the one that needs no index) and rosbags' readers count what they yield before they give up; of
`rerun mcap convert --recover` the messages in the recording that it writes are counted (the command's start included in its time).
Salvage also inflates what they leave, checks every checksum, and writes the clean MCAP with fsync; the readers write nothing.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import Stores, get_typestore

from vilp_data.errors import LogError
from vilp_data.salvage import salvage_log

MESSAGES, BYTES = 1500, 8000
LAYOUTS: dict[str, dict[str, Any]] = {
    "mcap none": {"compression": CompressionType.NONE},
    "mcap lz4": {"compression": CompressionType.LZ4},
    "mcap zstd": {"compression": CompressionType.ZSTD},
    "mcap zstd, one chunk": {"compression": CompressionType.ZSTD, "chunk_size": 1 << 40},
    "mcap unchunked": {"use_chunking": False},
}


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="vilp-bench-"))
    print(f"salvage, {MESSAGES} messages of about {BYTES} bytes; messages got back, and MB/s of damaged log")
    columns = f"{'the reader':>18s} {'rerun --recover':>18s} {'salvage':>18s} {'suspicious':>10s} {'lost':>6s}"
    print(f"  {'log':20s} {'damage':16s} {columns}")
    try:
        for name, options in LAYOUTS.items():
            path = folder / "run.mcap"
            write_mcap(path, options)
            compare(name, path, mcap_count, rerun_count)
        for compression in ("none", "lz4", "bz2"):
            path = folder / "run.bag"
            write_bag(path, compression)
            compare(f"bag {compression}", path, rosbags_count)
        path = folder / "run.db3"
        write_db3(path)
        compare("db3", path, db3_count)
    finally:
        shutil.rmtree(folder)


def compare(name: str, path: Path, count: Callable[[Path], int], other: Callable[[Path], int] | None = None) -> None:
    content = path.read_bytes()
    middle = len(content) // 2
    damages = {
        "none": content,
        "cut at 70 %": content[: len(content) * 7 // 10],
        "a byte flipped": content[:middle] + bytes([content[middle] ^ 16]) + content[middle + 1 :],
        "4 kB zeroed": content[:middle] + bytes(4096) + content[middle + 4096 :],
    }
    for damage, damaged in damages.items():
        path.write_bytes(damaged)
        size = len(damaged) / 1e6
        theirs, their_s = timed(lambda: count(path))
        (ours, suspicious, lost), our_s = timed(lambda: salvaged_count(path))
        cells = [f"{theirs:6d} {size / their_s:6.0f} MB/s", " " * 18, f"{ours:6d} {size / our_s:6.0f} MB/s"]
        if other is not None and RERUN is not None:
            others, other_s = timed(lambda: other(path))
            cells[1] = f"{others:6d} {size / other_s:6.0f} MB/s"
        more = f"{ours / theirs:.2f}x messages, {their_s / our_s:.2f}x speed" if theirs else "the reader gives nothing"
        print(f"  {name:20s} {damage:16s} {' '.join(cells)} {suspicious:10d} {lost:>6s}   {more}")


def salvaged_count(path: Path) -> tuple[int, int, str]:
    """Messages got back, how many of them are suspicious, and how many are said to be lost (`0?` where all came back in doubt)."""
    try:
        report = salvage_log(path, path.with_name("clean.mcap"), force=True)
    except LogError:
        return 0, 0, "all"
    lost = "?" if report.lost is None else str(report.lost)
    return report.recovered, report.suspicious, lost if report.complete or report.lost != 0 else "0?"


PATIENCE_S = 30  # for a command that takes half a second on a whole log
RERUN = shutil.which("rerun", path=str(Path(sys.executable).parent)) or shutil.which("rerun")


def rerun_count(path: Path) -> int:
    """Messages in the recording that rerun makes of the log; its static rows describe channels."""
    out = path.with_name("out.rrd")
    out.unlink(missing_ok=True)
    command = [str(RERUN), "mcap", "convert", "--recover", "-d", "raw", str(path), "-o", str(out)]
    # A session of its own: the command starts another process, which would go on alone where only the first is killed.
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        running.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        return 0
    if not out.exists():
        return 0
    text = subprocess.run([str(RERUN), "rrd", "stats", str(out)], capture_output=True, text=True).stdout
    rows, static = (int(re.sub(r"\D", "", found)) for found in re.findall(r"^num_(?:rows|static) = (.*)$", text, re.M))
    return rows - static


def mcap_count(path: Path) -> int:
    count = 0
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                count += type(record).__name__ == "Message"
    except Exception:
        return count
    return count


def rosbags_count(path: Path) -> int:
    count = 0
    try:
        with Rosbag1Reader(path) as reader:
            for _ in reader.messages():
                count += 1
    except Exception:
        return count
    return count


def db3_count(path: Path) -> int:
    """Rows that rosbags' query gives before SQLite stops it."""
    count = 0
    try:
        with sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True) as database:
            for _ in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp"):
                count += 1
    except sqlite3.Error:
        return count
    return count


def payloads() -> list[bytes]:
    """Half noise, half not: about what JPEG beside joint states compresses to."""
    rng = random.Random(0)
    return [rng.randbytes(BYTES // 2) + struct.pack("<d", k) * (BYTES // 16) for k in range(MESSAGES)]


def write_mcap(path: Path, options: dict[str, Any]) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("", "bench")
        channels = [writer.register_channel(f"/t{i}", "json", 0) for i in range(4)]
        for k, data in enumerate(payloads()):
            writer.add_message(channels[k % 4], k * 1000, data, k * 1000, k)
        writer.finish()


def write_bag(path: Path, compression: str) -> None:
    path.unlink(missing_ok=True)
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Rosbag1Writer(path)
    if compression != "none":
        writer.set_compression(Rosbag1Writer.CompressionFormat[compression.upper()])
    with writer:
        connections = [
            writer.add_connection(f"/t{i}", "std_msgs/msg/UInt8MultiArray", typestore=store) for i in range(4)
        ]
        for k, data in enumerate(payloads()):
            writer.write(connections[k % 4], k * 1000, bytes(8) + struct.pack("<I", len(data)) + data)


def write_db3(path: Path) -> None:
    with sqlite3.connect(path) as database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles)"
        )
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        topics = [(i + 1, f"/t{i}", "std_msgs/msg/UInt8MultiArray", "cdr", "") for i in range(4)]
        database.executemany("INSERT INTO topics VALUES(?, ?, ?, ?, ?)", topics)
        rows = [(k % 4 + 1, k * 1000, bytes(12) + data) for k, data in enumerate(payloads())]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    return work(), time.perf_counter() - start


if __name__ == "__main__":
    main()
