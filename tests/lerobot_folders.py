"""Small LeRobot datasets with known content. Every picture shows its own number, in blocks that survive a lossy codec."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from vilp_data.types import F32, U8

BITS, BLOCK = 10, 16
HEIGHT, WIDTH = 2 * BLOCK, BITS * BLOCK
CAMERA = "observation.images.top"


def numbered_image(number: int) -> U8:
    """uint8 [HEIGHT,WIDTH,3]: the number's bits as white and black blocks in the upper half, a red and a blue half below."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for bit in range(BITS):
        image[:BLOCK, bit * BLOCK : (bit + 1) * BLOCK] = 255 * (number >> bit & 1)
    image[BLOCK:, : WIDTH // 2], image[BLOCK:, WIDTH // 2 :] = (220, 30, 30), (30, 30, 220)
    return image


def number_of(image: U8) -> int:
    """The number that a picture shows."""
    row = image[BLOCK // 2, BLOCK // 2 :: BLOCK].astype(int).mean(axis=-1)
    return sum(int(value > 127) << bit for bit, value in enumerate(row))


def write_video(
    path: Path, numbers: Sequence[int], rate: Fraction, *, codec: str = "libx264", b_frames: int = 0, gop: int = 12
) -> None:
    """An MP4 of numbered pictures, frame k at k / rate."""
    path.parent.mkdir(parents=True, exist_ok=True)
    options = (
        {"bf": str(b_frames), "g": str(gop), "preset": "veryfast"}
        if codec == "libx264"
        else {"g": str(gop), "preset": "12"}
    )
    if gop == 1:  # each picture by itself, the same bytes whatever its neighbours
        options |= {"qp": "20", "tune": "zerolatency"}
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        for position, number in enumerate(numbers):
            frame = av.VideoFrame.from_ndarray(numbered_image(number), format="rgb24")
            frame.pts, frame.time_base = position, 1 / Fraction(rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@dataclass(frozen=True)
class LeRobotFolder:
    """What was written: row k of all rows has state [k, -k], action [k + 0.5], and its picture shows k."""

    path: Path
    lengths: tuple[int, ...]
    rate: Fraction

    @property
    def starts(self) -> list[int]:
        return [0, *np.cumsum(self.lengths)[:-1].tolist()]

    def table(self, episode: int) -> Path:
        return self.path / f"data/chunk-000/episode_{episode:06d}.parquet"

    def video(self, episode: int) -> Path:
        return self.path / f"videos/chunk-000/{CAMERA}/episode_{episode:06d}.mp4"


def write_v21(
    path: Path, *, lengths: Sequence[int] = (20, 15, 12), rate: Fraction = Fraction(30), images: str = "video", b_frames: int = 0,
    codec: str = "libx264",
) -> LeRobotFolder:  # fmt: skip
    """One Parquet and, with images = "video", one MP4 an episode; with "image" PNGs inside the Parquet."""
    folder = LeRobotFolder(path, tuple(lengths), Fraction(rate))
    paths = {"data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
             "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"}  # fmt: skip
    _write_info(folder, "v2.1", images, paths)
    lines = [{"episode_index": e, "tasks": [f"task {e % 2}"], "length": n} for e, n in enumerate(lengths)]
    (path / "meta/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    for episode, first in enumerate(folder.starts):
        rows = range(first, first + lengths[episode])
        folder.table(episode).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(_rows(folder, [episode], images), folder.table(episode))
        if images == "video":
            write_video(folder.video(episode), rows, folder.rate, b_frames=b_frames, codec=codec)
    return folder


def write_v3(
    path: Path, *, lengths: Sequence[int] = (20, 15, 12, 9), rate: Fraction = Fraction(30), per_file: int = 3, b_frames: int = 0,
    gop: int = 12, row_group: int = 11,
) -> LeRobotFolder:  # fmt: skip
    """`per_file` episodes in each Parquet and MP4."""
    folder = LeRobotFolder(path, tuple(lengths), Fraction(rate))
    paths = {"data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
             "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"}  # fmt: skip
    _write_info(folder, "v3.0", "video", paths)
    entries = []
    for file, first_episode in enumerate(range(0, len(lengths), per_file)):
        members = list(range(first_episode, min(first_episode + per_file, len(lengths))))
        table = path / f"data/chunk-000/file-{file:03d}.parquet"
        table.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(_rows(folder, members, "video"), table, row_group_size=row_group)
        first = folder.starts[members[0]]
        numbers = range(first, folder.starts[members[-1]] + lengths[members[-1]])
        write_video(
            path / f"videos/{CAMERA}/chunk-000/file-{file:03d}.mp4", numbers, folder.rate, b_frames=b_frames, gop=gop
        )
        for episode in members:
            start = folder.starts[episode]
            from_s = float((start - first) / folder.rate)
            entries.append({
                "episode_index": episode, "tasks": [f"task {episode % 2}"], "length": lengths[episode],
                "data/chunk_index": 0, "data/file_index": file, "dataset_from_index": start,
                "dataset_to_index": start + lengths[episode],
                f"videos/{CAMERA}/chunk_index": 0, f"videos/{CAMERA}/file_index": file,
                f"videos/{CAMERA}/from_timestamp": from_s,
                f"videos/{CAMERA}/to_timestamp": from_s + float(lengths[episode] / folder.rate),
                "stats/action/min": [0.0],
            })  # fmt: skip
    (path / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(entries), path / "meta/episodes/chunk-000/file-000.parquet")
    return folder


def _write_info(folder: LeRobotFolder, version: str, images: str, paths: dict[str, str]) -> None:
    scalar = {"shape": [1], "names": None}
    info = {
        "codebase_version": version, "robot_type": "two_joints", "fps": float(folder.rate), "chunks_size": 1000,
        "total_episodes": len(folder.lengths), "total_frames": sum(folder.lengths), **paths,
        "features": {
            "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": ["one", "two"]}},
            "action": {"dtype": "float32", "shape": [1], "names": ["one"]},
            CAMERA: {"dtype": images, "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "channel"]},
            "timestamp": {"dtype": "float32", **scalar}, "episode_index": {"dtype": "int64", **scalar},
            "frame_index": {"dtype": "int64", **scalar}, "index": {"dtype": "int64", **scalar},
        },
    }  # fmt: skip
    (folder.path / "meta").mkdir(parents=True)
    (folder.path / "meta/info.json").write_text(json.dumps(info))


def _rows(folder: LeRobotFolder, episodes: Sequence[int], images: str) -> pa.Table:
    parts = []
    for episode in episodes:
        length, start = folder.lengths[episode], folder.starts[episode]
        index = np.arange(start, start + length)
        frame = np.arange(length)
        columns = {
            "observation.state": _fixed(np.stack([index, -index], axis=1).astype(np.float32)),
            "action": _fixed((index[:, None] + 0.5).astype(np.float32)),
            "timestamp": pa.array((frame / float(folder.rate)).astype(np.float32)),
            "frame_index": pa.array(frame), "episode_index": pa.array(np.full(length, episode)), "index": pa.array(index),
        }  # fmt: skip
        if images == "image":
            columns[CAMERA] = pa.array(
                [{"bytes": _png(numbered_image(int(k))), "path": f"frame_{k}.png"} for k in index]
            )
        parts.append(pa.table(columns))
    return pa.concat_tables(parts)


def _fixed(values: F32) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _png(image: U8) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "png")
    return stream.getvalue()
