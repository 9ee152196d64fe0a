"""Ingest against a bare loop that reads, decodes and resizes the same images with mcap and OpenCV or PyAV, and keeps nothing.

    python benchmarks/bench_ingest.py

Both run on one thread over the same logs, taking turns; the ratio is of medians. Ours also hashes the log, checks every CRC, reads
the other topics, aligns, and writes with fsync.
"""

from __future__ import annotations

import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
from av.video.reformatter import VideoReformatter
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from mcap.reader import make_reader

from tests.synthetic import START_NS, card_frame, encode_image, image_topic
from tests.video_logs import PERIOD_NS, VIDEO, Row, joints, spec_of, write_log
from tests.video_packets import encode, video_message
from vilp_data.ingest import ingest_logs
from vilp_data.spec import TaskSpec
from vilp_data.types import U8

LOGS, FRAMES, CAMERAS, REPEATS = 6, 150, ("front", "side"), 5
RECORDED, STORED = (240, 320), (96, 128)
VIDEO_RECORDED, VIDEO_HZ = (480, 640), 30


def main() -> None:
    cv2.setNumThreads(1)
    folder = Path(tempfile.mkdtemp(prefix="vilp-bench-"))
    try:
        logs, spec = jpeg_logs(folder / "jpeg")
        compare("JPEGs", RECORDED, LOGS * FRAMES * len(CAMERAS), logs, spec, bare_jpeg, folder, aim=70)
        logs, spec = video_logs(folder / "video")
        compare("frames of H.264", VIDEO_RECORDED, LOGS * FRAMES, logs, spec, bare_video, folder, aim=60)
    finally:
        shutil.rmtree(folder)


def compare(
    what: str,
    recorded: tuple[int, int],
    images: int,
    logs: list[Path],
    spec: TaskSpec,
    bare_loop: Callable[[list[Path]], int],
    folder: Path,
    *,
    aim: int,
) -> None:
    bare, ours = [], []
    for _ in range(REPEATS):
        bare.append(timed(lambda: bare_loop(logs)))
        root = Path(tempfile.mkdtemp(dir=folder))
        ours.append(timed(lambda root=root: ingest(logs, root, spec)))
        shutil.rmtree(root)
    assert bare_loop(logs) == images
    fast, slow = images / statistics.median(bare), images / statistics.median(ours)
    print(
        f"ingest, {len(logs)} logs, {images} {what} {recorded[1]}x{recorded[0]} -> {STORED[1]}x{STORED[0]}, one thread"
    )
    print(f"  bare read + decode + resize  {fast:8.0f} images/s")
    print(f"  vilp-data ingest             {slow:8.0f} images/s   {slow / fast:.0%} of bare (aim: {aim} %)")


def ingest(logs: list[Path], root: Path, spec: TaskSpec) -> None:
    report = ingest_logs(logs, root, spec, workers=1)
    assert len(report.written) == len(logs), report


# --- JPEG -----------------------------------------------------------------------------------------------------------------


def jpeg_logs(folder: Path) -> tuple[list[Path], TaskSpec]:
    """Two cameras at 10 Hz and joints at 50 Hz. Every image is one that a step sees: what steps pass by, ingest does not decode."""
    folder.mkdir(parents=True)
    frames = moving_frames(RECORDED, FRAMES)
    jpegs = [encode_image(frame, "jpeg") for frame in frames]
    logs = []
    for i in range(LOGS):
        start = START_NS + i
        rows = [
            Row(start + n * PERIOD_NS, image_topic(camera), CompressedImage(data=jpeg, format="jpeg"))
            for n, jpeg in enumerate(jpegs)
            for camera in CAMERAS
        ]
        logs.append(write_log(folder / f"run{i}.mcap", [*rows, *joints(5 * FRAMES, rate_hz=50)], chunk_size=1 << 20))
    table = spec_of(image_topic(CAMERAS[0])).model_dump(by_alias=True)
    sizes = {"height": STORED[0], "width": STORED[1]}
    table["views"] = {camera: {"topic": image_topic(camera), **sizes} for camera in CAMERAS}
    return logs, TaskSpec.model_validate(table)


def moving_frames(shape: tuple[int, int], count: int) -> list[U8]:
    """The colour card under a texture as fine as a camera's, moving to the right: so that there is something to decode."""
    texture = np.random.default_rng(0).integers(0, 40, (*shape, 3), np.uint8)
    card = np.minimum(card_frame(0, *shape), 215) + cv2.GaussianBlur(texture, (5, 5), 0)
    return [np.roll(card, 3 * i, axis=1) for i in range(count)]


def bare_jpeg(logs: list[Path]) -> int:
    topics, count = [image_topic(camera) for camera in CAMERAS], 0
    for path in logs:
        with path.open("rb") as file:
            for _, _, message in make_reader(file).iter_messages(topics=topics):
                data = np.frombuffer(CompressedImage.FromString(message.data).data, np.uint8)
                cv2.resize(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), STORED[::-1], interpolation=cv2.INTER_AREA)
                count += 1
    return count


# --- H.264 ----------------------------------------------------------------------------------------------------------------


def video_logs(folder: Path) -> tuple[list[Path], TaskSpec]:
    """Every frame is one that a step sees."""
    folder.mkdir(parents=True)
    sent = encode(moving_frames(VIDEO_RECORDED, FRAMES), "h264", quality={"g": "30"})
    logs = []
    for i in range(LOGS):
        start, period = START_NS + i, 10**9 / VIDEO_HZ
        rows = [
            Row(start + round(n * period), VIDEO, video_message(packet.data, "h264").body)
            for n, packet in enumerate(sent)
        ]
        logs.append(write_log(folder / f"run{i}.mcap", [*rows, *joints(FRAMES // 3)], chunk_size=1 << 20))
    return logs, spec_of(VIDEO, rate_hz=VIDEO_HZ, height=STORED[0], width=STORED[1])


def bare_video(logs: list[Path]) -> int:
    count = 0
    for path in logs:
        decoder, to_rgb = av.CodecContext.create("h264", "r"), VideoReformatter()
        decoder.thread_count = 1
        with path.open("rb") as file:
            packets = [
                av.Packet(CompressedVideo.FromString(message.data).data)
                for _, _, message in make_reader(file).iter_messages(topics=[VIDEO])
            ]
        for packet in [*packets, None]:
            for frame in decoder.decode(packet):
                rgb = to_rgb.reformat(frame, format="rgb24", threads=1).to_ndarray()
                cv2.resize(rgb, STORED[::-1], interpolation=cv2.INTER_AREA)
                count += 1
    return count


def timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
