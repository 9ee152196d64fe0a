"""LeRobot datasets v2.0, v2.1 and v3.0: a folder of Parquet tables and videos is one log, each of its episodes a demonstration.

Every feature is a topic, save those that count rows. A row's time is its `timestamp`, counted from its episode's start; episodes lie
one after the other, as many seconds as their rows have at the dataset's `fps`. The frame of a row is the one at its time stamp.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator
from contextlib import closing
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from vilp_data.errors import LogError, nearest
from vilp_data.sources.folder_hash import array_bytes, folder_sha256
from vilp_data.sources.lerobot_meta import EpisodeMeta, read_meta
from vilp_data.sources.lerobot_table import EpisodeTable
from vilp_data.sources.row_clock import RowClock
from vilp_data.sources.video_frames import frames_at, video_sha256
from vilp_data.types import F64, I64, LogEpisode, Message, TopicInfo

SCHEMAS = {"video": "array", "numbers": "array", "image": "foxglove.CompressedImage", "text": "text"}
LISTED_ROWS = 100_000  # whose times `message_times` looks up
LOOKED_AT = 50  # episodes in which `first_messages` looks for a topic
REWRITE = "write the dataset again: timestamp = frame_index / fps; `vilp-data ingest` takes the other episodes without this one"
SHOWN_INFO = ("codebase_version", "robot_type", "fps")  # not its totals: the list of episodes tells what is there


class LeRobotLog:
    """A `LogReader` over one dataset folder. Topics are features: `observation.state`, `action`, `observation.images.top`.

    Messages of videos are uint8 [H,W,3] arrays; of embedded images dicts as foxglove.CompressedImage has them; of numbers arrays of
    the feature's shape. What an episode lacks (its table, a video, rows, frames) is found when it is read, and stops no other."""

    format = "lerobot"

    def __init__(self, path: Path) -> None:
        self.path = path
        self._meta = read_meta(path)
        self._clock = RowClock(self._meta.fps)
        self._episodes: dict[str, tuple[EpisodeMeta, int]] = {}  # name -> episode, number of rows before it
        before = 0
        for episode in self._meta.episodes:
            self._episodes[f"episode_{episode.index:06d}"] = episode, before
            before += episode.n_rows
        self._n_rows = before

    def sha256(self) -> str:
        return folder_sha256(self.path)

    def demonstration_sha256(self, name: str) -> str:
        """SHA-256 of one episode: when it starts, its tasks, the values of its rows, its part of every video. However the files are
        cut up, and whatever else they hold: a dataset that grows leaves its episodes as they are. What cannot be read counts as such."""
        episode, before = self._episodes[name]
        digest = hashlib.sha256(f"{self._meta.fps!r} {before} {episode.n_rows} {episode.tasks!r};".encode())
        features = [self._meta.features[topic] for topic in sorted(self._meta.features)]
        try:
            with closing(EpisodeTable(self.path, episode)) as table:
                digest.update(table.timestamps_s.tobytes())
                for feature in features:
                    digest.update(f"{feature.name} {feature.kind} {feature.shape};".encode())
                    if feature.kind != "video":
                        for row in table.rows([feature], 0, table.n_rows):
                            digest.update(_row_bytes(row[feature.name]))
        except LogError:
            digest.update(b"unreadable")
        length_ns = self._clock.time_ns(episode.n_rows)
        for key, part in sorted(episode.videos.items()):
            start_ns = round(part.from_s * 1e9)
            try:
                where = self._where(episode, key)
                digest.update(video_sha256(self.path / part.path, start_ns, start_ns + length_ns, where=where).encode())
            except LogError:
                digest.update(f"{key} unreadable".encode())
        return digest.hexdigest()

    def topics(self) -> list[TopicInfo]:
        """Every feature, with the rows of the episodes whose table (and video, where it is one) is there."""
        found = []
        for name, feature in sorted(self._meta.features.items()):
            count = sum(episode.n_rows for episode in self._meta.episodes if self._has(episode, name))
            encoding = "video" if feature.kind == "video" else "parquet"
            names = feature.names if feature.kind == "numbers" else ()
            found.append(TopicInfo(name, SCHEMAS[feature.kind], encoding, count, names))
        return found

    def metadata(self) -> dict[str, dict[str, str]]:
        """`info`: what meta/info.json says of the whole. `names`: the names of the numbers in each feature, with commas between."""
        info = {key: str(self._meta.info[key]) for key in SHOWN_INFO if self._meta.info.get(key) is not None}
        named = {name: feature for name, feature in self._meta.features.items() if feature.kind == "numbers"}
        names = {name: ", ".join(feature.names) for name, feature in named.items() if feature.names}
        return {"info": info} | ({"names": names} if names else {})

    @property
    def whole(self) -> list[str]:
        """The names of the episodes that have all their files."""
        features = self._meta.features
        return [
            name for name, (episode, _) in self._episodes.items() if all(self._has(episode, key) for key in features)
        ]

    def episodes(self) -> list[LogEpisode]:
        return [
            LogEpisode(
                name, self._clock.time_ns(before), self._clock.time_ns(before + episode.n_rows), self._tags(episode)
            )
            for name, (episode, before) in self._episodes.items()
        ]

    def doubts(self) -> list[str]:
        """Where meta/ counts other episodes than it lists, and of how many the table or a video is not there."""
        found, episodes = self._meta.doubts(), self._meta.episodes
        missing = {"table": sum(episode.table not in self._files for episode in episodes)}
        for key in sorted({key for episode in episodes for key in episode.videos}):
            missing[f"video {key}"] = sum(episode.videos[key].path not in self._files for episode in episodes)
        return found + [
            f"{count} of {len(episodes)} episodes lack their {name}" for name, count in missing.items() if count
        ]

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        for topic in topics:
            if topic not in self._meta.features:
                remedy = nearest(topic, self._meta.features)
                raise LogError(f"no topic {topic!r} in this log", where=self.path, remedy=remedy)
        return self._messages(sorted(set(topics)), start_ns, end_ns)

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n] of the first episodes whose tables can be read; and whether they are all."""
        parts, listed = [np.empty(0, np.int64)], 0
        for name, (episode, _) in self._episodes.items():
            if listed + episode.n_rows > LISTED_ROWS:
                break
            try:
                with closing(EpisodeTable(self.path, episode)) as table:
                    parts.append(self._times_ns(name, table.timestamps_s))
            except LogError:
                continue  # it has no times; asking for its messages says why
            listed += episode.n_rows
        times = np.concatenate(parts)
        return dict.fromkeys(self._meta.features, times), len(times) == self._n_rows

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """Up to `limit` messages of the first episode that has them; the first one's error where none has."""
        first: LogError | None = None
        for name in list(self._episodes)[:LOOKED_AT]:
            messages = []
            try:
                for message in self._episode_messages(name, [topic], None, None):
                    messages.append(message)
                    if len(messages) == limit:
                        break
            except LogError as error:
                first = first or error
            if messages:
                return messages
        if first is not None:
            raise first
        return []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return

    @cached_property
    def _files(self) -> set[str]:
        """Of the files that meta/ names those that are there."""
        episodes = self._meta.episodes
        named = {episode.table for episode in episodes}
        named |= {part.path for episode in episodes for part in episode.videos.values()}
        return {path for path in named if (self.path / path).is_file()}

    def _has(self, episode: EpisodeMeta, feature: str) -> bool:
        video = episode.videos.get(feature)
        return episode.table in self._files and (video is None or video.path in self._files)

    # --- reading ---

    def _messages(self, topics: list[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        for name, (episode, before) in self._episodes.items():
            first_ns, stop_ns = self._clock.time_ns(before), self._clock.time_ns(before + episode.n_rows)
            if (start_ns is None or start_ns < stop_ns) and (end_ns is None or first_ns < end_ns):
                yield from self._episode_messages(name, topics, start_ns, end_ns)

    def _episode_messages(
        self, name: str, topics: list[str], start_ns: int | None, end_ns: int | None
    ) -> Iterator[Message]:
        episode, _ = self._episodes[name]
        features = [self._meta.features[topic] for topic in topics]
        with closing(EpisodeTable(self.path, episode)) as table:
            times_ns = self._times_ns(name, table.timestamps_s)
            first = 0 if start_ns is None else int(np.searchsorted(times_ns, start_ns))
            stop = len(times_ns) if end_ns is None else int(np.searchsorted(times_ns, end_ns))
            shown_s = _snapped(table.timestamps_s, self._meta.fps)[first:stop]
            videos = {
                feature.name: self._frames(episode, feature.name, shown_s)
                for feature in features
                if feature.kind == "video"
            }
            rows = table.rows([feature for feature in features if feature.kind != "video"], first, stop)
            for time_ns, row in zip(times_ns[first:stop].tolist(), rows, strict=True):
                # All of a row before any of it: a video that is missing leaves no topic a message ahead of the others.
                bodies = [next(videos[one.name]) if one.kind == "video" else row[one.name] for one in features]
                for feature, body in zip(features, bodies, strict=True):
                    yield Message(feature.name, SCHEMAS[feature.kind], time_ns, time_ns, body)

    def _frames(self, episode: EpisodeMeta, key: str, shown_s: F64) -> Iterator[Any]:
        part = episode.videos[key]
        wanted = [round((part.from_s + time_s) * 1e9) for time_s in shown_s.tolist()]
        return frames_at(self.path / part.path, wanted, where=self._where(episode, key))

    def _times_ns(self, name: str, timestamps_s: F64) -> I64:
        """Log times int64 [n] of an episode's rows; LogError where its time stamps do not rise, or leave its place in the log."""
        episode, before = self._episodes[name]
        start_ns, stop_ns = self._clock.time_ns(before), self._clock.time_ns(before + episode.n_rows)
        row = np.rint(timestamps_s * self._meta.fps)
        on_clock = _snapped(timestamps_s, self._meta.fps) == row / self._meta.fps
        times_ns = np.where(
            on_clock, np.rint((before + row) * 1e9 / self._meta.fps), start_ns + np.rint(timestamps_s * 1e9)
        )
        if not np.isfinite(times_ns).all() or (np.diff(times_ns) <= 0).any():
            bad = int(np.argmin(np.isfinite(times_ns) & (np.diff(times_ns, prepend=-np.inf) > 0)))
            found = f"{timestamps_s[bad]} s at row {bad}"
            raise LogError("time stamps that do not rise", where=self._where(episode), found=found, remedy=REWRITE)
        if len(times_ns) and (times_ns[0] < start_ns or times_ns[-1] >= stop_ns):
            last = f"{episode.n_rows} rows at {self._meta.fps:g} Hz last {(stop_ns - start_ns) / 1e9:.4f} s"
            found = f"from {timestamps_s[0]:.4f} to {timestamps_s[-1]:.4f} s; {last}"
            raise LogError(
                "time stamps that do not fit the dataset's fps", where=self._where(episode), found=found, remedy=REWRITE
            )
        return times_ns.astype(np.int64)

    def _tags(self, episode: EpisodeMeta) -> dict[str, str]:
        tags = {"task": "; ".join(episode.tasks)} if episode.tasks else {}
        return tags | ({"robot": self._meta.robot} if self._meta.robot else {})

    def _where(self, episode: EpisodeMeta, key: str | None = None) -> str:
        return f"{self.path}, episode {episode.index}" + (f", {key}" if key else "")


def _snapped(timestamps_s: F64, fps: float) -> F64:
    """Time stamps float64 [n] freed from what storing them as float32 did: those within its rounding of a multiple of 1 / fps are it."""
    exact = np.rint(timestamps_s * fps) / fps
    with np.errstate(invalid="ignore"):
        rounding = np.spacing(np.abs(timestamps_s).astype(np.float32)).astype(np.float64)
        return np.where(np.abs(timestamps_s - exact) <= rounding, exact, timestamps_s)


def _row_bytes(value: Any) -> bytes | memoryview:
    if isinstance(value, dict):
        return bytes(value["data"])
    return value.encode() if isinstance(value, str) else array_bytes(np.asarray(value))
