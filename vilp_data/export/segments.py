"""What of a dataset is exported, and its rows: segments of episodes, which are whole or the runs of valid steps between masked ones."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from vilp_data import shards
from vilp_data.dataset_split import find_split, read_split
from vilp_data.episode_files import open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import SpecError, StoreError, UsageError
from vilp_data.split_lock import Side, SplitLock
from vilp_data.types import F32, F64, I32, I64, RATE_TOLERANCE, U8, Bool, is_rollout
from vilp_data.windows import valid_runs

Masked = Literal["cut", "mark", "refuse"]

SHORTEST = 2
"""Runs of fewer valid steps hold no motion to learn: they are left out, and counted."""


@dataclass(frozen=True)
class Choice:
    """Which episodes to take.

    split            "train" or "val": one side; "all": both, training episodes first
    with_failures    episodes whose outcome is a failure too
    with_rollouts    a policy's own episodes too; they are on neither side of the split
    with_unlabelled  in a dataset that has actions: episodes without any too, their actions NaN
    masked           what becomes of masked steps: "cut" the episode there, "mark" them, or "refuse" such a dataset
    """

    split: Literal["train", "val", "all"] = "all"
    with_failures: bool = False
    with_rollouts: bool = False
    with_unlabelled: bool = False
    masked: Masked = "cut"


@dataclass(frozen=True)
class Segment:
    """Steps first, …, end - 1 of a stored episode, as it is today: one episode of the export."""

    entry: EpisodeEntry
    first: int
    end: int
    side: Side | None

    @property
    def n_rows(self) -> int:
        return self.end - self.first

    @property
    def is_whole(self) -> bool:
        return self.n_rows == self.entry.n_steps

    @property
    def ends_episode(self) -> bool:
        """Whether its last row is the last step of the episode, rather than the one before a masked step."""
        return self.end == self.entry.n_steps

    @property
    def provenance(self) -> dict[str, Any]:
        """Where it comes from, the same in every format. Steps are counted as ingest did, as `trim --steps` and `check` count them, from
        first_step up to the one before end_step."""
        entry = self.entry
        return {
            "episode": entry.id, "first_step": entry.first_step + self.first, "end_step": entry.first_step + self.end,
            "side": self.side, "outcome": entry.outcome, "tags": dict(sorted(entry.tags.items())), "rate_hz": entry.rate_hz,
            "source": entry.source, "source_episode": entry.source_episode, "source_sha256": entry.source_sha256, "key": entry.key,
        }  # fmt: skip

    @property
    def flat_provenance(self) -> dict[str, str | int | float]:
        """The same for formats that know no tables: tags as JSON, no side as an empty text."""
        told = self.provenance
        return {**told, "side": self.side or "", "tags": json.dumps(told["tags"], sort_keys=True)}

    def __str__(self) -> str:
        if self.is_whole:
            return self.entry.id
        told = self.provenance
        return f"{self.entry.id}, steps {told['first_step']} to {told['end_step'] - 1}"


@dataclass
class Chosen:
    """What is exported, and what is not.

    segments    training episodes, validation episodes, those without a side; each by id
    left_out  reason -> ids of episodes of which nothing is exported
    masked    id -> number of masked steps, of episodes that have some
    cut_away  id -> valid steps that go with them, in runs shorter than SHORTEST
    """

    segments: list[Segment] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)
    masked: dict[str, int] = field(default_factory=dict)
    cut_away: dict[str, int] = field(default_factory=dict)
    lock: SplitLock | None = None

    @property
    def n_rows(self) -> int:
        return sum(segment.n_rows for segment in self.segments)

    @property
    def has_action(self) -> bool:
        return any(segment.entry.has_action for segment in self.segments)

    @property
    def unlabelled(self) -> list[Segment]:
        return [segment for segment in self.segments if not segment.entry.has_action] if self.has_action else []

    def on(self, side: Side | None) -> list[Segment]:
        return [segment for segment in self.segments if segment.side == side]


@dataclass(frozen=True)
class Rows:
    """The rows of a segment.

    frames       view -> uint8 [n,H,W,C], the episode's stored frames
    shown        view -> int32 [R]: which of them each row shows
    log_time_ns  int64 [R]
    low_dim      float32 [R,L]; action float32 [R,A], NaN where the episode has none, or None where the dataset has none
    state        float64 [R,S] simulator state, or None
    valid        bool [R]; where it is False (masked = "mark"), low_dim and action are NaN
    """

    frames: Mapping[str, U8]
    shown: Mapping[str, I32]
    log_time_ns: I64
    low_dim: F32
    action: F32 | None
    state: F64 | None
    valid: Bool

    def __len__(self) -> int:
        return len(self.log_time_ns)

    def images(self, view: str) -> Iterator[U8]:
        """What each row shows, uint8 [H,W,C]."""
        return (self.frames[view][index] for index in self.shown[view])


def choose(store: EpisodeStore, choice: Choice) -> Chosen:
    """The segments to export. Raises UsageError where nothing is left or `masked = "refuse"` meets masked steps, SplitError where a
    side is asked for and no split was drawn."""
    chosen = Chosen(lock=read_split(store.root) if choice.split != "all" or find_split(store.root) else None)
    entries = [entry for entry in store.index() if not _left_out(entry, choice, chosen)]
    if any(entry.has_action for entry in entries) and not choice.with_unlabelled:
        chosen.left_out["without actions"] = [entry.id for entry in entries if not entry.has_action]
        entries = [entry for entry in entries if entry.has_action]
    for entry in entries:
        chosen.segments += _segments(store, entry, choice, chosen)
    order = {"train": 0, "val": 1, None: 2}
    chosen.segments.sort(key=lambda segment: (order[segment.side], segment.entry.id, segment.first))
    chosen.left_out = {reason: ids for reason, ids in chosen.left_out.items() if ids}
    if not chosen.segments:
        found = "; ".join(f"{len(ids)} {reason}" for reason, ids in chosen.left_out.items()) or "no episode"
        raise UsageError(
            "nothing to export", where=store.root, found=found, remedy="see --split and the --with-… options"
        )
    return chosen


def _left_out(entry: EpisodeEntry, choice: Choice, chosen: Chosen) -> bool:
    side = chosen.lock.assignment.get(entry.id) if chosen.lock else None
    reason = None
    if is_rollout(entry.tags) and not choice.with_rollouts:
        reason = "rollouts of a policy"
    elif entry.outcome == "failure" and not choice.with_failures:
        reason = "failures"
    elif choice.split != "all" and side != choice.split:
        reason = f"not on the side {choice.split!r}"
    if reason is not None:
        chosen.left_out.setdefault(reason, []).append(entry.id)
    return reason is not None


def _segments(store: EpisodeStore, entry: EpisodeEntry, choice: Choice, chosen: Chosen) -> list[Segment]:
    side = chosen.lock.assignment.get(entry.id) if chosen.lock else None
    whole = Segment(entry, 0, entry.n_steps, side)
    if entry.n_valid == entry.n_steps:
        return [whole]
    chosen.masked[entry.id] = entry.n_steps - entry.n_valid
    if choice.masked == "refuse":
        raise UsageError(
            "an episode with masked steps",
            where=entry.id,
            found=f"{entry.n_steps - entry.n_valid} of {entry.n_steps} steps; {'; '.join(entry.findings)}",
            remedy="--masked cut ends the episode there, --masked mark keeps them as NaN",
        )
    if choice.masked == "mark":
        return [whole]
    runs = valid_runs(open_steps(store, entry)["valid"]).tolist()
    short = sum(end - first for first, end in runs if end - first < SHORTEST)
    if short:
        chosen.cut_away[entry.id] = short
    segments = [Segment(entry, first, end, side) for first, end in runs if end - first >= SHORTEST]
    if not segments:
        chosen.left_out.setdefault("no two valid steps in a row", []).append(entry.id)
    return segments


def read_segments(
    store: EpisodeStore, segments: Sequence[Segment], n_action: int | None
) -> Iterator[tuple[Segment, Rows]]:
    """Each segment with its rows, one episode in memory at a time, every byte checksummed.

    `n_action` is the width of actions, None where the export has none. Raises StoreError for files that are damaged or not those
    of the index."""
    read: tuple[str, dict[str, U8]] | None = None
    for segment in segments:
        entry = segment.entry
        if read is None or read[0] != entry.id:
            read = entry.id, {view: store.read_frames(view, entry) for view in entry.frames_sha256}
        yield segment, _rows(store, segment, read[1], n_action)


def _rows(store: EpisodeStore, segment: Segment, frames: Mapping[str, U8], n_action: int | None) -> Rows:
    entry, rows = segment.entry, slice(segment.first, segment.end)
    shards.verify_shard(store.steps_path(entry.id))
    steps = open_steps(store, entry, frames)
    valid = np.array(steps["valid"][rows])
    low_dim, action = np.array(steps["low_dim"][rows]), None
    low_dim[~valid] = np.nan  # what is stored there is nobody's measurement
    if n_action is not None:
        action = np.full((segment.n_rows, n_action), np.nan, np.float32)
        if entry.has_action:
            action[valid] = steps["action"][rows][valid]
    return Rows(
        frames=frames,
        shown={
            view: np.clip(steps[f"source_index/{view}"][rows], 0, len(images) - 1) for view, images in frames.items()
        },
        log_time_ns=np.array(steps["log_time_ns"][rows]),
        low_dim=low_dim,
        action=action,
        state=np.array(steps["state"][rows]) if entry.has_state else None,
        valid=valid,
    )


@dataclass(frozen=True)
class Shapes:
    """What every segment of an export has in common: view -> [H,W,C]; widths of low_dim, action and state (None where there is none,
    or, for the state, where segments differ)."""

    views: Mapping[str, tuple[int, ...]]
    low_dim: int
    action: int | None
    state: int | None


def common_shapes(store: EpisodeStore, chosen: Chosen) -> Shapes:
    """The shapes of all segments. Raises StoreError where two episodes differ: one table cannot hold them."""
    entries = list({segment.entry.id: segment.entry for segment in chosen.segments}.values())
    found = [_shapes(store, entry) for entry in entries]
    first = found[0]
    for entry, shapes in zip(entries, found, strict=True):
        if shapes.views != first.views or shapes.low_dim != first.low_dim:
            remedy = "ingest every log with one task file"
            raise StoreError(
                "an episode of other shapes than the rest", where=entry.id, found=str(shapes), remedy=remedy
            )
    widths = {shapes.action for shapes in found if shapes.action is not None}
    if len(widths) > 1:
        raise StoreError("episodes whose actions differ in width", where=store.root, found=f"{sorted(widths)} numbers",
                         remedy="ingest every log with one task file")  # fmt: skip
    states = {shapes.state for shapes in found}
    return Shapes(
        first.views, first.low_dim, widths.pop() if widths else None, states.pop() if len(states) == 1 else None
    )


def _shapes(store: EpisodeStore, entry: EpisodeEntry) -> Shapes:
    tensors = shards.read_header(store.steps_path(entry.id)).tensors
    width = {name: tensors[name].shape[1] if name in tensors else None for name in ("action", "state")}
    views = {
        view: shards.read_header(store.frames_path(view, entry.id)).tensors["frames"].shape[1:]
        for view in sorted(entry.frames_sha256)
    }
    return Shapes(views, tensors["low_dim"].shape[1], width["action"], width["state"])


def common_rate_hz(segments: Sequence[Segment]) -> float:
    """The rate of the rows: that of all episodes; where they scatter as much as one dataset may (`types.RATE_TOLERANCE` around the first
    that was ingested), the roundest number among them near their median. SpecError where they differ by more."""
    rates = sorted({segment.entry.rate_hz for segment in segments})
    if rates[-1] / rates[0] > (1 + RATE_TOLERANCE) / (1 - RATE_TOLERANCE):
        found = f"{rates[0]:g} to {rates[-1]:g} steps a second"
        raise SpecError(
            "episodes of different rates", found=found, remedy="state rate_hz in the task TOML, and ingest again"
        )
    median = statistics.median(segment.entry.rate_hz for segment in segments)
    if rates[-1] / rates[0] - 1 <= 1e-6:
        return rates[0]
    return next((rate for digits in range(7) if rates[0] <= (rate := round(median, digits)) <= rates[-1]), median)
