"""Peak memory of `vilp-data ingest` over the length of one log: it must not grow with it.

    python benchmarks/bench_memory.py                  # logs of 64, 256 and 512 MB
    python benchmarks/bench_memory.py 2048             # as the aim has it: 2 GB under 600 MB of memory

Logs are generated: one camera of 1280x720 JPEGs at 30 Hz, joints at 100 Hz, one demonstration. Peak memory is the process's largest
resident set, mapped files included; that of an ingest which reads next to nothing is told beside it. Needs 1.2 times the log's size
on disk.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from benchmarks.bench_ingest import moving_frames
from tests.synthetic import START_NS, encode_image, image_topic

SIZES_MB = (1, 64, 256, 512)
LIMIT_MB = 600
CAMERA_HZ, JOINTS_HZ = 30, 100
TASK = f"""name = "memory"
rate_hz = {CAMERA_HZ}.0
[views.front]
topic = "{image_topic("front")}"
height = 96
width = 128
fit = "crop"
[low_dim.joints]
topic = "/joints"
names = ["t"]
[window]
frame_stride = 2
"""


def main() -> None:
    sizes = tuple(map(int, sys.argv[1:])) or SIZES_MB
    folder = Path(tempfile.mkdtemp(prefix="vilp-bench-"))
    try:
        (folder / "memory.toml").write_text(TASK)
        print("ingest, one log of one demonstration, 1280x720 JPEGs -> 128x96")
        for size_mb in sizes:
            log = write_log(folder / f"{size_mb}.mcap", size_mb << 20)
            started = time.perf_counter()
            peak_mb = peak_of_ingest(log, folder)
            seconds = time.perf_counter() - started
            verdict = "" if peak_mb < LIMIT_MB else f"   above the aim of {LIMIT_MB} MB"
            print(
                f"  {log.stat().st_size / 1e6:6.0f} MB log  {peak_mb:5.0f} MB at most, {seconds:5.0f} s{verdict}",
                flush=True,
            )
            log.unlink()
    finally:
        shutil.rmtree(folder)


def peak_of_ingest(log: Path, folder: Path) -> float:
    """Megabytes, of a process of its own."""
    code = (
        "import resource, sys\n"
        "from vilp_data.cli import app\n"
        "try: app()\n"
        "finally: print('PEAK', resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)\n"
    )
    root = Path(tempfile.mkdtemp(dir=folder))
    task = str(folder / "memory.toml")
    command = [sys.executable, "-c", code, "ingest", str(log), "--task", task, "--into", str(root), "--workers", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    shutil.rmtree(root)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    kib = int(done.stderr.rpartition("PEAK ")[2].split()[0])
    return kib * 1024 / 1e6


def write_log(path: Path, size: int) -> Path:
    jpegs = [encode_image(frame, "jpeg") for frame in moving_frames((720, 1280), 30)]
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4 << 20, compression=CompressionType.NONE)
        writer.start()
        channels = {}
        for topic, kind in ((image_topic("front"), CompressedImage), ("/joints", JointStates)):
            schema = writer.register_schema(
                kind.DESCRIPTOR.full_name, "protobuf", build_file_descriptor_set(kind).SerializeToString()
            )
            channels[topic] = writer.register_channel(topic, "protobuf", schema)
        tick = 0
        while stream.tell() < size or tick < 3 * JOINTS_HZ:
            now = START_NS + tick * 10**9 // JOINTS_HZ
            joints = JointStates(joints=[{"name": "t", "position": tick / JOINTS_HZ}])
            joints.timestamp.FromNanoseconds(now)
            writer.add_message(channels["/joints"], now, joints.SerializeToString(), now)
            image = tick * CAMERA_HZ // JOINTS_HZ
            if image != (tick - 1) * CAMERA_HZ // JOINTS_HZ:
                stamp = START_NS + image * 10**9 // CAMERA_HZ
                body = CompressedImage(data=jpegs[image % len(jpegs)], format="jpeg")
                body.timestamp.FromNanoseconds(stamp)
                writer.add_message(channels[image_topic("front")], now, body.SerializeToString(), now)
            tick += 1
        writer.finish()
    return path


if __name__ == "__main__":
    main()
