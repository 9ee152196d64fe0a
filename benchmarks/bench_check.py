"""Check against a bare loop that reads every message with mcap, takes its stamp, and decodes two images a second with OpenCV.

    python benchmarks/bench_check.py

Both run on one thread over the same log, taking turns; the ratio is of medians of processor time. Check also verifies every
CRC, reads the joints' values, judges all of it, and keeps pictures. A log of small messages alone shows what it costs where there is
no image to decode.
"""

from __future__ import annotations

import gc
import resource
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from tests.synthetic import START_NS, card_frame, encode_image, write_mcap
from vilp_data.check.log import check_log
from vilp_data.check.sources import check_sources
from vilp_data.types import U8

REPEATS = 5
SAMPLE_NS = 500_000_000
TYPES = {"foxglove.CompressedImage": CompressedImage, "foxglove.JointStates": JointStates}


def main() -> None:
    cv2.setNumThreads(1)
    folder = Path(tempfile.mkdtemp(prefix="vilp-bench-"))
    try:
        compare(
            "two cameras 640x480 at 30 Hz, joints at 100 Hz, 30 s",
            write_cameras(folder / "cameras.mcap", duration_s=30),
        )
        before = peak_mb()
        compare("the same, 120 s", write_cameras(folder / "long.mcap", duration_s=120), repeats=1)
        print(
            f"  most memory of this process  {before:8.0f} MB after the first, {peak_mb():.0f} MB after the one four times as long"
        )
        joints = write_mcap(
            folder / "joints.mcap", encoding="protobuf", cameras=(), n_frames=600, camera_hz=10.0, joint_hz=500.0, action_hz=100.0,
            chunk_size=1 << 20,
        )  # fmt: skip
        compare("joints and commands alone at 500 and 100 Hz, 60 s", joints.path)
    finally:
        shutil.rmtree(folder)


def write_cameras(path: Path, *, duration_s: int) -> Path:
    """Two cameras at 30 Hz whose pictures have a sensor's noise (about 60 kB each), joints at 100 Hz; lz4, as recorders write."""
    jpegs = [encode_image(noisy_picture(i), "jpeg") for i in range(40)]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4, chunk_size=4 << 20)
        writer.start()
        channels = {}
        for topic, kind in (
            ("/camera/front", CompressedImage),
            ("/camera/side", CompressedImage),
            ("/joint_states", JointStates),
        ):
            data = build_file_descriptor_set(kind).SerializeToString()
            schema = writer.register_schema(kind.DESCRIPTOR.full_name, "protobuf", data)
            channels[topic] = writer.register_channel(topic, "protobuf", schema)
        for tick in range(duration_s * 300):
            time_ns = START_NS + tick * 10**9 // 300
            stamp = Timestamp(seconds=time_ns // 10**9, nanos=time_ns % 10**9)
            if tick % 3 == 0:
                joints = [{"name": f"j{i}", "position": float(np.sin(tick / 300 + i))} for i in range(7)]
                body = JointStates(timestamp=stamp, joints=joints).SerializeToString()
                writer.add_message(channels["/joint_states"], time_ns, body, time_ns)
            for number, topic in enumerate(("/camera/front", "/camera/side")):
                if tick % 10 == 5 * number:
                    picture = jpegs[(tick // 10 + 17 * number) % len(jpegs)]
                    body = CompressedImage(timestamp=stamp, format="jpeg", data=picture).SerializeToString()
                    writer.add_message(channels[topic], time_ns, body, time_ns)
        writer.finish()
    return path


def noisy_picture(number: int) -> U8:
    noise = np.random.default_rng(number).normal(0, 3, (480, 640, 3))
    return np.clip(card_frame(number, 480, 640) + cv2.GaussianBlur(noise, (3, 3), 0), 0, 255).astype(np.uint8)


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def compare(name: str, path: Path, *, repeats: int = REPEATS) -> None:
    check_sources([path])  # imports, and the page cache
    bare, ours = [], []
    for _ in range(repeats):
        bare.append(timed(lambda: bare_loop(path)))
        ours.append(timed(lambda: check_log(path)))
    fast, slow = statistics.median(bare), statistics.median(ours)
    print(f"check, {name} ({path.stat().st_size / 1e6:.0f} MB), one thread")
    print(f"  bare read + sampled decode   {fast * 1e3:8.0f} ms")
    print(f"  vilp-data check              {slow * 1e3:8.0f} ms   {slow / fast:.2f} x bare (aim: at most 1.5)")


def bare_loop(path: Path) -> None:
    """Every message parsed by its own type, its stamp taken; two images a second of each camera decoded."""
    due: dict[str, int] = {}
    stamps: dict[str, list[int]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            body = TYPES[schema.name].FromString(message.data)
            stamp = body.timestamp.seconds * 10**9 + body.timestamp.nanos
            stamps.setdefault(channel.topic, []).append(message.log_time - stamp)
            if schema.name == "foxglove.CompressedImage" and message.log_time >= due.get(channel.topic, 0):
                due[channel.topic] = message.log_time + SAMPLE_NS
                cv2.imdecode(np.frombuffer(body.data, np.uint8), cv2.IMREAD_COLOR_RGB)


def timed(work: Callable[[], object]) -> float:
    gc.collect()
    start = time.process_time()
    work()
    return time.process_time() - start


if __name__ == "__main__":
    main()
