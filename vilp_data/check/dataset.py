"""A dataset folder looked at once: the bytes of every stored file verified (episodes, latents, what waits for an undo, the split by its own
hash), every episode's vectors judged, two frames a second looked at."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from vilp_data import shards
from vilp_data.check.action_fit import MAX_STEPS, Trajectory
from vilp_data.check.cameras import SAMPLE_HZ, FrameSample, camera_findings, sample_frame, thumbnails_of
from vilp_data.check.findings import Finding, Place, Severity, placed, worst_first
from vilp_data.check.motion import Series, idle_ends, idle_findings, moved_between, series_findings
from vilp_data.check.report import Checked, Sheet, Steps, TopicFacts
from vilp_data.check.stored_files import damaged, held_findings, latent_findings
from vilp_data.check.tracks import PICTURES, picture_of
from vilp_data.dataset_action_sets import check_sets
from vilp_data.dataset_split import check_dataset_split, find_split
from vilp_data.duplicates import near_duplicates
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError, VilpDataError
from vilp_data.idle import moving_columns
from vilp_data.locate import is_dataset
from vilp_data.spec import TaskSpec
from vilp_data.split_lock import SplitLock
from vilp_data.types import F32, F64, U8, Bool
from vilp_data.vector_parts import shared_names, vector_parts
from vilp_data.windows import valid_runs

INVALID_SHARE = 0.2
"""An episode of which more steps are masked than this gives few windows, and deserves a look."""

SERIOUS_NOTES = re.compile(r"damaged|older than|missing, stale|differently")
"""What ingest noted about an episode and what is more than a remark."""


def check_dataset(root: Path) -> Checked:
    """Everything that is wrong with the dataset at `root`. Never raises for what is in it: a damaged file is a finding. UsageError where
    `root` is no dataset."""
    if not is_dataset(root):
        raise UsageError(
            "not a dataset: it has no dataset.json", where=root, remedy="`vilp-data ingest LOGS…` makes one"
        )
    store = EpisodeStore(root)
    try:
        spec, entries = store.spec(), store.index()
    except VilpDataError as error:
        return Checked(str(root), "dataset", "dataset", (damaged(error, str(root), None),))
    return _Look(store, spec, entries).run()


class _Look:
    """One look at one dataset."""

    def __init__(self, store: EpisodeStore, spec: TaskSpec, entries: list[EpisodeEntry]) -> None:
        self.store, self.spec, self.entries, self.source = store, spec, entries, str(store.root)
        self.findings: list[Finding] = []
        self.pictures: dict[str, list[tuple[str, U8]]] = {view: [] for view in spec.views}
        self.thumbnails: dict[str, F32] = {}
        self.trajectories: list[Trajectory] = []
        self.moved: dict[str, Bool] = {}  # episode -> which columns of low_dim move in it
        self.columns: tuple[str, ...] = ()
        self.shared = shared_names((entry.column_names for entry in entries), "low_dim")

    def run(self) -> Checked:
        if not self.entries:
            self._say("error", "empty", "the dataset holds no episode", "`vilp-data ingest LOGS…`")
        every = max(-(-len(self.entries) // PICTURES), 1)
        for number, entry in enumerate(self.entries):
            try:
                self._look(entry, with_picture=number % every == 0)
            except VilpDataError as error:
                self.findings.append(damaged(error, self.source, entry.id))
        self.findings += [*latent_findings(self.store.root, self.entries), *held_findings(self.store.root)]
        self._never_moving()
        self._look_alike(self._split())
        self._action_sets()
        rate_hz = self.entries[0].rate_hz if self.entries else 0.0
        steps = Steps("action", rate_hz, True, tuple(self.trajectories)) if self.trajectories else None
        return Checked(
            source=self.source, kind="dataset", format=f"dataset, task {self.spec.name}",
            findings=tuple(worst_first(self.findings)), size_bytes=_size(self.store), n_episodes=len(self.entries),
            duration_s=sum(entry.n_steps / entry.rate_hz for entry in self.entries), topics=tuple(self._facts()),
            sheets=tuple(Sheet(view, pictures) for view, pictures in self.pictures.items() if pictures),
            thumbnails=self.thumbnails, steps=steps,
        )  # fmt: skip

    # --- one episode

    def _look(self, entry: EpisodeEntry, *, with_picture: bool) -> None:
        for path in (
            self.store.steps_path(entry.id),
            *(self.store.frames_path(v, entry.id) for v in entry.frames_sha256),
        ):
            shards.verify_shard(path)
        arrays = open_steps(self.store, entry, entry.frames_sha256)
        at_s = (arrays["log_time_ns"] - arrays["log_time_ns"][0]) / 1e9
        valid = np.asarray(arrays["valid"])
        found = [*self._masked(entry, valid, at_s), *self._ingest_notes(entry)]
        state = Series(
            "low_dim",
            self._labels(arrays, "low_dim", entry.column_names.get("low_dim", {})),
            at_s[valid],
            _values(arrays, "low_dim", valid),
        )
        action = None
        if "action" in arrays:
            labels = self._labels(arrays, "action", entry.column_names.get("action", {}))
            action = Series("action", labels, at_s[valid], _values(arrays, "action", valid), command=True)
            found += series_findings(action)
        found += series_findings(state, busy=action)
        if state.values.shape[1]:
            self.moved[entry.id] = moving_columns(state.values)
            self.columns = tuple(self._labels(arrays, "low_dim", self.shared))
        vectors = [arrays[name].astype(np.float64) for name in ("low_dim", "action") if name in arrays]
        idle = idle_ends(np.concatenate(vectors, axis=1), at_s, valid)  # as `trim` looks at it
        if idle is not None:
            remedy = f"`vilp-data trim {self.source}` takes idle ends off without decoding anything again"
            found += idle_findings(idle, float(at_s[-1]), remedy)

        def moved(start_s: float, end_s: float) -> bool | None:
            return moved_between(state, start_s, end_s) if state.values.shape[1] else None

        seen: list[F32] = []
        for view in sorted(entry.frames_sha256):
            samples = self._samples(entry, view, arrays[f"source_index/{view}"], at_s, with_picture=with_picture)
            found += camera_findings(f"view {view}", samples, moved=moved)
            small = thumbnails_of(samples)
            seen += [small] if small is not None else []
        if seen:
            self.thumbnails[entry.id] = np.concatenate(seen)
        self.findings += placed(found, self.source, entry.id)
        if action is not None and state.values.shape[1] and sum(len(s.valid) for s in self.trajectories) <= MAX_STEPS:
            self.trajectories.append(
                Trajectory(entry.id, arrays["low_dim"].astype(np.float64), arrays["action"].astype(np.float64), valid)
            )

    def _samples(
        self, entry: EpisodeEntry, view: str, source_index: np.ndarray[tuple[int], np.dtype[np.int32]], at_s: F64, *,
        with_picture: bool,
    ) -> list[FrameSample]:  # fmt: skip
        frames = open_frames(self.store, entry, view)
        stride = max(round(entry.rate_hz / SAMPLE_HZ), 1)
        steps = range(0, len(at_s), stride)
        if with_picture:
            middle = len(at_s) // 2
            self.pictures[view].append((f"{entry.id}, {at_s[middle]:.1f} s", picture_of(frames[source_index[middle]])))
        return [sample_frame(frames[source_index[step]], float(at_s[step])) for step in steps]

    def _labels(
        self, arrays: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float32]]], vector: str,
        names: Mapping[str, Sequence[str]],
    ) -> list[str]:  # fmt: skip
        parts = self.spec.low_dim if vector == "low_dim" else self.spec.action
        known = vector_parts(arrays[vector], parts, names)
        return [
            f"{part}.{label}" if part else f"{vector}[{label}]"
            for part, (labels, _) in known.items()
            for label in labels
        ]

    def _masked(self, entry: EpisodeEntry, valid: Bool, at_s: F64) -> Iterator[Finding]:
        share = 1 - float(valid.mean())
        if share <= INVALID_SHARE:
            return
        runs = valid_runs(~valid)
        first, end = runs[int((runs[:, 1] - runs[:, 0]).argmax())].tolist()
        yield Finding(
            severity="warning", kind="masked-steps", place=Place(start_s=float(at_s[first]), end_s=float(at_s[end - 1])),
            what=f"{share:.0%} of its steps are masked",
            evidence={"n_masked": int((~valid).sum()), "n_steps": len(valid), "n_runs": len(runs)},
            remedy=f"check its log ({entry.source}); a longer stale_after_s keeps steps that see older values",
        )  # fmt: skip

    def _ingest_notes(self, entry: EpisodeEntry) -> Iterator[Finding]:
        for sentence in entry.findings:
            severity: Severity = "warning" if SERIOUS_NOTES.search(sentence) else "note"
            kind = "ingest-" + re.sub(r"[^a-z]+", "-", re.sub(r"\d[\d.]*", "", sentence.split(":")[0].lower())).strip(
                "-"
            )
            yield Finding(
                severity=severity, kind=kind, place=Place(), what=sentence, remedy=f"check its log, {entry.source}"
            )

    # --- episodes together

    def _never_moving(self) -> None:
        """Columns that move in no episode, and columns that move in all but a few."""
        shapes = {len(moving) for moving in self.moved.values()}
        if len(shapes) != 1 or not self.columns:
            return
        table = np.array(list(self.moved.values()))
        never = np.asarray(~table.any(axis=0))
        if never.any() and not never.all():
            names = [name for name, still in zip(self.columns, never.tolist(), strict=True) if still]
            told = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
            what = f"{told} {'moves' if len(names) == 1 else 'move'} in no episode"
            self._say("note", "never-moves", what, "leave it out of low_dim, or look at its sensor", topic="low_dim")
        if len(table) < 10:
            return
        for column in np.flatnonzero(~never & (table.mean(axis=0) >= 0.9)).tolist():
            for id, moving in self.moved.items():
                if not moving[column] and moving.any():
                    what = f"{self.columns[column]} stands still here, though it moves in other episodes"
                    self._say("warning", "stuck-joint", what, "look at its log; leave it out if the sensor had failed",
                              topic="low_dim", episode=id)  # fmt: skip

    def _look_alike(self, lock: SplitLock | None) -> None:
        contents: dict[str, str] = {}
        for entry in self.entries:
            first = contents.setdefault(entry.content_sha256, entry.id)
            if first != entry.id:
                remedy = "`vilp-data remove` one of them; the split keeps such pairs on one side"
                self._say("warning", "duplicate", f"the same as {first}, to the last value", remedy, episode=entry.id)
        same = {entry.id: entry.content_sha256 for entry in self.entries}
        for pair in near_duplicates(self.thumbnails):
            if same[pair.first] == same[pair.second]:
                continue
            sides = {lock.assignment.get(id) for id in (pair.first, pair.second)} if lock else set()
            crosses = len(sides) > 1
            what = f"looks nearly like {pair.second}" + (", on the other side of the split" if crosses else "")
            remedy = (
                "look at both (`vilp-data view`); `vilp-data remove` one if they are two exports of the same recording"
            )
            self.findings.append(Finding(
                severity="warning" if crosses else "note", kind="near-duplicate",
                place=Place(source=self.source, episode=pair.first), what=what,
                evidence={"distance_grey_levels": pair.distance}, remedy=remedy,
            ))  # fmt: skip

    def _split(self) -> SplitLock | None:
        """What is wrong with the split; the split, where there is one that can be read."""
        try:
            lock, sentences = find_split(self.store.root), check_dataset_split(self.store.root)
        except VilpDataError as error:
            told = {finding.evidence.get("file") for finding in self.findings}
            if str(error.where) not in told:
                self.findings.append(damaged(error, self.source, None))
            return None
        for sentence in sentences:
            none_yet = sentence.startswith("no split yet")
            self._say("note" if none_yet else "warning", "split", sentence, f"`vilp-data split {self.source}`")
        return lock

    def _action_sets(self) -> None:
        for wrong in (error for _, errors in check_sets(self.store.root).values() for error in errors):
            evidence = {"file": str(wrong.where)} | ({"found": str(wrong.found)} if wrong.found is not None else {})
            place = Place(source=self.source)
            self.findings.append(
                Finding(
                    severity="warning",
                    kind="action-set",
                    place=place,
                    what=wrong.what,
                    evidence=evidence,
                    remedy=wrong.remedy,
                )
            )

    def _facts(self) -> Iterator[TopicFacts]:
        for view, table in self.spec.views.items():
            n = sum(entry.n_frames.get(view, 0) for entry in self.entries)
            yield TopicFacts(f"view {view}", table.topic, n, image=f"{table.height}x{table.width}")
        n_steps = sum(entry.n_steps for entry in self.entries)
        n_valid = sum(entry.n_valid for entry in self.entries)
        yield TopicFacts("steps", f"{n_valid} valid", n_steps)

    def _say(
        self, severity: Severity, kind: str, what: str, remedy: str | None, *, topic: str | None = None,
        episode: str | None = None,
    ) -> None:  # fmt: skip
        place = Place(source=self.source, topic=topic, episode=episode)
        self.findings.append(Finding(severity=severity, kind=kind, place=place, what=what, remedy=remedy))


def _values(arrays: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float32]]], vector: str, valid: Bool) -> F64:
    """A stored vector at the steps that may be used, float64 [v,D]: the others hold zeros."""
    return arrays[vector].astype(np.float64)[valid]


def _size(store: EpisodeStore) -> int:
    return sum(path.stat().st_size for path in (store.root / "episodes").rglob("*.safetensors"))
