"""A LeRobot v3.0 dataset: many episodes to a Parquet file, many to a video, and tables that say which rows and seconds are whose.

Row k of an episode is at k / fps, exactly, and so is its frame in the video, counted from the episode's `from_timestamp`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from vilp_data.export.job import ExportJob, ViewWritten, Written
from vilp_data.export.lerobot_stats import Stats, flat, image_stats, pixel_counts, vector_stats
from vilp_data.export.segments import Rows, Segment
from vilp_data.export.video import CODINGS, Coding, VideoWriter, rgb
from vilp_data.types import I64, U8

VERSION = "v3.0"
CHUNK_FILES = 1000
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"

_ARROW = {"float32": pa.float32(), "float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_()}
_IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_COUNTING = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True)
class Place:
    """The n-th file of its kind."""

    number: int = 0

    @property
    def indices(self) -> dict[str, int]:
        return {"chunk_index": self.number // CHUNK_FILES, "file_index": self.number % CHUNK_FILES}


def view_key(view: str) -> str:
    return f"observation.images.{view}"


def coding_of(job: ExportJob, view: str) -> Coding | None:
    """How a view's frames are coded; None for images in the table. Depth is never coded with loss: 0 means that there is no reading."""
    if job.images == "png":
        return None
    if view in job.depth_views():
        return CODINGS["lossless"]
    coding = CODINGS[job.images]
    return coding if job.crf is None or coding.crf is None else Coding(coding.encoder, coding.pixels, job.crf)


def write(job: ExportJob, folder: Path) -> Written:
    """Write the dataset into an empty folder."""
    tasks = list(dict.fromkeys(job.task_of(segment) for segment in job.chosen.segments))
    files = _Files(job, folder)
    episodes: list[dict[str, Any]] = []
    totals = _Totals()
    try:
        for number, (segment, rows) in enumerate(job.read()):
            columns = _columns(job, segment, rows, number, files.n_rows, tasks.index(job.task_of(segment)))
            counts = {view: pixel_counts(rgb(image) for image in rows.images(view)) for view in rows.frames}
            stats = {name: vector_stats(values) for name, values in columns.items()}
            stats |= {view_key(view): image_stats(count, len(rows)) for view, count in counts.items()}
            place = files.append(columns, rows)
            episodes.append(_episode_row(job, segment, number, place, stats))
            totals.add(segment, rows, columns, counts)
    except BaseException:
        files.abandon()
        raise
    files.close()
    _write_meta(job, folder, tasks, episodes, totals)
    return _told(job, folder)


# --- the table ----------------------------------------------------------------------------------------------------------


def _columns(
    job: ExportJob, segment: Segment, rows: Rows, number: int, first_index: int, task: int
) -> dict[str, npt.NDArray[Any]]:
    """Every column of numbers, [R] or [R,D], in order."""
    count = len(rows)
    done = np.zeros(count, np.bool_)
    done[-1] = segment.ends_episode
    columns: dict[str, npt.NDArray[Any]] = {"observation.state": rows.low_dim} if job.shapes.low_dim else {}
    columns |= {"action": rows.action} if rows.action is not None else {}
    columns |= {
        "timestamp": timestamps_s(job, count),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, number),
        "index": first_index + np.arange(count),
        "task_index": np.full(count, task),
        "next.done": done,
        "log_time_ns": rows.log_time_ns,
    }
    columns |= {"sim_state": rows.state} if job.shapes.state and rows.state is not None else {}
    return columns | ({"valid": rows.valid} if job.marked else {})


def timestamps_s(job: ExportJob, count: int) -> npt.NDArray[np.float32]:
    """k / fps, rounded once."""
    return (np.arange(count) * job.fps.denominator / job.fps.numerator).astype(np.float32)


def _array(values: npt.NDArray[Any]) -> pa.Array:
    """[R] as numbers, [R,D] as lists of fixed length; one number is no list."""
    if values.ndim == 1 or values.shape[1] == 1:
        return pa.array(values.reshape(-1))
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


