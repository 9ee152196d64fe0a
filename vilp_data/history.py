"""What was done to a dataset: `history/NNNN.json`, one file an operation, never changed once written.

Every verb that changes a dataset writes one. It holds the command line, the time, what came of it in words, and the state after it
(`dataset_state`); the state before it is that of the file before. Changes that no verb made, by hand or by an older version, are
found when the next one begins, and recorded as `found`.

    ingest             records around work that goes on for hours: `recording`
    everything else    is one exchange of files, all or none: `begin(root).perform(…)`
"""

from __future__ import annotations

import contextlib
import datetime
import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vilp_data import journal, shards
from vilp_data.dataset_state import FILES, DatasetState, dumps, read_state
from vilp_data.errors import StoreError, UsageError
from vilp_data.writer_lock import await_settled

HISTORY_FORMAT = 1
FOUND = "found"
Touched = Mapping[str, tuple[str, str]]
"""Name of a file below the dataset -> its checksum before an operation and after it; "" where there is none."""

_PROGRAMS = ("vilp-data", "vilp-models")


@dataclass(frozen=True)
class HistoryEntry:
    """One operation.

    number       counts from 1
    what         the verb: "ingest", "split", "remove", "trim", "relabel", "merge", "undo", "gc", or "found"
    command      the command line; "" where no command line did it
    when         UTC, ISO 8601, to the second
    note         what came of it, in words
    before       digest of the state before; after, n_episodes, n_steps of the state after it
    undoes       of an undo: the operation it took back, which may be an undo itself
    interrupted  it was stopped before its end; what it had finished is what it did
    state        the state after; None where `gc` gave it up
    """

    number: int
    what: str
    command: str
    when: str
    note: str
    before: str
    after: str
    n_episodes: int
    n_steps: int
    undoes: int | None = None
    interrupted: bool = False
    state: DatasetState | None = None
    touched: Touched | None = None

    def to_json(self) -> bytes:
        table = {**self.__dict__, "format": HISTORY_FORMAT, "state": self.state and self.state.to_json()}
        return dumps(table)

    @classmethod
    def from_json(cls, data: bytes, *, where: object) -> HistoryEntry:
        """Raises StoreError where `data` is no entry, or of another format version."""
        try:
            table = json.loads(data)
            if (version := table.pop("format")) != HISTORY_FORMAT:
                raise ValueError(f"format {version!r}, this is {HISTORY_FORMAT}")
            state, touched = table.pop("state"), table.pop("touched", None)
            return cls(
                **table,
                state=None if state is None else DatasetState.from_json(state),
                touched=None if touched is None else {name: (was, made) for name, (was, made) in touched.items()},
            )
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            remedy = (
                "the dataset itself does not need it, nor does the undo of later operations; what came before it stays"
            )
            raise StoreError(
                "not an entry of a dataset's history", where=where, found=repr(error), remedy=remedy
            ) from error


def entry_path(root: Path, number: int) -> Path:
    return root / "history" / f"{number:04d}.json"


def numbers(root: Path) -> list[int]:
    """The operations there are, in order."""
    return sorted(int(path.stem) for path in (root / "history").glob("[0-9]*.json") if path.stem.isdigit())


def read_entry(root: Path, number: int) -> HistoryEntry:
    """Raises UsageError where there is no such operation, StoreError where its file is damaged."""
    path = entry_path(root, number)
    if not path.is_file():
        there = numbers(root)
        found = f"operations {there[0]} to {there[-1]}" if there else "no history yet"
        raise UsageError(f"no operation {number}", where=root, found=found, remedy="`vilp-data log` lists them")
    return HistoryEntry.from_json(path.read_bytes(), where=path)


def read_history(root: Path, damaged: list[str] | None = None) -> list[HistoryEntry]:
    """Every operation, oldest first. Entries that cannot be read go to `damaged`, in words; without it the first of them is raised, as
    StoreError."""
    await_settled(root)
    entries = []
    for number in numbers(root):
        try:
            entries.append(read_entry(root, number))
        except StoreError as error:
            if damaged is None:
                raise
            damaged.append(str(error))
    return entries


