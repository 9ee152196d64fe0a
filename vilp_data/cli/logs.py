"""Verbs about logs: record, inspect, ingest."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import typer

from vilp_data.cli.options import JsonOption, PresetOption, TaskOption, WorkersOption, console, print_json, progress_bar
from vilp_data.engine import cpu_count
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.locate import default_root, find_dataset, remember
from vilp_data.spec import TaskSpec, load_task


def record(
    task: TaskOption,
    preset: PresetOption = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the logs. Default: data/TASK/logs.", show_default=False)
    ] = None,
    episodes: Annotated[int | None, typer.Option(help="How many. Default: the task's.", show_default=False)] = None,
    first_seed: Annotated[
        int | None, typer.Option(help="Seeds count up from here. Default: the task's.", show_default=False)
    ] = None,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Let the scripted expert of a simulated task record episode logs, one MCAP each.

    Example: vilp-data record --task hanoi --episodes 24
    """
    from vilp_data.sims.record import record_task

    spec = load_task(task, preset=preset)
    folder = out or default_root(spec.name, preset) / "logs"
    count = episodes or spec.record.episodes
    with progress_bar(f"recording {spec.name}", count) as advance:
        recorded = record_task(
            spec,
            folder,
            episodes=count,
            first_seed=spec.record.first_seed if first_seed is None else first_seed,
            workers=workers or 0,
            progress=advance,
        )
    succeeded = sum(episode.success for episode in recorded)
    if as_json:
        print_json([dataclasses.asdict(episode) for episode in recorded])
    else:
        print(
            f"{folder}: {len(recorded)} logs, {succeeded} successful"
            + ("" if succeeded == len(recorded) else "; failures are tagged, and ingest leaves them out")
        )


def inspect(
    log: Annotated[Path, typer.Argument(help="An MCAP file or a zarr folder.", show_default=False)],
    as_json: JsonOption = False,
) -> None:
    """Say what is in a log: topics, types, rates, gaps, image sizes, clocks.

    Example: vilp-data inspect episode.mcap
    """
    from vilp_data.log_summary import format_summary, summarise

    summary = summarise(log)
    if as_json:
        print_json(dataclasses.asdict(summary))
    else:
        print(format_summary(summary))


def ingest(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or folders of logs.", show_default=False)],
    task: Annotated[
        str,
        typer.Option(help="A built-in task, or a path to a task TOML. Default: that of the dataset last used here."),
    ] = "",
    preset: PresetOption = None,
    into: Annotated[Path | None, typer.Option(help="Dataset folder. Default: data/TASK.", show_default=False)] = None,
    include_failures: Annotated[bool, typer.Option(help="Take episodes tagged as failures too.")] = False,
    with_rollouts: Annotated[
        bool,
        typer.Option("--with-rollouts", help="Store a policy's own episodes too: they never get a side of the split."),
    ] = False,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Decode, align, resize and store the demonstrations in logs. What is there already is left alone.

    Example: vilp-data ingest bags/ --task mytask.toml
    """
    from vilp_data.ingest import ingest_logs

    if task:
        spec = load_task(task, preset=preset)
        root = into or default_root(spec.name, preset)
    else:
        root, spec = _dataset_and_its_spec(into)
        console.print(f"dataset: {root}, its task {spec.name}", highlight=False)
    with progress_bar(f"ingesting into {root}", None) as advance:
        report = ingest_logs(
            logs, root, spec, workers=workers or cpu_count(), include_failures=include_failures,
            with_rollouts=with_rollouts, progress=advance,
        )  # fmt: skip
    remember(root)
    if as_json:
        print_json(dataclasses.asdict(report))
    else:
        print(
            f"{root}: {len(report.written)} episodes ingested, {len(report.fresh)} already there"
            + (f", {len(report.left_out)} failures left out" if report.left_out else "")
            + (f", {len(report.failed)} could not be read" if report.failed else "")
        )
        if report.rollouts:
            many = "1 rollout" if len(report.rollouts) == 1 else f"{len(report.rollouts)} rollouts"
            print(f"  {many} of a policy left out; --with-rollouts stores what no model will learn from")
        if report.replaced:
            print(f"  replaced, since their log changed: {', '.join(report.replaced)}")
        if report.passed_over:
            print(f"  passed over, of formats that are not read yet: {', '.join(report.passed_over)}")
        for note in report.notes:
            print(f"  {note}")
        for episode, findings in sorted(report.findings.items()):
            for finding in findings:
                print(f"  {episode}: {finding}")
        for name, message in report.failed:
            print(f"  {name}: {message}", file=sys.stderr)
    if report.failed:
        raise typer.Exit(1)


def _dataset_and_its_spec(given: Path | None) -> tuple[Path, TaskSpec]:
    try:
        root = find_dataset(given)
    except UsageError as error:
        raise UsageError(
            "which task do these logs belong to?", remedy="--task NAME or --task FILE.toml (built-in: hanoi, pusht)"
        ) from error
    return root, EpisodeStore(root).spec()
