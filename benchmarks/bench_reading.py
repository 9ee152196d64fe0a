"""`inspect`, and reading every message decoded, against the packages that read the same logs: mcap, rosbags, and rerun's `mcap` commands.

    python benchmarks/bench_reading.py

The same messages (a camera's JPEGs, joints, commands) lie in an MCAP, a ROS 1 bag and two ROS 2 bags. What is compared does the same
work only in part, and the table says which. A count of messages that differs from what was written ends the benchmark.
"""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from tests.synthetic import write_mcap
from tests.synthetic_bags import write_rosbag1, write_rosbag2
from vilp_data.log_summary import summarise
from vilp_data.sources import open_log

FRAMES, REPEATS = 1200, 5
RERUN = Path(sys.executable).with_name("rerun")


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="vilp-bench-"))
    try:
        log = write_mcap(folder / "run.mcap", n_frames=FRAMES, height=240, width=320)
        plain = write_mcap(folder / "protobuf.mcap", encoding="protobuf", n_frames=FRAMES, height=240, width=320).path
        bags = {
            "MCAP, protobuf": plain,
            "ROS 1 bag, lz4": write_rosbag1(folder / "run.bag", log, compression="lz4", chunk_bytes=1 << 20),
            "ROS 2 bag, SQLite": write_rosbag2(folder / "sqlite", log),
            "ROS 2 bag, MCAP": write_rosbag2(folder / "mcap", log, storage="mcap"),
        }
        count = mcap_counts(log.path)
        print(f"{count} messages, {log.path.stat().st_size / 1e6:.0f} MB, one thread; medians of {REPEATS}")
        print(
            "\ninspect: ours also opens a sample of each topic for sizes and header clocks, and reports rates and gaps"
        )
        for name, path in bags.items():
            peers: dict[str, Callable[[], int]] = {"rosbags, counts alone": partial(rosbags_counts, path)}
            if path == plain:
                peers = {
                    "mcap, counts alone": partial(mcap_counts, path),
                    "rerun mcap info": partial(rerun_info, path, count),
                }
            compare(name, "vilp-data inspect", partial(inspected, path), peers, count)
        print("\nevery message, decoded, in order of time: ours also verifies every CRC and count")
        for name, path in bags.items():
            peers = {"rosbags": partial(rosbags_reads, path)}
            if path == plain:
                peers = {"mcap, protobuf support": partial(mcap_reads, path)}
            compare(name, "vilp_data", partial(ours_reads, path), peers, count)
    finally:
        shutil.rmtree(folder)


def compare(name: str, label: str, ours: Callable[[], int], peers: dict[str, Callable[[], int]], count: int) -> None:
    both = {label: ours, **peers}
    seconds: dict[str, list[float]] = {each: [] for each in both}
    for _ in range(REPEATS):
        for each, work in both.items():
            started = time.perf_counter()
            assert work() == count, (name, each)
            seconds[each].append(time.perf_counter() - started)
    own = statistics.median(seconds[label])
    print(f"  {name}\n    {label:<24}{1e3 * own:8.0f} ms")
    for each in peers:
        other = statistics.median(seconds[each])
        print(f"    {each:<24}{1e3 * other:8.0f} ms   ours takes {own / other:.2f}x of it")


def inspected(path: Path) -> int:
    return sum(topic.n_messages or 0 for topic in summarise(path).topics)


def mcap_counts(path: Path) -> int:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    return summary.statistics.message_count


def rosbags_counts(path: Path) -> int:
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        return int(reader.message_count)


def rerun_info(path: Path, count: int) -> int:
    subprocess.run([RERUN, "mcap", "info", path], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return count


def ours_reads(path: Path) -> int:
    with open_log(path) as log:
        return sum(1 for _ in log.messages([topic.name for topic in log.topics()]))


def mcap_reads(path: Path) -> int:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages())


def rosbags_reads(path: Path) -> int:
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        return sum(1 for connection, _, data in reader.messages() if reader.deserialize(data, connection.msgtype))


if __name__ == "__main__":
    main()