def read_back(root: Path) -> list[HistoryEntry]:
    """The operations since the last whose entry cannot be read, oldest first: what an undo can know of."""
    entries: list[HistoryEntry] = []
    with contextlib.suppress(StoreError):
        for number in reversed(numbers(root)):
            entries.append(read_entry(root, number))
    return entries[::-1]


def state_after(root: Path, number: int) -> DatasetState:
    """The state after an operation; 0 is the empty folder before the first. Raises as `read_entry`, and UsageError where the state was
    given up by `gc`."""
    if number == 0:
        return DatasetState()
    state = read_entry(root, number).state
    if state is None:
        remedy = "name a later one; `vilp-data gc --keep N` says how many are kept"
        raise UsageError(f"the state after operation {number} was given up", where=root, remedy=remedy)
    return state


# --- writing: inside writer_lock(root) ----------------------------------------------------------------------------------------


@dataclass
class Changes:
    """Files to exchange: `staged` gives each name below the dataset its new file, `removed` are names to take away."""

    staged: dict[str, Path] = field(default_factory=dict)
    removed: list[str] = field(default_factory=list)


def stage(root: Path, name: str) -> Path:
    """Where to write the file that is to become `name`."""
    return journal.staged_folder(root) / "new" / name


@dataclass(frozen=True)
class Operation:
    """The operation that begins now: its number, and the state it begins with."""

    root: Path
    number: int
    before: DatasetState

    def perform(self, what: str, changes: Changes, note: str, *, undoes: int | None = None) -> HistoryEntry:
        """Do `changes`, all or none, and record them under `what`; `note` says in words what they are. What they replace or take away
        is held. Where they touch episodes, or are an undo, the index goes with them: it is to be written last of all, and one that is
        missing says that the process was stopped before."""
        overlay: dict[str, Path | None] = {**changes.staged, **dict.fromkeys(changes.removed)}
        entry = _entry(self.number, what, note, self.before, read_state(self.root, overlay), undoes=undoes)
        held = journal.held_folder(self.root, self.number).relative_to(self.root)
        moves: list[journal.Move] = []
        for name in sorted(overlay):
            if name in changes.removed:
                moves.append((name, f"{held}/{name}"))
            elif (self.root / name).is_file():
                kept = journal.staged_folder(self.root) / "old" / name
                journal.keep_link(self.root / name, kept)
                moves.append((str(kept.relative_to(self.root)), f"{held}/{name}"))
        moves += [(str(path.relative_to(self.root)), name) for name, path in sorted(changes.staged.items())]
        recorded = journal.staged_folder(self.root) / "entry.json"
        shards.write_atomic(recorded, entry.to_json())
        moves.append(
            (str(recorded.relative_to(self.root)), str(entry_path(self.root, self.number).relative_to(self.root)))
        )
        drop_index = undoes is not None or any(name.startswith("episodes/") for name in overlay)
        journal.commit(self.root, moves, drop_index=drop_index)
        return entry

    def record(self, what: str, note: str) -> HistoryEntry:
        """Record an operation that changed no file of the state, as `gc`."""
        entry = _entry(self.number, what, note, self.before, self.before)
        shards.write_atomic(entry_path(self.root, self.number), entry.to_json())
        return entry


def begin(root: Path) -> Operation:
    """The operation that begins now. One that was killed, and changes that no verb made, are recorded before it."""
    _close(root, interrupted=True)
    (number, before), state = _last(root), read_state(root)
    if state.digest != before.digest:
        number += 1
        note = "changed by no verb since" if before.episodes or before.files else "as it was before its history began"
        entry = _entry(number, FOUND, note, before, state, command="")
        shards.write_atomic(entry_path(root, number), entry.to_json())
    return Operation(root, number + 1, state)


