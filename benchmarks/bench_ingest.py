"""Ingest against a bare loop that reads, decodes and resizes the same images with mcap and OpenCV, and keeps nothing.

    python benchmarks/bench_ingest.py

Both run on one thread over the same logs, taking turns; the ratio is of medians. Ours also hashes the log, checks every CRC, reads
the other topics, aligns, and writes with fsync.
"""

from __future__ import annotations

import shutil
import statistics
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.reader import make_reader

from tests.synthetic import image_topic, task_spec, write_mcap
from vilp_data.ingest import ingest_logs
from vilp_data.spec import TaskSpec

LOGS, FRAMES, CAMERAS, REPEATS = 6, 150, ("front", "side"), 5
RECORDED, STORED = (240, 320), (96, 128)


def main() -> None:
    cv2.setNumThreads(1)
    folder = Path(tempfile.mkdtemp(prefix="vilp-bench-"))
    try:
        logs, spec = write_logs(folder / "logs")
        bare, ours = [], []
        for repeat in range(REPEATS):
            bare.append(timed(lambda: bare_loop(logs)))
            root = folder / f"data{repeat}"
            ours.append(timed(lambda root=root: ingest_logs(logs, root, spec, workers=1)))
    finally:
        shutil.rmtree(folder)
    images = LOGS * FRAMES * len(CAMERAS)
    fast, slow = images / statistics.median(bare), images / statistics.median(ours)
    print(
        f"ingest, {LOGS} logs x {FRAMES} x {len(CAMERAS)} JPEGs {RECORDED[1]}x{RECORDED[0]} -> {STORED[1]}x{STORED[0]}, one thread"
    )
    print(f"  bare read + decode + resize  {fast:8.0f} images/s")
    print(f"  vilp-data ingest             {slow:8.0f} images/s   {slow / fast:.0%} of bare (aim: 70 %)")


def write_logs(folder: Path) -> tuple[list[Path], TaskSpec]:
    folder.mkdir(parents=True)
    logs = []
    for i in range(LOGS):
        log = write_mcap(
            folder / f"run{i}.mcap", encoding="protobuf", cameras=CAMERAS, n_frames=FRAMES, height=RECORDED[0], width=RECORDED[1],
            jitter_s=1e-4, seed=i, chunk_size=1 << 20,
        )  # fmt: skip
        logs.append(log.path)
    views = {camera: {"topic": image_topic(camera), "height": STORED[0], "width": STORED[1]} for camera in CAMERAS}
    return logs, task_spec(log, views=views)


def bare_loop(logs: list[Path]) -> None:
    topics = [image_topic(camera) for camera in CAMERAS]
    for path in logs:
        with path.open("rb") as file:
            for _, _, message in make_reader(file).iter_messages(topics=topics):
                data = np.frombuffer(CompressedImage.FromString(message.data).data, np.uint8)
                cv2.resize(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), STORED[::-1], interpolation=cv2.INTER_AREA)


def timed(work: object) -> float:
    start = time.perf_counter()
    work()  # type: ignore[operator]
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