class _Files:
    """The table's and the videos' files, each begun anew where the one before has grown to its limit."""

    def __init__(self, job: ExportJob, folder: Path) -> None:
        self._job, self._folder = job, folder
        self.n_rows = 0
        self._table: pq.ParquetWriter | None = None
        self._table_place = Place()
        self._videos: dict[str, VideoWriter] = {}
        self._video_places = {view: Place() for view in job.shapes.views if coding_of(job, view) is not None}

    def append(self, columns: Mapping[str, npt.NDArray[Any]], rows: Rows) -> dict[str, Any]:
        """Write one episode; where its rows and frames lie, as the table of episodes says it."""
        places: dict[str, Any] = {}
        for view in self._video_places:
            places |= self._append_video(view, rows)
        arrays = {name: _array(values) for name, values in columns.items()}
        for view in rows.frames:
            if view not in self._video_places:
                cells = [{"bytes": png(image), "path": None} for image in rows.images(view)]
                arrays[view_key(view)] = pa.array(cells, _IMAGE)
        table = pa.table(arrays)
        path = self._folder / DATA_PATH.format(**self._table_place.indices)
        if self._table is not None and path.stat().st_size >= DATA_FILE_MB * 1024**2:
            self._table.close()
            self._table, self._table_place = None, Place(self._table_place.number + 1)
            path = self._folder / DATA_PATH.format(**self._table_place.indices)
        if self._table is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._table = pq.ParquetWriter(path, table.schema, compression="snappy", write_page_checksum=True)
        self._table.write_table(table, row_group_size=len(rows))
        places |= {f"data/{name}": number for name, number in self._table_place.indices.items()}
        places |= {"dataset_from_index": self.n_rows, "dataset_to_index": self.n_rows + len(rows)}
        self.n_rows += len(rows)
        return places

    def _append_video(self, view: str, rows: Rows) -> dict[str, Any]:
        writer, coding = self._videos.get(view), coding_of(self._job, view)
        assert coding is not None
        if writer is not None and writer.n_bytes >= VIDEO_FILE_MB * 1024**2:
            writer.close()
            writer, self._video_places[view] = None, Place(self._video_places[view].number + 1)
        if writer is None:
            path = self._folder / VIDEO_PATH.format(video_key=view_key(view), **self._video_places[view].indices)
            height, width, _ = self._job.shapes.views[view]
            writer = VideoWriter(path, height=height, width=width, fps=self._job.fps, coding=coding)
            self._videos[view] = writer
        first = writer.n_frames
        writer.append(rows.images(view))
        prefix = f"videos/{view_key(view)}/"
        places = {prefix + name: number for name, number in self._video_places[view].indices.items()}
        return places | {
            prefix + "from_timestamp": float(first / self._job.fps),
            prefix + "to_timestamp": float(writer.n_frames / self._job.fps),
        }

    def close(self) -> None:
        for writer in self._videos.values():
            writer.close()
        if self._table is not None:
            self._table.close()

    def abandon(self) -> None:
        for writer in self._videos.values():
            writer.abandon()
        if self._table is not None:
            self._table.close()


def png(image: U8) -> bytes:
    """uint8 [H,W,3] or [H,W,1] as PNG, without loss."""
    return cv2.imencode(".png", image[..., ::-1] if image.shape[-1] == 3 else image)[1].tobytes()


# --- meta/ --------------------------------------------------------------------------------------------------------------


@dataclass
class _Totals:
    """What statistics of the whole are made of: rows of the training side, or all where there is no split."""

    columns: dict[str, list[npt.NDArray[Any]]] = field(default_factory=dict)
    counts: dict[str, I64] = field(default_factory=dict)
    n_rows: int = 0
    side: str | None = None

    def add(
        self, segment: Segment, rows: Rows, columns: Mapping[str, npt.NDArray[Any]], counts: Mapping[str, I64]
    ) -> None:
        """Segments come training side first: what comes after it is left out."""
        if self.n_rows and self.side == "train" and segment.side != "train":
            return
        self.side = segment.side
        for name, values in columns.items():
            self.columns.setdefault(name, []).append(values)
        for view, count in counts.items():
            self.counts[view] = self.counts[view] + count if view in self.counts else count
        self.n_rows += len(rows)

    def stats(self) -> dict[str, Stats]:
        stats = {name: vector_stats(np.concatenate(values)) for name, values in self.columns.items()}
        return stats | {view_key(view): image_stats(count, self.n_rows) for view, count in self.counts.items()}


def _episode_row(
    job: ExportJob, segment: Segment, number: int, place: Mapping[str, Any], stats: Mapping[str, Stats]
) -> dict[str, Any]:
    row = {"episode_index": number, "tasks": [job.task_of(segment)], "length": segment.n_rows, **place, **flat(stats)}
    row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
    return row | {f"vilp/{name}": value for name, value in segment.flat_provenance.items()}


def _write_meta(
    job: ExportJob, folder: Path, tasks: list[str], episodes: list[dict[str, Any]], totals: _Totals
) -> None:
    (folder / EPISODES_PATH).parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(episodes), folder / EPISODES_PATH, compression="snappy")
    pq.write_table(_tasks_table(tasks), folder / "meta/tasks.parquet")
    _write_json(folder / "meta/info.json", _info(job, tasks, folder))
    _write_json(folder / "meta/stats.json", totals.stats())


def _tasks_table(tasks: list[str]) -> pa.Table:
    """The table as pandas reads it: `task_index`, by the task as its index."""
    column = {"field_name": "task", "metadata": None, "name": "task", "numpy_type": "object", "pandas_type": "unicode"}
    number = {
        "field_name": "task_index",
        "metadata": None,
        "name": "task_index",
        "numpy_type": "int64",
        "pandas_type": "int64",
    }
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": [number, column], "pandas_version": "2.0.0"}
    table = pa.table({"task_index": np.arange(len(tasks)), "task": tasks})
    return table.replace_schema_metadata({b"pandas": json.dumps(pandas)})