class Recording:
    """Work on a dataset that is recorded as one operation, once `begin` was called. `hold` is where to keep what it replaces."""

    def __init__(self, root: Path, what: str) -> None:
        self._root, self._what = root, what
        self.hold: Path | None = None

    def begin(self) -> None:
        """Before the first change. Goes on with a killed operation of the same command, whose changes it then records with its own;
        one of another command is an operation of its own, and was interrupted."""
        if self.hold is not None:
            return
        open_ = _read_open(self._root)
        this = {"what": self._what, "command": command_line()}
        if open_ is None or this.items() - open_.items() or entry_path(self._root, open_["number"]).is_file():
            open_ = {"number": begin(self._root).number, "when": _now(), **this}
            shards.write_atomic(_open_path(self._root), dumps(open_))
        self.hold = journal.held_folder(self._root, open_["number"])

    def keep(self, name: str) -> None:
        """Hold the file `name` below the dataset, which is about to be replaced."""
        if self.hold is not None and (self._root / name).is_file():
            journal.keep_link(self._root / name, self.hold / name)


@contextlib.contextmanager
def recording(root: Path, what: str) -> Iterator[Recording]:
    """Record what happens inside the block, if it changes anything; also where it ends early."""
    work = Recording(root, what)
    finished = False
    try:
        yield work
        finished = True
    finally:
        _close(root, interrupted=not finished)  # also where a killed one had done all there was to do


def command_line() -> str:
    """The command line of this process, where it is one of the project's; else ""."""
    program = Path(sys.argv[0]).name if sys.argv else ""
    return shlex.join([program, *sys.argv[1:]]) if program in _PROGRAMS else ""


def _open_path(root: Path) -> Path:
    return root / "history" / "open.json"


def _read_open(root: Path) -> dict[str, Any] | None:
    try:
        table: dict[str, Any] = json.loads(_open_path(root).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise StoreError("damaged", where=_open_path(root), found=str(error), remedy="delete it") from error
    return table


def _close(root: Path, *, interrupted: bool) -> None:
    """Record the operation that is open, if any, with what it changed."""
    open_ = _read_open(root)
    if open_ is None:
        return
    number, before, state = int(open_["number"]), _last(root)[1], read_state(root)
    if not entry_path(root, number).is_file() and state.digest != before.digest:
        entry = _entry(
            number, open_["what"], _counted(before, state), before, state, command=open_["command"], when=open_["when"],
            interrupted=interrupted,
        )  # fmt: skip
        shards.write_atomic(entry_path(root, number), entry.to_json())
    _open_path(root).unlink()


def _last(root: Path) -> tuple[int, DatasetState]:
    """Number of the last operation, 0 for none, and the state after it; of one that cannot be read, the empty state."""
    number = max(numbers(root), default=0)
    with contextlib.suppress(StoreError):
        return number, state_after(root, number)
    return number, DatasetState()


def _entry(
    number: int, what: str, note: str, before: DatasetState, after: DatasetState, *, undoes: int | None = None,
    command: str | None = None, when: str | None = None, interrupted: bool = False,
) -> HistoryEntry:  # fmt: skip
    return HistoryEntry(
        number, what, command_line() if command is None else command, when or _now(), note, before.digest, after.digest,
        len(after.episodes), after.n_steps, undoes, interrupted, after, touched(before, after),
    )  # fmt: skip


def touched(before: DatasetState, after: DatasetState) -> Touched:
    """The files in which two states differ."""
    one, other = before.checksums(), after.checksums()
    pairs = {name: (one.get(name, ""), other.get(name, "")) for name in sorted(one.keys() | other.keys())}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def _counted(before: DatasetState, after: DatasetState) -> str:
    new = after.episodes.keys() - before.episodes.keys()
    changed = {id for id in before.episodes.keys() & after.episodes.keys() if before.episodes[id] != after.episodes[id]}
    gone = before.episodes.keys() - after.episodes.keys()
    words = [f"{len(ids)} {word}" for ids, word in ((new, "new"), (changed, "changed"), (gone, "gone")) if ids]
    files = sorted(name for name in FILES if before.files.get(name) != after.files.get(name))
    return f"episodes: {', '.join(words)}" if words else f"{', '.join(files)} written"


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
