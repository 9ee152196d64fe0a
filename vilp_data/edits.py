"""What surgery changes of an episode: its labels, and which of its steps are left. Pure: entries and arrays in, the same out.

Nothing is re-encoded. A relabelled episode is the same arrays under other tags; a trimmed one keeps its frames file, and so its
latents, and says which of the stored frames are its own. `EpisodeEntry.edits` remembers what the log gave:

    ingest_content                 content hash of the whole episode
    log_tags, log_outcome          its tags and outcome before any label was set
    labels                         {"set": {tag: value}, "unset": [tag]}
    trim                           {"first_step", "end_step", "of_steps"} of the whole episode; {"start_ns", "end_ns"} its first and
                                   last tick, by which an ingest on another clock cuts it again
    first_frame, stored_frames     view -> the first stored frame that is still read, and how many the file holds
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data.episode_entry import EpisodeEntry
from vilp_data.errors import UsageError
from vilp_data.keys import content_digest, trimmed_key
from vilp_data.types import I32, OUTCOME_TAG, outcome_of

Arrays = Mapping[str, npt.NDArray[Any]]

MIN_STEPS = 2
"""An episode of one step holds no motion to learn."""

_SOURCE_INDEX = "source_index/"


@dataclass(frozen=True)
class Edits:
    """What people decided about an episode, apart from its content: it can be done again to another ingest of the same log.

    set, unset  labels;  start_ns, end_ns  the first and the last tick to keep, None where nothing was trimmed"""

    set: Mapping[str, str] = field(default_factory=dict)
    unset: tuple[str, ...] = ()
    start_ns: int | None = None
    end_ns: int | None = None

    @property
    def any(self) -> bool:
        return bool(self.set or self.unset) or self.start_ns is not None

    @property
    def calls_it_no_failure(self) -> bool:
        """Whether a label says that it did not fail, whatever the log says."""
        return self.set.get(OUTCOME_TAG, "false").lower() != "false"


def edits_of(remembered: Mapping[str, Any]) -> Edits:
    """The decisions that `EpisodeEntry.edits` remember."""
    labels, trim = remembered.get("labels", {}), remembered.get("trim", {})
    return Edits(labels.get("set", {}), tuple(labels.get("unset", ())), trim.get("start_ns"), trim.get("end_ns"))


def relabelled(entry: EpisodeEntry, *, labels: Mapping[str, str], unset: tuple[str, ...] = ()) -> EpisodeEntry:
    """The entry with tags set and taken away; the outcome follows the tag `success`. Labels that say what the log says are none."""
    before = edits_of(entry.edits)
    log_tags = entry.edits.get("log_tags", dict(entry.tags))
    log_outcome = entry.edits.get("log_outcome", entry.outcome)
    tags = {tag: value for tag, value in {**entry.tags, **labels}.items() if tag not in unset}
    touched = {*before.set, *before.unset, *labels, *unset}
    said = {
        "set": {tag: tags[tag] for tag in sorted(touched) if tag in tags and log_tags.get(tag) != tags[tag]},
        "unset": [tag for tag in sorted(touched) if tag in log_tags and tag not in tags],
    }
    edits = {name: value for name, value in entry.edits.items() if name not in ("labels", "log_tags", "log_outcome")}
    if said["set"] or said["unset"]:
        edits |= {"labels": said, "log_tags": log_tags, "log_outcome": log_outcome}
    judged = OUTCOME_TAG in said["set"] or OUTCOME_TAG in said["unset"]
    return replace(entry, tags=tags, outcome=outcome_of(tags) if judged else log_outcome, edits=edits)


def restated(entry: EpisodeEntry, tags: Mapping[str, str]) -> EpisodeEntry:
    """The entry with what its log says of it today, and the labels that people set on top."""
    labels = edits_of(entry.edits)
    edits = {name: value for name, value in entry.edits.items() if name not in ("labels", "log_tags", "log_outcome")}
    plain = replace(entry, tags=dict(tags), outcome=outcome_of(tags), edits=edits)
    return relabelled(plain, labels=labels.set, unset=labels.unset)


def trimmed(
    entry: EpisodeEntry, steps: Arrays, first: int, end: int
) -> tuple[EpisodeEntry, dict[str, npt.NDArray[Any]]]:
    """Entry and arrays of the steps `first` to `end` (one past the last) alone; `source_index` counts from the first frame kept.

    Raises UsageError where too little would be left."""
    require_enough(entry, steps, first, end)
    if (first, end) == (0, entry.n_steps):
        return entry, dict(steps)
    kept = {name: array[first:end] for name, array in steps.items()}
    first_frame, n_frames = {}, {}
    for view in entry.n_frames:
        index, begin, count = _rebased(kept[_SOURCE_INDEX + view], entry.n_frames[view])
        kept[_SOURCE_INDEX + view] = index
        first_frame[view], n_frames[view] = entry.first_frame(view) + begin, count
    skipped, whole = entry.first_step, entry.whole_steps
    ticks = kept["log_time_ns"]
    trim = {"first_step": skipped + first, "end_step": skipped + end, "of_steps": whole}
    trim |= {"start_ns": int(ticks[0]), "end_ns": int(ticks[-1])}
    edits = {
        **entry.edits, "trim": trim, "ingest_content": entry.ingest_content,
        "first_frame": first_frame, "stored_frames": {view: entry.stored_frames(view) for view in entry.n_frames},
    }  # fmt: skip
    changed = replace(
        entry, n_steps=end - first, n_valid=int(np.count_nonzero(kept["valid"])), n_frames=n_frames, edits=edits,
        key=trimmed_key(entry.key, skipped + first, skipped + end),
        findings=(*_of_the_whole(entry.findings), f"{_TRIMMED} {skipped + first} to {skipped + end - 1} of {whole}"),
    )  # fmt: skip
    return replace(changed, content_sha256=content_hash(changed, kept)), kept


def edited(entry: EpisodeEntry, steps: Arrays, edits: Edits) -> tuple[EpisodeEntry, dict[str, npt.NDArray[Any]]]:
    """Entry and arrays of a fresh ingest with earlier decisions carried over. Raises UsageError where a trim leaves too little."""
    kept = dict(steps)
    if edits.start_ns is not None and edits.end_ns is not None:
        ticks = steps["log_time_ns"]
        first, last = np.searchsorted(ticks, edits.start_ns, "left"), np.searchsorted(ticks, edits.end_ns, "right")
        entry, kept = trimmed(entry, kept, int(first), int(last))
    return (relabelled(entry, labels=edits.set, unset=edits.unset) if edits.set or edits.unset else entry), kept


def content_hash(entry: EpisodeEntry, steps: Arrays) -> str:
    """Equal for episodes that show the same: what is observed, which of it is valid, what was done."""
    arrays = [steps["low_dim"], steps["valid"], *(steps[_SOURCE_INDEX + view] for view in sorted(entry.frames_sha256))]
    arrays += [steps["action"]] if "action" in steps else []
    text = content_digest(*arrays) + "".join(entry.frames_id(view) for view in sorted(entry.frames_sha256))
    return content_digest(np.frombuffer(text.encode(), np.uint8))


_TRIMMED = "trimmed; what is said above is about the whole: kept steps"


def _of_the_whole(findings: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(finding for finding in findings if not finding.startswith(_TRIMMED))


def _rebased(source_index: I32, n_frames: int) -> tuple[I32, int, int]:
    """source_index counted from the first frame that it names; that frame, and how many from there on it spans."""
    named = source_index[source_index >= 0]
    if not named.size:
        return source_index, 0, n_frames
    first, last = int(named.min()), int(named.max())
    return np.where(source_index >= 0, source_index - first, source_index).astype(np.int32), first, last - first + 1


def require_enough(entry: EpisodeEntry, steps: Arrays, first: int, end: int) -> None:
    """Raise UsageError unless `first` to `end` are steps of the episode, enough of them to learn from."""
    if not 0 <= first < end <= entry.n_steps:
        found = f"steps {first} to {end} of an episode of {entry.n_steps}"
        raise UsageError(
            "no such range of steps", where=entry.id, found=found, remedy="steps count from 0; the end is left out"
        )
    if end - first < MIN_STEPS or not steps["valid"][first:end].any():
        found = f"{end - first} steps, {np.count_nonzero(steps['valid'][first:end])} of them valid"
        raise UsageError(
            "a trim would leave no motion to learn",
            where=entry.id,
            found=found,
            remedy="keep more, or remove the episode",
        )
