"""Dataset surgery: episodes removed, trimmed and relabelled. Files change names or, of the small steps files, content; no frame is
decoded or encoded. Each call is one operation of the dataset's history, and `undo` takes it back."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data import history, shards
from vilp_data.dataset_action_sets import sets_broken_by
from vilp_data.dataset_split import find_split, split_by
from vilp_data.dataset_state import frames_name, steps_name
from vilp_data.edits import MIN_STEPS, relabelled, require_enough, trimmed
from vilp_data.episodes import EpisodeEntry, EpisodeStore, write_steps
from vilp_data.errors import SplitError, UsageError, nearest, number_of
from vilp_data.history import Changes
from vilp_data.idle import IDLE_S, IDLE_SHARE, moving_range
from vilp_data.removed import read_removed, removed_bytes, removed_episode, removed_path
from vilp_data.split import leaks
from vilp_data.split_lock import SplitLock
from vilp_data.types import OUTCOME_TAG, ROLLOUT_TAG
from vilp_data.writer_lock import writer_lock

MARGIN_S = 0.5
"""Rest that is kept at either end: a policy should see what standing still looks like."""

Steps = dict[str, npt.NDArray[Any]]


@dataclass
class SurgeryReport:
    """What a call did. `operation` is None where there was nothing to do; `changed` are ids; `notes` sentences."""

    operation: int | None = None
    changed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Trim:
    """What a trim leaves of an episode: steps `first` to `end` (one past the last) of the `n_steps` there are now, the first of which is
    step `counted_from` of the episode as it was ingested. `moves` False: nothing moves in it at all, and it is left as it is.
    `past_end`: the range that was asked for goes on after its last step."""

    id: str
    first: int
    end: int
    n_steps: int
    rate_hz: float
    counted_from: int = 0
    moves: bool = True
    past_end: bool = False

    @property
    def cuts(self) -> bool:
        return self.end - self.first < self.n_steps


# --- remove ----------------------------------------------------------------------------------------------------------------


def remove_episodes(root: Path, episodes: Sequence[str], *, reason: str = "") -> SurgeryReport:
    """Take episodes out. Their files wait in history/held/, their side of the split stays theirs, and ingesting their log again does
    not bring them back unless asked to.

    Raises UsageError for an unknown id (one that was removed before is none) and where nothing would be left."""
    with writer_lock(root):
        store, removed = EpisodeStore(root), read_removed(root)
        entries = {entry.id: entry for entry in store.index()}
        report = SurgeryReport()
        for id in dict.fromkeys(episodes):
            if id in entries:
                report.changed.append(id)
            elif id in removed:
                report.notes.append(f"{id}: removed already, by operation {removed[id].operation}")
            else:
                raise UsageError(f"no episode called {id!r}", where=root, remedy=nearest(id, entries))
        if not report.changed:
            store.ensure_index()
            return report
        if len(report.changed) == len(entries):
            remedy = "delete the folder instead, or keep an episode"
            raise UsageError("no episode would be left", where=root, found=f"{len(entries)} to remove", remedy=remedy)
        operation, changes = history.begin(root), Changes()
        for id in report.changed:
            tick_ns = int(_steps_of(store, entries[id])["log_time_ns"][0])
            removed[id] = removed_episode(entries[id], tick_ns=tick_ns, reason=reason, operation=operation.number)
        for id in report.changed:
            changes.removed.append(steps_name(id))
            changes.removed += [
                name for view in entries[id].n_frames if (root / (name := frames_name(view, id))).is_file()
            ]
        _stage_bytes(root, changes, removed_path(root).name, removed_bytes(removed))
        note = f"{counted(report.changed)} removed" + (f": {reason}" if reason else "")
        report.operation = operation.perform("remove", changes, note).number
        store.write_index()
        report.notes += _sides_left(store) + sets_broken_by(root, report.changed)
    return report


# --- trim ------------------------------------------------------------------------------------------------------------------


def plan_trim(
    root: Path, episodes: Sequence[str] = (), *, threshold: float = IDLE_SHARE, margin_s: float = MARGIN_S,
    steps: tuple[int | None, int | None] | None = None,
) -> list[Trim]:  # fmt: skip
    """What `trim_episodes` would leave of each of `episodes` (of all, where none is named). Nothing is written.

    Idle ends are found by `idle.moving_range` over low_dim and action, with `margin_s` seconds kept beside the motion; one that is
    shorter than `idle.IDLE_S` stays, as `check` does not mention it either. `steps` names
    the range to keep instead, as a slice of Python does: (10, None), (None, -5); it counts the steps that ingest gave the episode, so
    that doing it twice does nothing more. Raises UsageError as `trim_episodes`."""
    if not 0 < threshold < 1:
        remedy = "0.02 is two percent of the range that each column covers"
        raise UsageError("a threshold of motion lies between 0 and 1", found=threshold, remedy=remedy)
    if margin_s < 0:
        raise UsageError("a margin is no negative number of seconds", found=margin_s, remedy="0 keeps no rest at all")
    store = EpisodeStore(root)
    cuts = []
    for entry in _chosen(store, episodes):
        if steps is not None:
            cuts.append(_stated_trim(store, entry, steps))
        else:
            cuts.append(_idle_trim(store, entry, threshold, margin_s))
    return cuts


def trim_episodes(root: Path, cuts: Sequence[Trim]) -> SurgeryReport:
    """Do what `plan_trim` said. Frames files stay as they are, and so do latents; frames that no step sees any more are read by
    nobody: no model, statistic or export.

    Raises UsageError for an unknown id, for one that has other steps than when the plan was made, and where too little would be left."""
    with writer_lock(root):
        store, report = EpisodeStore(root), SurgeryReport()
        entries = {entry.id: entry for entry in store.index()}
        wanted = [cut for cut in cuts if cut.cuts]
        changes, gone = Changes(), 0
        for cut in wanted:
            entry = entries.get(cut.id)
            if entry is None or entry.n_steps != cut.n_steps:
                raise UsageError(
                    f"{cut.id!r} changed since the trim was planned", where=root, remedy="run the command again"
                )
            kept, arrays = trimmed(entry, _steps_of(store, entry), cut.first, cut.end)
            _stage_steps(root, changes, kept, arrays)
            report.changed.append(cut.id)
            gone += cut.n_steps - (cut.end - cut.first)
        if report.changed:
            note = f"{counted(report.changed)} trimmed by {gone} steps"
            report.operation = history.begin(root).perform("trim", changes, note).number
            store.write_index()
            report.notes += sets_broken_by(root, report.changed)
        else:
            store.ensure_index()
    return report


def parse_steps(text: str) -> tuple[int | None, int | None]:
    """`10:140`, `10:`, `:-5` -> (first, end), as in a slice of Python. Raises UsageError for anything else."""
    match = re.fullmatch(r"(-?\d+)?:(-?\d+)?", text)
    if match is None:
        remedy = "FIRST:END, such as 10:140, 10: or :-5; the end is left out"
        raise UsageError("no range of steps", found=repr(text), remedy=remedy)
    first, end = match.groups()
    return (int(first) if first else None, int(end) if end else None)


def _idle_trim(store: EpisodeStore, entry: EpisodeEntry, threshold: float, margin_s: float) -> Trim:
    steps = _steps_of(store, entry)
    columns = [steps["low_dim"], *([steps["action"]] if "action" in steps else [])]
    moving = moving_range(np.concatenate(columns, axis=1).astype(np.float64), steps["valid"], threshold=threshold)
    if moving is None:
        return _trim(entry, 0, entry.n_steps, moves=False)
    margin, pause = round(margin_s * entry.rate_hz), IDLE_S * entry.rate_hz
    first = max(moving[0] - margin, 0) if moving[0] > pause else 0
    end = min(moving[1] + margin, entry.n_steps) if entry.n_steps - moving[1] > pause else entry.n_steps
    if end - first < MIN_STEPS or not steps["valid"][first:end].any():
        first, end = 0, entry.n_steps
    return _trim(entry, first, end)


def _stated_trim(store: EpisodeStore, entry: EpisodeEntry, steps: tuple[int | None, int | None]) -> Trim:
    asked_first, asked_end, _ = slice(*steps).indices(entry.whole_steps)
    stated = ":".join("" if bound is None else str(bound) for bound in steps)
    if asked_first >= asked_end:
        remedy = "steps count from 0; the end is left out, and lies after the start"
        found = f"{stated} of an episode of {entry.whole_steps} steps"
        raise UsageError("no such range of steps", where=entry.id, found=found, remedy=remedy)
    first, end = max(asked_first - entry.first_step, 0), min(asked_end - entry.first_step, entry.n_steps)
    if first >= end:
        left = f"{entry.first_step} to {entry.first_step + entry.n_steps - 1}"
        remedy = "`vilp-data log` says by which operation; `vilp-data undo` brings them again"
        raise UsageError(
            "these steps were trimmed off before",
            where=entry.id,
            found=f"{stated}; steps {left} are left",
            remedy=remedy,
        )
    require_enough(entry, _steps_of(store, entry), first, end)
    past_end = steps[1] is not None and steps[1] > entry.whole_steps
    return replace(_trim(entry, first, end), past_end=past_end)


def _trim(entry: EpisodeEntry, first: int, end: int, *, moves: bool = True) -> Trim:
    return Trim(entry.id, first, end, entry.n_steps, entry.rate_hz, entry.first_step, moves=moves)


# --- relabel ---------------------------------------------------------------------------------------------------------------


def relabel_episodes(
    root: Path, episodes: Sequence[str], *, labels: Mapping[str, str] | None = None, unset: Iterable[str] = (), force: bool = False
) -> SurgeryReport:  # fmt: skip
    """Set and take away tags of `episodes`. The outcome follows the tag `success`. Labels are kept when the log is ingested again.

    Raises UsageError for an unknown id, a tag that is set and unset, the tag by which a policy's own episodes are known, and, unless
    with `force`, where the split could no longer be kept: it needs a tag that would be gone, or a group would be on both sides."""
    labels, unset = dict(labels or {}), tuple(dict.fromkeys(unset))
    _refuse_labels(labels, unset)
    with writer_lock(root):
        store, report, changes = EpisodeStore(root), SurgeryReport(), Changes()
        before, lock = {entry.id: entry for entry in store.index()}, find_split(root)
        after = dict(before)
        for entry in _chosen(store, episodes, all_by_default=False):
            after[entry.id] = relabelled(entry, labels=labels, unset=unset)
            if after[entry.id] != entry:
                report.changed.append(entry.id)
            missing = [tag for tag in unset if tag not in entry.tags]
            report.notes += [f"{entry.id}: has no tag {', '.join(map(repr, missing))}"] if missing else []
        if lock is not None and not force:
            _refuse_breaking_the_split(root, lock, before, after)
        for id in report.changed:
            _stage_steps(root, changes, after[id], _steps_of(store, before[id]))
        if report.changed:
            said = [f"{tag} = {value}" for tag, value in labels.items()] + [f"no {tag}" for tag in unset]
            note = f"{counted(report.changed)} relabelled: {', '.join(said)}"
            report.operation = history.begin(root).perform("relabel", changes, note).number
            report.notes += _about_labels(lock, labels, unset)
        store.ensure_index()
        report.notes += sets_broken_by(root, report.changed)
    return report


def _refuse_labels(labels: Mapping[str, str], unset: Sequence[str]) -> None:
    if not labels and not unset:
        raise UsageError("no label to set or to take away", remedy="--set KEY=VALUE, --outcome success, or --unset KEY")
    both = sorted({*labels}.intersection(unset))
    if both:
        raise UsageError("a label that is set and taken away", found=both[0], remedy="name it once")
    if not all(tag.strip() for tag in (*labels, *unset)):
        raise UsageError("a label without a name", remedy="--set KEY=VALUE, such as --set operator=anna")
    if labels.get(OUTCOME_TAG, "true") not in ("true", "false"):
        found = f"{OUTCOME_TAG} = {labels[OUTCOME_TAG]!r}"
        remedy = "true or false; `--unset success` where nobody can tell"
        raise UsageError("an episode succeeded or failed", found=found, remedy=remedy)
    name, value = ROLLOUT_TAG
    if name in unset or name in labels:
        raise UsageError(
            f"the tag {name!r} is not a label: it says whether a policy made the episode ({name} = {value})",
            remedy="take such an episode out with `vilp-data remove`; a policy's own are stored by `ingest --with-rollouts`",
        )


def _refuse_breaking_the_split(
    root: Path, lock: SplitLock, before: Mapping[str, EpisodeEntry], after: Mapping[str, EpisodeEntry]
) -> None:
    """UsageError where labels leave an episode without a tag that the split needs, or bring a group to both sides that was on one."""
    needed = [*lock.strata, *([lock.group_by] if lock.group_by else [])]
    broken = [
        f"{id} would have no {tag!r}"
        for tag in needed
        for id in after
        if tag in before[id].tags and tag not in after[id].tags
    ]
    known = leaks(lock, split_by(before.values(), lock))
    broken += [leak for leak in leaks(lock, split_by(after.values(), lock)) if leak not in known]
    if broken:
        raise UsageError(
            "these labels would break the split", where=root / "split.lock.json", found="; ".join(broken[:3]),
            remedy="relabel the whole group in one call; or --force, and then `vilp-data split --redraw`",
        )  # fmt: skip


def _about_labels(lock: SplitLock | None, labels: Mapping[str, str], unset: Sequence[str]) -> list[str]:
    notes = []
    drawn_by = {*(lock.strata if lock else ()), *([lock.group_by] if lock and lock.group_by else [])}.intersection(
        {*labels, *unset}
    )
    if drawn_by:
        tag = min(drawn_by)
        notes.append(
            f"the split was drawn by {tag!r}: nothing changes sides; `vilp-data split --check` says if it still fits"
        )
    if labels.get(OUTCOME_TAG) == "false":
        notes.append("failures that are stored stay where they are; `vilp-data remove` takes them out of training")
    return notes


# --- shared ------------------------------------------------------------------------------------------------------------------


def counted(ids: Sequence[str], limit: int = 3) -> str:
    """`2 episodes (a, b)`"""
    listed = ", ".join(ids[:limit]) + (", …" if len(ids) > limit else "")
    return f"{number_of(len(ids), 'episode')} ({listed})"


def _chosen(store: EpisodeStore, episodes: Sequence[str], *, all_by_default: bool = True) -> list[EpisodeEntry]:
    """The entries named, or all; in the order of ids. Raises UsageError naming the nearest id."""
    entries = {entry.id: entry for entry in store.index()}
    for id in episodes:
        if id not in entries:
            removed = read_removed(store.root)
            found = f"removed by operation {removed[id].operation}" if id in removed else None
            raise UsageError(f"no episode called {id!r}", where=store.root, found=found, remedy=nearest(id, entries))
    return [entries[id] for id in sorted(set(episodes))] if episodes or not all_by_default else list(entries.values())


def _steps_of(store: EpisodeStore, entry: EpisodeEntry) -> Steps:
    return dict(shards.read_shard(store.steps_path(entry.id)).arrays)


def _stage_steps(root: Path, changes: Changes, entry: EpisodeEntry, steps: Steps) -> None:
    name = steps_name(entry.id)
    changes.staged[name] = history.stage(root, name)
    write_steps(changes.staged[name], entry, steps)


def _stage_bytes(root: Path, changes: Changes, name: str, data: bytes) -> None:
    changes.staged[name] = history.stage(root, name)
    shards.write_atomic(changes.staged[name], data)


def _sides_left(store: EpisodeStore) -> list[str]:
    try:
        lock = find_split(store.root)
    except SplitError as error:  # damaged: a remove does not need it
        return [str(error)]
    if lock is None:
        return []
    there = {lock.assignment.get(entry.id) for entry in store.index()}
    return [
        f"the split has no {word} episode any more: add some, or `vilp-data split --redraw`"
        for side, word in (("train", "training"), ("val", "validation"))
        if side not in there
    ]
