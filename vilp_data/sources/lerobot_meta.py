"""What the folder meta/ of a LeRobot dataset says: rate, features, and where each episode's rows and frames lie.

v2.0 and v2.1 keep one Parquet and one video file an episode (meta/episodes.jsonl); v3.0 keeps many episodes in one file, and says in
meta/episodes/…/*.parquet which rows and which seconds are whose. Nothing here is believed: paths stay in the folder, numbers in bounds.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import isfinite, prod
from pathlib import Path, PurePosixPath
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from vilp_data.errors import LogError, copy_again, reason
from vilp_data.short_names import clean_name
from vilp_data.sources.row_clock import is_rate

RECOPY = copy_again("folder meta/")
BOOKKEEPING = frozenset({"timestamp", "frame_index", "episode_index", "index", "task_index"})
"""Columns that count rows rather than measure anything: no topics."""

MAX_ROWS = 1 << 31
_PLACE = re.compile(r"\{(\w+)(?::0?(\d{1,2})d)?\}")
_TYPES = (
    KeyError,
    AttributeError,
    IndexError,
    ValueError,
    TypeError,
    OSError,
    RecursionError,
    OverflowError,
    pa.ArrowException,
)


@dataclass(frozen=True)
class Feature:
    """One topic. `kind`: "video", "image" (embedded in Parquet), "numbers" or "text"; `shape` of one row; `names` of its numbers."""

    name: str
    kind: str
    shape: tuple[int, ...]
    names: tuple[str, ...]


@dataclass(frozen=True)
class VideoPart:
    """An episode's frames: those of `path` from `from_s` on, by the video's own clock."""

    path: str
    from_s: float


@dataclass(frozen=True)
class EpisodeMeta:
    """One episode: `n_rows` rows of the Parquet file `table`, and for each video feature its part of a video."""

    index: int
    n_rows: int
    tasks: tuple[str, ...]
    table: str
    videos: Mapping[str, VideoPart]


@dataclass(frozen=True)
class DatasetMeta:
    """A whole dataset. `info` is meta/info.json; `episodes` in order of their index, as far as the list of episodes goes."""

    version: str
    fps: float
    robot: str | None
    features: Mapping[str, Feature]
    episodes: tuple[EpisodeMeta, ...]
    info: Mapping[str, Any]

    def doubts(self) -> list[str]:
        """Where the list of episodes is shorter than meta/info.json counts, or numbers are left out of it."""
        found = []
        last = self.episodes[-1].index if self.episodes else -1
        if (holes := last + 1 - len(self.episodes)) > 0:
            first = next(place for place, episode in enumerate(self.episodes) if place != episode.index)
            found.append(f"the list of episodes leaves out {holes:,} of them, from episode {first} on")
        listed = {
            "total_episodes": len(self.episodes),
            "total_frames": sum(episode.n_rows for episode in self.episodes),
        }
        for name, count in listed.items():
            stated = self.info.get(name)
            if isinstance(stated, int) and stated != count:
                what = name.removeprefix("total_")
                found.append(f"meta/info.json counts {stated:,} {what}, the list of episodes holds {count:,}")
        return found


def is_lerobot(path: Path) -> bool:
    return (path / "meta" / "info.json").is_file()


def read_meta(root: Path) -> DatasetMeta:
    """LogError where meta/ cannot be read, contradicts itself, or is of a version that is not read (v1)."""
    path = root / "meta" / "info.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version, fps = str(info["codebase_version"]), float(info["fps"])
        features = {name: _feature(name, table) for name, table in info["features"].items() if name not in BOOKKEEPING}
    except _TYPES as error:
        raise LogError("meta/info.json cannot be used", where=root, found=reason(error), remedy=RECOPY) from error
    if not is_rate(fps):
        raise LogError(
            "meta/info.json states no rate", where=root, found=f"fps {fps}", remedy="state fps in meta/info.json"
        )
    try:
        episodes = tuple(sorted(_episodes(root, version, info, features), key=lambda episode: episode.index))
    except _TYPES as error:
        raise LogError("the list of episodes cannot be used", where=root, found=reason(error), remedy=RECOPY) from error
    _check(root, episodes)
    robot = info.get("robot_type")
    return DatasetMeta(version, fps, robot if isinstance(robot, str) else None, features, episodes, info)


def _feature(name: str, table: Mapping[str, Any]) -> Feature:
    dtype, shape = str(table["dtype"]), tuple(int(size) for size in table.get("shape") or (1,))
    if any(size < 0 for size in shape) or prod(shape) > MAX_ROWS:
        raise ValueError(f"feature {name!r} has shape {shape}")
    kind = dtype if dtype in ("video", "image") else "text" if dtype in ("string", "large_string") else "numbers"
    return Feature(name, kind, shape, tuple(_flat_names(table.get("names"))))


def _flat_names(names: Any) -> Iterator[str]:
    """Names as the versions write them: a list, a list in a list, or a dict of lists."""
    if isinstance(names, str):
        yield clean_name(names)
    for inner in names.values() if isinstance(names, dict) else names if isinstance(names, list) else ():
        yield from _flat_names(inner)


def _episodes(
    root: Path, version: str, info: Mapping[str, Any], features: Mapping[str, Feature]
) -> Iterator[EpisodeMeta]:
    videos = [name for name, feature in features.items() if feature.kind == "video"]
    if version.startswith("v2."):
        return _episodes_v2(root, info, videos)
    if version.startswith("v3."):
        return _episodes_v3(root, info, videos)
    remedy = "convert it with lerobot's own script; v2.0, v2.1 and v3 are read"
    raise LogError("a LeRobot dataset of a version that is not read", where=root, found=version, remedy=remedy)


def _episodes_v2(root: Path, info: Mapping[str, Any], videos: list[str]) -> Iterator[EpisodeMeta]:
    chunk_size = max(int(info.get("chunks_size") or 1000), 1)
    path = root / "meta" / "episodes.jsonl"
    if not path.is_file():
        raise LogError("the list of episodes is missing", where=root, found="no meta/episodes.jsonl", remedy=RECOPY)
    with path.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines, start=1):
            if not line.strip():
                continue
            try:
                row = json.loads(line)
                index, n_rows = int(row["episode_index"]), int(row["length"])
                tasks = tuple(map(str, row.get("tasks") or ()))
            except _TYPES as error:
                found = f"line {number}: {reason(error)}"
                raise LogError("meta/episodes.jsonl cannot be read", where=root, found=found, remedy=RECOPY) from error
            places: dict[str, int | str] = {"episode_index": index, "episode_chunk": index // chunk_size}
            parts = {key: VideoPart(_path(info["video_path"], places | {"video_key": key}), 0.0) for key in videos}
            yield EpisodeMeta(index, n_rows, tasks, _path(info["data_path"], places), parts)


def _episodes_v3(root: Path, info: Mapping[str, Any], videos: list[str]) -> Iterator[EpisodeMeta]:
    files = sorted((root / "meta" / "episodes").rglob("*.parquet"))
    if not files:
        raise LogError(
            "the list of episodes is missing", where=root, found="no meta/episodes/…/*.parquet", remedy=RECOPY
        )
    for file in files:
        parquet = pq.ParquetFile(file)
        if parquet.metadata.num_rows > 10_000_000:
            raise ValueError(f"{file.name} counts {parquet.metadata.num_rows} episodes")
        # The rest is statistics, hundreds of columns of them.
        wanted = [name for name in parquet.schema_arrow.names if not name.startswith("stats/")]
        for row in parquet.read(columns=wanted).select(wanted).to_pylist():
            places = {"chunk_index": int(row["data/chunk_index"]), "file_index": int(row["data/file_index"])}
            parts = {key: _video_part(info, row, key) for key in videos}
            tasks = tuple(map(str, row.get("tasks") or ()))
            table = _path(info["data_path"], places)
            yield EpisodeMeta(int(row["episode_index"]), int(row["length"]), tasks, table, parts)


def _video_part(info: Mapping[str, Any], row: Mapping[str, Any], key: str) -> VideoPart:
    prefix = f"videos/{key}/"
    places = {"chunk_index": int(row[f"{prefix}chunk_index"]), "file_index": int(row[f"{prefix}file_index"])}
    from_s = float(row[f"{prefix}from_timestamp"])
    if not (isfinite(from_s) and 0 <= from_s < 1e9):
        raise ValueError(f"{prefix}from_timestamp is {from_s}")
    return VideoPart(_path(info["video_path"], places | {"video_key": key}), from_s)


def _path(template: Any, places: Mapping[str, int | str]) -> str:
    """A path template filled in: `{episode_index:06d}` and the like, and nothing else that Python's format would do."""

    def fill(match: re.Match[str]) -> str:
        value, width = places[match[1]], int(match[2] or 0)
        return f"{value:0{width}d}" if isinstance(value, int) else value

    path = _PLACE.sub(fill, str(template))
    parts = PurePosixPath(path)
    if parts.is_absolute() or not parts.parts or ".." in parts.parts or "\\" in path or "\0" in path:
        raise ValueError(f"{path!r} leads out of the dataset's folder")
    return path


def _check(root: Path, episodes: tuple[EpisodeMeta, ...]) -> None:
    numbers = [episode.index for episode in episodes]
    if len(set(numbers)) < len(numbers):
        twice = next(number for number in numbers if numbers.count(number) > 1)
        raise LogError("an episode is listed twice", where=root, found=f"episode {twice}", remedy=RECOPY)
    if bad := [episode for episode in episodes if episode.index < 0 or not 0 <= episode.n_rows < MAX_ROWS]:
        found = f"episode {bad[0].index} of {bad[0].n_rows} rows"
        raise LogError("the list of episodes holds impossible numbers", where=root, found=found, remedy=RECOPY)
