"""Salvage against what the Python readers get out of the same damaged logs: how many messages, and how fast.

    python benchmarks/bench_salvage.py

The mcap library's stream reader (the one that needs no index) and rosbags' reader count what they yield before they give up. Salvage
also inflates what they leave, checks every checksum, and writes the clean MCAP with fsync; the readers write nothing.
"""

from __future__ import annotations

import random
import shutil
import struct
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
    print(f"  {'log':22s} {'damage':16s} {'the reader':>18s} {'salvage':>18s} {'suspicious':>10s}")
    try:
        for name, options in LAYOUTS.items():
            path = folder / "run.mcap"
            write_mcap(path, options)
            compare(name, path, mcap_count)
        for compression in ("none", "lz4", "bz2"):
            path = folder / "run.bag"
            write_bag(path, compression)
            compare(f"bag {compression}", path, rosbags_count)
    finally:
        shutil.rmtree(folder)


def compare(name: str, path: Path, count: Callable[[Path], int]) -> None:
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
        theirs, their_s = timed(lambda: count(path))
        (ours, suspicious), our_s = timed(lambda: salvaged_count(path))
        size = len(damaged) / 1e6
        speeds = f"{theirs:6d} {size / their_s:6.0f} MB/s {ours:6d} {size / our_s:6.0f} MB/s {suspicious:10d}"
        more = f"{ours / theirs:.2f}x messages, {their_s / our_s:.2f}x speed" if theirs else "the reader gives nothing"
        print(f"  {name:22s} {damage:16s} {speeds}   {more}")


def salvaged_count(path: Path) -> tuple[int, int]:
    """Messages got back, and how many of them are suspicious."""
    try:
        report = salvage_log(path, path.with_name("clean.mcap"), force=True)
    except LogError:
        return 0, 0
    return report.recovered, report.suspicious


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


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    return work(), time.perf_counter() - start


if __name__ == "__main__":
    main()
