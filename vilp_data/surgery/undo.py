"""The last operation taken back: every file as it was, byte for byte, by renames."""

from __future__ import annotations

from pathlib import Path

from vilp_data import shards
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.surgery import history, journal
from vilp_data.surgery.dataset_state import DatasetState, file_checksum
from vilp_data.surgery.history import FOUND, Changes, HistoryEntry

NOT_UNDONE = ("undo", "gc")
"""Operations that leave nothing to take back: an undo is itself a step back, gc touched nothing but what was given up."""


def undo(root: Path, number: int | None = None) -> HistoryEntry:
    """Take back the last operation that was not taken back yet; the entry that records it. Files that it made wait in history/held/.

    `number` says which one that must be, so that a command that is run twice does nothing the second time: the undo of an operation
    that was taken back already is returned. Raises UsageError where there is none, it is another one, the dataset was changed by hand
    since, or `gc` gave up what it replaced."""
    killed = journal.is_pending(root)
    with shards.writer_lock(root):
        prepared = history.prepare(root)
        entries = [history.read_entry(root, n) for n in history.numbers(root)]
        already = next((entry for entry in entries if entry.undoes is not None and entry.undoes == number), None)
        if killed and entries[-1].undoes is not None and number is None:
            already = entries[-1]  # the undo that was killed is finished: one more would take back too much
        if number is not None:
            history.read_entry(root, number)  # says that there is none
        store = EpisodeStore(root)
        done = already or _take_back(root, _last_standing(root, entries, number), prepared)
        if not store.index_path.is_file():
            store.write_index()
    return done


def _last_standing(root: Path, entries: list[HistoryEntry], number: int | None) -> HistoryEntry:
    standing: list[HistoryEntry] = []
    for entry in entries:
        if entry.undoes is not None:
            standing = [one for one in standing if one.number != entry.undoes]
        elif entry.what not in NOT_UNDONE:
            standing.append(entry)
    last = standing[-1] if standing else None
    if last is None or last.what == FOUND:
        found = None if last is None else f"operation {last.number}: {last.note}"
        raise UsageError(
            "there is no operation to take back", where=root, found=found, remedy="`vilp-data log` lists them"
        )
    if number is not None and last.number != number:
        remedy = f"take that one back first: `vilp-data undo {root} --operation {last.number}`"
        raise UsageError(
            f"operation {number} is not the last one",
            where=root,
            found=f"operation {last.number}, {last.what}",
            remedy=remedy,
        )
    return last


def _take_back(root: Path, entry: HistoryEntry, prepared: tuple[int, DatasetState]) -> HistoryEntry:
    before, now = history.state_after(root, entry.number - 1).checksums(), prepared[1].checksums()
    changes = Changes(staged={}, removed=sorted(now.keys() - before.keys()))
    changes.removed = [name for name in changes.removed if (root / name).is_file()]
    held = journal.held_folder(root, entry.number)
    gone = []
    for name, checksum in sorted(before.items()):
        if now.get(name) != checksum:
            changes.staged[name] = held / name
            if file_checksum(held / name) != checksum:
                gone.append(name)
    if gone:
        found = f"{len(gone)} files gone from {held}, such as {gone[0]}"
        remedy = "ingest the logs again (`--again` for episodes that were removed)"
        raise UsageError(
            f"operation {entry.number} can no longer be taken back", where=root, found=found, remedy=remedy
        )
    note = f"operation {entry.number} ({entry.what}) taken back"
    return history.perform(root, "undo", changes, note, undoes=entry.number, prepared=prepared)
