"""An operation taken back: every file that it changed as it was before, byte for byte, by renames. An undo is an operation too: taken back
itself, it brings again what it took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vilp_data import history, journal
from vilp_data.dataset_state import file_checksum
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import StoreError, UsageError, some_of
from vilp_data.history import FOUND, Changes, HistoryEntry, Operation, Touched
from vilp_data.writer_lock import writer_lock

NOT_UNDONE = (FOUND, "gc")
"""Operations that leave nothing to take back: what no verb did cannot be known, gc touched nothing but what was given up."""


@dataclass
class Ledger:
    """Which operations stand and which were taken back. An operation is known by its first entry, however often it was taken back and
    brought again since.

    done    operation -> the entry by which it stands, in order;  taken  operation -> the entry that took it back last
    again   operations that can be brought again, the last of them first: nothing else was done since"""

    entries: dict[int, HistoryEntry]
    done: dict[int, int] = field(default_factory=dict)
    taken: dict[int, int] = field(default_factory=dict)
    again: list[int] = field(default_factory=list)

    def operation(self, number: int) -> tuple[int, bool]:
        """The operation that an entry is about, and whether it stood after that entry."""
        stood = True
        while (entry := self.entries.get(number)) is not None and entry.undoes is not None:
            number, stood = entry.undoes, not stood
        return number, stood


def read_ledger(entries: Sequence[HistoryEntry]) -> Ledger:
    """Pure: `entries` in order."""
    ledger = Ledger({entry.number: entry for entry in entries})
    for entry in entries:
        operation, stood = ledger.operation(entry.number)
        if entry.what in NOT_UNDONE:
            continue
        if stood:
            ledger.done[operation] = entry.number
            ledger.again = ledger.again[:-1] if entry.undoes is not None else []
        else:
            ledger.done.pop(operation, None)
            ledger.taken[operation] = entry.number
            ledger.again.append(operation)
    return ledger


def undo(root: Path, number: int | None = None) -> HistoryEntry:
    """Take back the last operation that stands; the entry that records it. Files that it made wait in history/held/.

    `number` says which one that must be, so that a command that is run twice does nothing the second time: the undo of an operation
    that was taken back already is returned. The number of an undo brings again what it took, where nothing else was done since. An undo
    that was stopped before its end is finished by the next one, which takes back no more.

    Raises UsageError where there is none, it is another one, a file that it changed was changed by hand since, or `gc` gave up what it
    replaced; StoreError where the entry asked for is damaged."""
    with writer_lock(root):
        operation = history.begin(root)
        if number is not None:
            history.read_entry(root, number)  # says that there is none, or that it is damaged
        ledger = read_ledger(history.read_back(root))
        stopped = EpisodeStore(root).ensure_index()
        last = ledger.entries.get(operation.number - 1)
        if number is None and stopped and last is not None and last.undoes is not None:
            return last
        entry, done = _chosen(root, ledger, number)
        if not done:
            entry = _reverse(operation, ledger, entry)
            EpisodeStore(root).ensure_index()
    return entry


def _chosen(root: Path, ledger: Ledger, number: int | None) -> tuple[HistoryEntry, bool]:
    """The entry to take back; or, with True, the one by which that is done already."""
    last = next(reversed(ledger.done), None)
    if number is None:
        if last is None:
            remedy = "`vilp-data log` lists them; `--operation N` of an undo brings again what it took"
            raise UsageError("there is no operation to take back", where=root, remedy=remedy)
        return ledger.entries[ledger.done[last]], False
    operation, stood = ledger.operation(number)
    if number not in ledger.entries or ledger.entries[number].what in NOT_UNDONE:
        what = "an entry after it is damaged" if number not in ledger.entries else ledger.entries[number].note
        raise UsageError(f"operation {number} cannot be taken back", where=root, found=what, remedy="`vilp-data log`")
    if stood != (operation in ledger.done):
        return ledger.entries[(ledger.taken if stood else ledger.done)[operation]], True
    first = None  # to be taken back before this one
    if stood and operation != last:
        what, first = f"operation {number} is not the last one", last
    elif not stood and operation not in ledger.again[-1:]:
        what, first = (
            f"something was done since operation {number}",
            ledger.taken[ledger.again[-1]] if ledger.again else last,
        )
    if first is not None:
        entry = ledger.entries.get(first)
        remedy = f"take that one back first: `vilp-data undo {root} --operation {first}`"
        found = f"operation {first}" + (f", {entry.what}" if entry is not None else "")
        raise UsageError(what, where=root, found=found, remedy=remedy)
    return ledger.entries[(ledger.done if stood else ledger.taken)[operation]], False


def _reverse(operation: Operation, ledger: Ledger, entry: HistoryEntry) -> HistoryEntry:
    root, now = operation.root, operation.before.checksums()
    held, changes = journal.held_folder(root, entry.number), Changes()
    changed, gone = [], []
    for name, (was, made) in _touched(root, entry).items():
        here = now.get(name, "")
        if here == was:
            continue  # put back by hand
        if here != made:
            changed.append(name)
        elif not was:
            changes.removed.append(name)
        elif file_checksum(held / name) == was:
            changes.staged[name] = held / name
        else:
            gone.append(name)
    if changed:
        raise UsageError(
            f"operation {entry.number} cannot be taken back: files that it wrote were changed by hand since", where=root,
            found=some_of(changed, 3), remedy="put them back as they were, or ingest the logs of these episodes again",
        )  # fmt: skip
    if gone:
        raise UsageError(
            f"operation {entry.number} can no longer be taken back", where=root, found=f"gone from {held}: {some_of(gone, 3)}",
            remedy="ingest the logs again (`--again` for episodes that were removed)",
        )  # fmt: skip
    number, stood = ledger.operation(entry.number)
    what = ledger.entries[number].what if number in ledger.entries else "an earlier one"
    note = f"operation {number} ({what}) {'taken back' if stood else 'brought again'}"
    return operation.perform("undo", changes, note, undoes=entry.number)


def _touched(root: Path, entry: HistoryEntry) -> Touched:
    if entry.touched is not None:
        return entry.touched
    try:  # an entry of an older version
        return history.touched(history.state_after(root, entry.number - 1), history.state_after(root, entry.number))
    except StoreError as error:
        found = f"operation {entry.number - 1} cannot be read"
        raise UsageError(
            f"operation {entry.number} cannot be taken back",
            where=root,
            found=found,
            remedy="`vilp-data log` lists them",
        ) from error
