"""Verbs about what was done to a dataset: log, diff, undo, gc."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from vilp_data.cli.options import DatasetArgument, JsonOption, console, print_json
from vilp_data.dataset_state import DatasetState, read_state
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, number_of
from vilp_data.history import HistoryEntry
from vilp_data.locate import find_dataset, has_been_dataset, is_dataset, remember
from vilp_data.surgery.garbage import KEEP
from vilp_data.surgery.state_diff import StateDiff, compare_states

SHOWN = 12
"""Episodes listed one by one before the rest are counted."""


def _open(given: Path | None) -> Path:
    """The dataset whose history is meant: one that an undo emptied, too. StoreError where it is another version's."""
    root = find_dataset(given, emptied=True)
    if given is None:
        console.print(f"dataset: {root}", highlight=False)
    remember(root)
    if is_dataset(root):
        EpisodeStore(root).spec()
    return root


def log(dataset: DatasetArgument = None, as_json: JsonOption = False) -> None:
    """Say what was done to a dataset, when, by which command, with counts and content hashes before and after.

    Example: vilp-data log data/hanoi
    """
    from vilp_data.history import read_history

    root = _open(dataset)
    damaged: list[str] = []
    entries = read_history(root, damaged)
    if as_json:
        print_json([_without_files(entry) for entry in entries])
    else:
        _print_log(root, entries)
    for message in damaged:
        print(message, file=sys.stderr)
    if damaged:
        raise typer.Exit(1)


def _without_files(entry: HistoryEntry) -> dict[str, Any]:
    return {name: value for name, value in vars(entry).items() if name not in ("state", "touched")}


def _print_log(root: Path, entries: list[HistoryEntry]) -> None:
    undone = {entry.undoes: entry.number for entry in entries if entry.undoes is not None}
    if not entries:
        print(f"{root}: no history yet; it begins with the next command that changes something")
    for entry in entries:
        print(
            f"{entry.number:4d}  {entry.when}  {entry.what}: {entry.note}"
            + (" (interrupted)" if entry.interrupted else "")
        )
        many = number_of(entry.n_episodes, "episode")
        print(f"      {entry.before[:12]} -> {entry.after[:12]}, {many}, {entry.n_steps} steps")
        if entry.command:
            print(f"      $ {entry.command}")
        if entry.number in undone:
            print(f"      taken back by operation {undone[entry.number]}")


