"""Read a written LeRobot dataset back, by its own tables alone, and compare every row and every frame with the store."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from vilp_data.export.compare import FrameErrors, came_out_wrong
from vilp_data.export.job import ExportJob, Written
from vilp_data.export.lerobot import EPISODES_PATH, coding_of, view_key
from vilp_data.export.segments import Rows, Segment
from vilp_data.export.video import read_video, rgb
from vilp_data.types import U8


def check(job: ExportJob, folder: Path, written: Written) -> list[str]:
    """What was compared, in words; fills the errors of each view in. Raises StoreError at the first difference."""
    info = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))
    listed = pq.read_table(folder / EPISODES_PATH).to_pylist()
    reader = _Reader(folder, info)
    errors = {view: FrameErrors() for view in job.shapes.views}
    for (segment, rows), episode in zip(job.read(), listed, strict=True):
        table = reader.rows(episode)
        _compare_columns(job, segment, rows, table)
        for view in job.shapes.views:
            _compare_frames(job, segment, rows, view, reader.images(episode, table, view), errors[view])
    reader.require_end()
    for view, error in errors.items():
        written.views[view].psnr_db, written.views[view].psnr_min_db = error.psnr_db()
    n_frames = len(errors) * job.chosen.n_rows
    frames = [f"{n_frames} frames decoded in order, row k against frame k"] if n_frames else []
    return [f"{job.chosen.n_rows} rows of the table equal to the stored steps", *frames]


class _Reader:
    """Rows and frames of one episode after the other; videos are decoded once, in order."""

    def __init__(self, folder: Path, info: dict[str, Any]) -> None:
        self._folder, self._info = folder, info
        self._table: tuple[Path, pa.Table] | None = None
        self._videos: dict[str, tuple[Path, int, Iterator[U8]]] = {}

    def rows(self, episode: dict[str, Any]) -> pa.Table:
        places = {name: episode[f"data/{name}"] for name in ("chunk_index", "file_index")}
        path = self._folder / self._info["data_path"].format(**places)
        if self._table is None or self._table[0] != path:
            self._table = path, pq.read_table(path, page_checksum_verification=True)
        table = self._table[1]
        first = episode["dataset_from_index"] - table.column("index")[0].as_py()
        return table.slice(first, episode["dataset_to_index"] - episode["dataset_from_index"])

    def images(self, episode: dict[str, Any], table: pa.Table, view: str) -> Iterator[U8]:
        """The frames of an episode, as many as it has rows."""
        key = view_key(view)
        if self._info["features"][key]["dtype"] == "image":
            yield from (_decoded(cell["bytes"]) for cell in table.column(key).to_pylist())
            return
        places = {name: episode[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
        path = self._folder / self._info["video_path"].format(video_key=key, **places)
        fps = self._fps()
        if key not in self._videos or self._videos[key][0] != path:
            self._require_end_of(key)
            self._videos[key] = path, 0, read_video(path, fps)
        _, done, frames = self._videos[key]
        if round(episode[f"videos/{key}/from_timestamp"] * float(fps)) != done:
            raise came_out_wrong("an episode does not begin where its table says", path)
        for _ in range(table.num_rows):
            image = next(frames, None)
            if image is None:
                raise came_out_wrong("a video of fewer frames than rows", path)
            yield image
        self._videos[key] = path, done + table.num_rows, frames

    def require_end(self) -> None:
        """StoreError where a video holds frames that belong to no row."""
        for key in self._videos:
            self._require_end_of(key)

    def _require_end_of(self, key: str) -> None:
        if key in self._videos and next(self._videos[key][2], None) is not None:
            raise came_out_wrong("a video of more frames than rows", self._videos[key][0])

    def _fps(self) -> Any:
        from vilp_data.export.video import frame_rate

        return frame_rate(float(self._info["fps"]))


def _compare_columns(job: ExportJob, segment: Segment, rows: Rows, table: pa.Table) -> None:
    expected: dict[str, npt.NDArray[Any] | None] = {
        "observation.state": rows.low_dim if job.shapes.low_dim else None,
        "action": rows.action,
        "sim_state": rows.state if job.shapes.state else None,
        "valid": rows.valid if job.marked else None,
        "log_time_ns": rows.log_time_ns,
        "timestamp": (np.arange(len(rows)) / float(job.fps)).astype(np.float32),
        "frame_index": np.arange(len(rows)),
    }
    for name, values in expected.items():
        if values is None:
            continue
        column = table.column(name).combine_chunks()
        found = column.flatten() if pa.types.is_fixed_size_list(column.type) else column
        got = found.to_numpy(zero_copy_only=False).reshape(values.shape)
        if not np.array_equal(got, values, equal_nan=values.dtype.kind == "f"):
            raise came_out_wrong(f"{name} came out different", segment)


def _compare_frames(
    job: ExportJob, segment: Segment, rows: Rows, view: str, found: Iterator[U8], errors: FrameErrors
) -> None:
    coding = coding_of(job, view)
    lossless = coding is None or coding.crf is None
    stored, shown = rows.frames[view], rows.shown[view]
    row = -1
    for row, image in enumerate(found):
        wanted, before, after = (
            _like(stored[shown[at]], image) if 0 <= at < len(shown) else None for at in (row, row - 1, row + 1)
        )
        assert wanted is not None
        if lossless:
            if not np.array_equal(image, wanted):
                raise came_out_wrong("a lossless frame came out different", f"{segment}, view {view}, row {row}")
            continue
        errors.add(image, before, wanted, after)
    if row + 1 != len(shown):
        counts = f"{row + 1} and {len(shown)}"
        raise came_out_wrong("frames and rows differ in number", f"{segment}, view {view}", found=counts)
    if not errors.end_episode():
        raise came_out_wrong("frames that lie nearer to their neighbours' rows", f"{segment}, view {view}")


def _like(stored: U8, found: U8) -> U8:
    return stored if stored.shape == found.shape else rgb(stored)


def _decoded(data: bytes) -> U8:
    image: U8 = np.asarray(Image.open(io.BytesIO(data)))
    return image if image.ndim == 3 else image[..., None]
