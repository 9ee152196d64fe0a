"""Another dataset's episodes taken into this one: files linked (or copied, across disks), nothing decoded or encoded.

Both must be of the same ingest spec, or their columns and pixels would mean different things. An episode that is here already, by its
log or by its content, stays as it is here; names that clash get a suffix as ingest gives them; sides of the split are this dataset's
business, so what is new gets one from the next `split`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from vilp_data import history, journal, shards
from vilp_data.dataset_state import frames_name, steps_name
from vilp_data.episode_entry import free_id
from vilp_data.episodes import EpisodeEntry, EpisodeStore, write_steps
from vilp_data.errors import StoreError, UsageError, number_of
from vilp_data.history import Changes
from vilp_data.keys import first_difference
from vilp_data.latents import latents_path
from vilp_data.removed import read_removed
from vilp_data.types import RATE_TOLERANCE
from vilp_data.vector_parts import names_that_differ
from vilp_data.writer_lock import writer_lock


@dataclass
class MergeReport:
    """What a merge did. `operation` is None where there was nothing to take.

    added    ids, as they are called here;  renamed  their name there -> here, where it is another
    here     ids (of here) of what was here already;  removed  ids of what was removed here on purpose, and stays out
    latents  how many latent shards came along;  notes  sentences about episodes of which the two datasets say different things
    """

    operation: int | None = None
    added: list[str] = field(default_factory=list)
    renamed: dict[str, str] = field(default_factory=dict)
    here: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    latents: int = 0
    notes: list[str] = field(default_factory=list)


def merge_datasets(other: Path, into: Path) -> MergeReport:
    """Take the episodes of the dataset `other` into the dataset `into`; `other` stays as it is.

    Latents come along where `into` has latents of the same encoder. Raises UsageError where the two are one, or differ in the ingest
    spec or the rate; StoreError where a file of `other` is damaged, before anything is taken; BusyError where one is being written."""
    if other.resolve() == into.resolve():
        raise UsageError("a dataset cannot be merged into itself", where=into, remedy="name two datasets")
    there, here = EpisodeStore(other), EpisodeStore(into)
    with writer_lock(into), _held_still(other):
        theirs, ours = there.index(), here.index()
        _refuse_what_does_not_fit(there, here, theirs, ours)
        report = MergeReport()
        wanted = _what_is_new(here, theirs, ours, report)
        report.notes += names_that_differ(entry.column_names for entry in (*ours, *wanted.values()))
        changes = Changes()
        for id, entry in wanted.items():
            _stage_episode(there, into, id, entry, changes)
        report.latents = sum(_take_latents(other, into, entry, id) for id, entry in wanted.items())
        if wanted:
            report.added = sorted(wanted)
            note = f"{number_of(len(wanted), 'episode')} taken from {other}"
            report.operation = history.begin(into).perform("merge", changes, note).number
        here.ensure_index()
    return report


def _what_is_new(
    here: EpisodeStore, theirs: Sequence[EpisodeEntry], ours: Sequence[EpisodeEntry], report: MergeReport
) -> dict[str, EpisodeEntry]:
    """Our id -> their entry, for what is not here; the rest goes into the report."""
    removed = read_removed(here.root)
    known = {name: entry for entry in ours for name in (entry.ingest_key, entry.ingest_content)}
    gone = {name: id for id, episode in removed.items() for name in (episode.ingest_key, episode.ingest_content)}
    taken, wanted = {*removed, *(entry.id for entry in ours)}, {}
    for entry in theirs:
        same = known.get(entry.ingest_key) or known.get(entry.ingest_content)
        if same is not None:
            report.here.append(same.id)
            report.notes += _told_apart(entry, same)
        elif entry.ingest_key in gone or entry.ingest_content in gone:
            report.removed.append(gone.get(entry.ingest_key) or gone[entry.ingest_content])
        else:
            id = free_id(entry.id, taken, entry.source_sha256, entry.content_sha256)
            taken.add(id)
            wanted[id] = entry
            known |= {entry.ingest_key: replace(entry, id=id), entry.ingest_content: replace(entry, id=id)}
            report.renamed |= {entry.id: id} if id != entry.id else {}
    return wanted


def _told_apart(theirs: EpisodeEntry, ours: EpisodeEntry) -> Iterator[str]:
    """What the other dataset says of the same episode, and this one does not."""
    words = ["trimmed to other steps"] * (theirs.key != ours.key and theirs.ingest_key == ours.ingest_key)
    words += ["labelled otherwise"] * ((theirs.tags, theirs.outcome) != (ours.tags, ours.outcome))
    words += ["its numbers named otherwise"] * any(names_that_differ([theirs.column_names, ours.column_names]))
    if words:
        yield f"{ours.id}: {' and '.join(words)} there; it stays as it is here"


# --- files -------------------------------------------------------------------------------------------------------------------


def _stage_episode(there: EpisodeStore, into: Path, id: str, entry: EpisodeEntry, changes: Changes) -> None:
    """The steps file, which says what the episode is called, anew where that is another; frames files by a second name."""
    steps = there.steps_path(entry.id)
    shard = shards.read_shard(steps)
    if not there.frames_fit(entry):
        remedy = "ingest its log again there, or remove it there"
        raise StoreError(
            "its frames are missing or damaged; nothing was taken", where=f"{there.root}, {entry.id}", remedy=remedy
        )
    changes.staged[steps_name(id)] = target = history.stage(into, steps_name(id))
    if id == entry.id:
        journal.keep_link(steps, target)
    else:
        write_steps(target, replace(entry, id=id), shard.arrays)
    for view in entry.n_frames:
        name = frames_name(view, id)
        changes.staged[name] = history.stage(into, name)
        shards.verify_shard(there.frames_path(view, entry.id))  # a link would share the damage
        journal.keep_link(there.frames_path(view, entry.id), changes.staged[name])


def _take_latents(other: Path, into: Path, entry: EpisodeEntry, id: str) -> int:
    """Latents of encoders that this dataset has latents of. They come before the episode does: latents of nobody hurt nobody."""
    taken = 0
    for view in entry.n_frames:
        for folder in sorted((into / "latents" / view).glob("[!.]*/")):
            source, target = latents_path(other, view, folder.name, entry.id), latents_path(into, view, folder.name, id)
            with contextlib.suppress(StoreError):  # damaged there: made again here
                if source.is_file() and _frames_of(source) == entry.frames_sha256[view]:
                    shards.verify_shard(source)
                    if target.is_file() and _frames_of(target) != entry.frames_sha256[view]:
                        target.unlink()  # left by an episode of that name that is gone
                    journal.keep_link(source, target)
                    taken += 1
    return taken


def _frames_of(path: Path) -> str | None:
    return shards.read_header(path).metadata.get("source_frames_sha256")


@contextlib.contextmanager
def _held_still(other: Path) -> Iterator[None]:
    """Keep other writers from the dataset that is read, where its folder can be written at all."""
    EpisodeStore(other).spec()  # first of all: a folder that is no dataset must not get a lock file
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(StoreError):
            stack.enter_context(writer_lock(other))
        yield


# --- what does not fit ----------------------------------------------------------------------------------------------------------


def _refuse_what_does_not_fit(
    there: EpisodeStore, here: EpisodeStore, theirs: Sequence[EpisodeEntry], ours: Sequence[EpisodeEntry]
) -> None:
    specs = [("its task", here.spec().ingest_fields(), there.spec().ingest_fields())]
    specs += [(entry.id, dict(ours[0].ingest), dict(entry.ingest)) for entry in theirs if ours]
    for name, fields, ingest in specs:
        difference = first_difference(fields, ingest)
        if difference is not None:
            raise UsageError(
                "the two datasets were ingested by different specs",
                where=there.root,
                found=f"{difference} (here -> there, {name})",
                remedy=f"ingest its logs with the task of {here.root}: `vilp-data ingest LOGS… --into {here.root}`",
            )
    rates = [entry.rate_hz for entry in ours[:1]]
    for entry in theirs:
        if rates and abs(entry.rate_hz / rates[0] - 1) > RATE_TOLERANCE:
            raise UsageError(
                "the two datasets run at different rates",
                where=f"{there.root}, {entry.id}",
                found=f"{entry.rate_hz:.4g} steps a second there, {rates[0]:.4g} here",
                remedy="state rate_hz in the task TOML and ingest the logs of both anew",
            )