def diff(
    first: Annotated[
        str | None,
        typer.Argument(help="A dataset, or the number of an operation (its outcome). Default: before the last operation.",
                       show_default=False),
    ] = None,
    second: Annotated[
        str | None, typer.Argument(help="The same. Default: the dataset in use as it is now.", show_default=False)
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="The dataset whose operations are meant. Default: as for the other verbs.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Compare two states of a dataset, or two datasets: episodes, labels, content, sides of the split. Exit code 1 where they differ.

    Example: vilp-data diff 3 5
    """
    one, other = _state(first, data, "before the last operation"), _state(second, data, "now")
    difference = compare_states(one, other)
    if as_json:
        print_json(dataclasses.asdict(difference))
    else:
        for line in _in_words(difference, one, other):
            print(line)
    raise typer.Exit(0 if difference.same else 1)


def undo(
    dataset: DatasetArgument = None,
    operation: Annotated[
        int | None, typer.Option(help="Which one that must be: run twice, it is taken back once.", show_default=False)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Take back the last operation, exactly: every file is again what it was. Again takes back the one before.

    An undo is an operation too: with its number, --operation brings again what it took.

    Example: vilp-data undo data/hanoi
    """
    from vilp_data.surgery.undo import undo as take_back

    root = _open(dataset)
    entry = take_back(root, operation)
    if as_json:
        print_json(_without_files(entry))
    else:
        print(f"{root}: {entry.note}; {number_of(entry.n_episodes, 'episode')}, {entry.n_steps} steps")
        print(f"  `vilp-data undo {shlex.quote(str(root))} --operation {entry.number}` takes that back in turn")


def gc(
    dataset: DatasetArgument = None,
    keep: Annotated[int, typer.Option(help="How many operations stay undoable.")] = KEEP,
    run: Annotated[
        list[Path] | None,
        typer.Option(
            help="An encoder's run elsewhere, whose latents stay; may be given several times.", show_default=False
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Delete nothing; list what would go.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Delete what nothing refers to: files held for undo longer than kept, latents of unknown encoders or of episodes that are gone.

    Never touches logs/ or runs/.

    Example: vilp-data gc --dry-run
    """
    from vilp_data.surgery.garbage import collect_garbage, size_text

    root = _open(dataset)
    report = collect_garbage(root, keep=keep, runs=run or (), dry_run=dry_run)
    if as_json:
        print_json(dataclasses.asdict(report))
        return
    count, size = Counter(one.why for one in report.found), Counter[str]()
    for one in report.found:
        size[one.why] += one.size
    for why in sorted(count):
        print(f"  {number_of(count[why], 'file')}, {size_text(size[why])}: {why}")
    for note in report.notes:
        print(f"  {note}")
    done = "would be deleted" if dry_run else "deleted"
    print(
        f"{root}: {number_of(len(report.found), 'file')}, {size_text(report.size)}, {done}"
        if report.found
        else f"{root}: nothing to delete"
    )


def _state(given: str | None, data: Path | None, default: str) -> DatasetState:
    """The state that an argument of `diff` names."""
    from vilp_data.history import numbers, state_after
    from vilp_data.writer_lock import await_settled

    if given is not None and given.isdigit() and has_been_dataset(Path(given)):
        remedy = f"./{given} for the dataset, 0{given} for the operation"
        raise UsageError("both a dataset here and the number of an operation", where=given, remedy=remedy)
    if given is not None and not given.isdigit():
        if not has_been_dataset(Path(given)):
            remedy = "a dataset folder, or the number of an operation as `vilp-data log` lists them"
            raise UsageError("neither a dataset nor an operation", where=given, remedy=remedy)
        await_settled(Path(given))
        return read_state(Path(given))
    root = find_dataset(data, emptied=True)
    await_settled(root)
    if given is not None:
        return state_after(root, int(given))
    return read_state(root) if default == "now" else state_after(root, max([0, *numbers(root)[:-1]]))


def _in_words(difference: StateDiff, first: DatasetState, second: DatasetState) -> Iterator[str]:
    if difference.same:
        also = f"; {', '.join(difference.files)} differ" if difference.files else ""
        yield f"the same {len(first.episodes)} episodes, {first.n_steps} steps{also}"
        return
    yield f"{len(first.episodes)} episodes, {first.n_steps} steps -> {len(second.episodes)} episodes, {second.n_steps} steps"
    yield from _listed("- ", [f"{id} ({first.episodes[id].n_steps} steps)" for id in difference.only_first])
    yield from _listed("+ ", [f"{id} ({second.episodes[id].n_steps} steps)" for id in difference.only_second])
    yield from _listed("= ", [f"{one} is called {other}" for one, other in difference.renamed])
    yield from _listed("~ ", [f"{id}: {words}" for id, words in difference.content.items()])
    labels = [
        f"{id}: {name} {old if old is not None else '(none)'} -> {new if new is not None else '(none)'}"
        for id, changed in difference.labels.items()
        for name, (old, new) in changed.items()
    ]
    yield from _listed("~ ", labels)
    yield from _listed(
        "~ ", [f"{id}: side {old or '(none)'} -> {new or '(none)'}" for id, (old, new) in difference.sides.items()]
    )
    if difference.files:
        yield f"  also differ: {', '.join(difference.files)}"


def _listed(mark: str, lines: list[str]) -> Iterator[str]:
    yield from (f"  {mark}{line}" for line in lines[:SHOWN])
    if len(lines) > SHOWN:
        yield f"  {mark}and {len(lines) - SHOWN} more"