def _info(job: ExportJob, tasks: list[str], folder: Path) -> dict[str, Any]:
    features = _features(job)
    videos = any(table["dtype"] == "video" for table in features.values())
    robots = {segment.entry.tags.get("robot") for segment in job.chosen.segments}
    return {
        "codebase_version": VERSION,
        "robot_type": robots.pop() if len(robots) == 1 else None,
        "total_episodes": len(job.chosen.segments),
        "total_frames": job.chosen.n_rows,
        "total_tasks": len(tasks),
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": VIDEO_FILE_MB,
        "fps": _info_fps(job),
        "splits": _splits(job),
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if videos else None,
        "features": features,
    }


def _splits(job: ExportJob) -> dict[str, str]:
    """Ranges of episodes; all are `train` where no split was drawn."""
    train, val, rest = (len(job.chosen.on(side)) for side in ("train", "val", None))
    if job.chosen.lock is None:
        return {"train": f"0:{rest}"}
    ranges = {"train": (0, train), "val": (train, train + val), "no_side": (train + val, train + val + rest)}
    return {name: f"{first}:{end}" for name, (first, end) in ranges.items() if end > first}


def _features(job: ExportJob) -> dict[str, Any]:
    def feature(dtype: str, width: int = 1, names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [width], "names": names}

    def labelled(parts: Any) -> list[str]:
        return [f"{part.name}.{label}" for part in parts for label in part.labels]

    features = {}
    if job.shapes.low_dim:
        features["observation.state"] = feature("float32", job.shapes.low_dim, labelled(job.low_dim))
    if job.shapes.action is not None:
        features["action"] = feature("float32", job.shapes.action, labelled(job.action))
    for view in job.shapes.views:
        features[view_key(view)] = _image_feature(job, view)
    features |= {name: feature("float32" if name == "timestamp" else "int64") for name in _COUNTING}
    features |= {"next.done": feature("bool"), "log_time_ns": feature("int64")}
    features |= {"sim_state": feature("float64", job.shapes.state)} if job.shapes.state else {}
    return features | ({"valid": feature("bool")} if job.marked else {})


def _image_feature(job: ExportJob, view: str) -> dict[str, Any]:
    height, width, channels = job.shapes.views[view]
    coding, names = coding_of(job, view), ["height", "width", "channels"]
    if coding is None:
        return {"dtype": "image", "shape": [height, width, channels], "names": names}
    info = {
        "video.height": height, "video.width": width, "video.codec": "h264", "video.pix_fmt": coding.pixels.replace("rgb24", "gbrp"),
        "video.is_depth_map": channels == 1, "video.fps": _info_fps(job), "video.channels": 3, "has_audio": False,
    }  # fmt: skip
    return {"dtype": "video", "shape": [height, width, 3], "names": names, "info": info}


def _info_fps(job: ExportJob) -> int | float:
    return job.fps.numerator if job.fps.denominator == 1 else float(job.fps)


def _write_json(path: Path, table: Any) -> None:
    path.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


# --- what is told -------------------------------------------------------------------------------------------------------


def _told(job: ExportJob, folder: Path) -> Written:
    written = Written()
    for view in job.shapes.views:
        coding, key = coding_of(job, view), view_key(view)
        size = sum(path.stat().st_size for path in _files_of(folder, key, coding is not None))
        words = "PNG in the table" if coding is None else str(coding)
        written.views[view] = ViewWritten(key, words, job.chosen.n_rows, size)
    episodes = f"columns vilp/… of {EPISODES_PATH}"
    written.carried = {
        "low_dim": "observation.state; parts by its names",
        "action": "action; parts by its names" if job.shapes.action is not None else "(none stored)",
        "action's unit and frame": "export.json and README.md",
        "split": "splits in meta/info.json, training episodes first",
        "control ticks": "column log_time_ns; timestamp counts k / fps from the start",
        "end of an episode": "column next.done, True at its last step",
        "tags, outcome, source, SHA-256": episodes,
    }
    written.carried |= {"simulator state": "column sim_state, no input of a policy"} if job.shapes.state else {}
    written.carried |= {"masked steps": "column valid; their numbers are NaN"} if job.marked else {}
    side = "the training side alone" if job.chosen.lock and job.chosen.on("train") else "all rows"
    written.notes.append(f"meta/stats.json is of {side}")
    if depth := job.depth_views() & {view for view in job.shapes.views if coding_of(job, view) is not None}:
        written.notes.append(f"depth, three equal channels without loss: {', '.join(sorted(depth))}")
    return written


def _files_of(folder: Path, key: str, is_video: bool) -> Iterator[Path]:
    return (folder / "videos" / key).rglob("*.mp4") if is_video else (folder / "data").rglob("*.parquet")
