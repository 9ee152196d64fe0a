"""Verbs that change which episodes a dataset holds, and what they are called by: remove, trim, relabel, merge."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from vilp_data.cli.options import JsonOption, label_pairs, open_dataset, print_json
from vilp_data.errors import UsageError, number_of, some_of

EpisodesArgument = Annotated[list[str], typer.Argument(help="Ids of episodes.", show_default=False)]
DataOption = Annotated[
    Path | None, typer.Option("--data", help="Dataset folder. Default: as for the other verbs.", show_default=False)
]


def remove(
    episodes: EpisodesArgument,
    reason: Annotated[str, typer.Option(help="Why, for the history and for whoever ingests the log again.")] = "",
    data: DataOption = None,
    as_json: JsonOption = False,
) -> None:
    """Take episodes out of a dataset. Ingesting their log again does not bring them back; undo does, and ingest --again.

    Example: vilp-data remove run3 run7 --reason "the gripper was open"
    """
    from vilp_data.surgery.operations import remove_episodes

    root, _ = open_dataset(data)
    report = remove_episodes(root, episodes, reason=reason)
    if as_json:
        print_json(dataclasses.asdict(report))
        return
    _say(
        root,
        report.operation,
        f"{number_of(len(report.changed), 'episode')} removed" if report.changed else "nothing to remove",
    )
    _list(report.notes)


def trim(
    episodes: Annotated[
        list[str] | None, typer.Argument(help="Ids of episodes. Default: all of them.", show_default=False)
    ] = None,
    threshold: Annotated[
        float, typer.Option(help="Share of its range that a column must be away from rest for the robot to move.")
    ] = 0.02,
    margin: Annotated[float, typer.Option(help="Seconds of rest to keep at either end.")] = 0.5,
    steps: Annotated[
        str | None,
        typer.Option(
            help="Keep these steps instead, as ingest counted them: FIRST:END, a slice of Python (10:140, 10:, :-5).",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Change nothing; list what would go.")] = False,
    data: DataOption = None,
    as_json: JsonOption = False,
) -> None:
    """Cut off the idle ends of episodes: what comes before low_dim and action first move, and after they last did.

    Frames and latents stay as they are on disk; nothing reads those that were cut off.

    Example: vilp-data trim --dry-run
    """
    from vilp_data.surgery.operations import SurgeryReport, parse_steps, plan_trim, trim_episodes

    if steps is not None and not episodes:
        raise UsageError("which episodes have these steps?", remedy="name them: vilp-data trim EPISODE… --steps 10:140")
    root, _ = open_dataset(data)
    keep = None if steps is None else parse_steps(steps)
    cuts = plan_trim(root, episodes or (), threshold=threshold, margin_s=margin, steps=keep)
    report = SurgeryReport() if dry_run else trim_episodes(root, cuts)
    if as_json:
        table = {"operation": report.operation, "dry_run": dry_run, "notes": report.notes}
        print_json({**table, "cuts": [dataclasses.asdict(cut) for cut in cuts]})
        return
    cutting, n_steps = [cut for cut in cuts if cut.cuts], sum(cut.n_steps for cut in cuts)
    for cut in cutting:
        head, tail = cut.first, cut.n_steps - cut.end
        seconds = f"{head / cut.rate_hz:.1f} s at the start, {tail / cut.rate_hz:.1f} s at the end"
        kept = f"{cut.counted_from + cut.first} to {cut.counted_from + cut.end - 1}"
        print(f"  {cut.id}: keeps steps {kept}, {cut.end - cut.first} of {cut.n_steps}; {seconds} go")
    for cut in cuts:
        if cut.past_end:
            print(f"  {cut.id}: the range goes on past its last step; it keeps what there is")
        if not cut.moves:
            print(f"  {cut.id}: nothing in it moves; left as it is (`vilp-data remove` takes it out)")
    gone = sum(cut.n_steps - cut.end + cut.first for cut in cutting)
    done = "would go" if dry_run else "trimmed"
    _say(
        root,
        report.operation,
        f"{gone} of {n_steps} steps, of {number_of(len(cutting), 'episode')}, {done}" if cutting else "nothing to trim",
    )
    _list(report.notes)


def relabel(
    episodes: EpisodesArgument,
    labels: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE; may be given several times.", show_default=False)
    ] = None,
    outcome: Annotated[
        str | None,
        typer.Option(help="success or failure: the same as --set success=true or false.", show_default=False),
    ] = None,
    unset: Annotated[
        list[str] | None, typer.Option(help="A tag to take away; may be given several times.", show_default=False)
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Also where the split no longer fits them, and has to be drawn anew.")
    ] = False,
    data: DataOption = None,
    as_json: JsonOption = False,
) -> None:
    """Set or take away tags of episodes. Labels stay when the log is ingested again.

    Example: vilp-data relabel run3 --set operator=anna --outcome failure
    """
    from vilp_data.surgery.operations import relabel_episodes

    root, _ = open_dataset(data)
    report = relabel_episodes(root, episodes, labels=_pairs(labels or [], outcome), unset=unset or (), force=force)
    if as_json:
        print_json(dataclasses.asdict(report))
        return
    _say(
        root,
        report.operation,
        f"{number_of(len(report.changed), 'episode')} relabelled" if report.changed else "they say so already",
    )
    _list(report.notes)


def merge(
    other: Annotated[
        Path, typer.Argument(help="The dataset to take episodes from; it stays as it is.", show_default=False)
    ],
    into: Annotated[
        Path | None,
        typer.Argument(help="The dataset to take them into. Default: as for the other verbs.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Take the episodes of another dataset of the same spec into this one, with their latents where the encoder is the same.

    Example: vilp-data merge data/monday data/tuesday
    """
    from vilp_data.surgery.merge import merge_datasets

    root, _ = open_dataset(into)
    report = merge_datasets(other, root)
    if as_json:
        print_json(dataclasses.asdict(report))
        return
    latents = f", with {number_of(report.latents, 'latent file')}" if report.latents else ""
    _say(root, report.operation, f"{number_of(len(report.added), 'episode')} taken from {other}{latents}")
    if report.here:
        print(f"  here already, by log or content: {number_of(len(report.here), 'episode')}")
    if report.removed:
        print(f"  removed here before, and left out: {some_of(report.removed, 5)}")
    for there, here in sorted(report.renamed.items()):
        print(f"  {there} is called {here} here, where another has that name")
    _list(report.notes)
    if report.added and (root / "split.lock.json").is_file():
        print(f"  what is new has no side of the split yet: `vilp-data split {root}` gives it one and moves no other")


def _pairs(labels: list[str], outcome: str | None) -> dict[str, str]:
    pairs = label_pairs(labels)
    if outcome is not None:
        if outcome not in ("success", "failure"):
            raise UsageError("no such outcome", found=outcome, remedy="--outcome success or --outcome failure")
        said = "true" if outcome == "success" else "false"
        if pairs.get("success", said) != said:
            raise UsageError(
                "two outcomes", found=f"--outcome {outcome} and --set success={pairs['success']}", remedy="say it once"
            )
        pairs["success"] = said
    return pairs


def _say(root: Path, operation: int | None, what: str) -> None:
    print(f"{root}: {what}" + (f" (operation {operation}; `vilp-data undo` takes it back)" if operation else ""))


def _list(notes: list[str]) -> None:
    for note in notes:
        print(f"  {note}")
