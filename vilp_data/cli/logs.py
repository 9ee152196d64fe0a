"""Verbs about logs: record, inspect, ingest."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vilp_data.alike_findings import alike_findings
from vilp_data.cli.cuts import cuts_as_data, print_cuts
from vilp_data.cli.options import (
    JsonOption,
    PresetOption,
    TaskOption,
    WorkersOption,
    console,
    label_pairs,
    print_json,
    progress_bar,
)
from vilp_data.engine import cpu_count
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, number_of, some_of
from vilp_data.locate import a_dataset, default_root, find_dataset, has_been_dataset, is_dataset, remember
from vilp_data.log_files import find_logs, is_one_log
from vilp_data.sources.rosbag2_metadata import is_bag_folder
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task, task_names

if TYPE_CHECKING:
    from vilp_data.ingest import IngestReport

FULL_FAILURES = 3  # of the same kind, said in full


def record(
    task: TaskOption,
    preset: PresetOption = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the logs. Default: data/TASK/logs.", show_default=False)
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="How many. Default: the task's.", show_default=False)
    ] = None,
    first_seed: Annotated[
        int | None, typer.Option(min=0, help="Seeds count up from here. Default: the task's.", show_default=False)
    ] = None,
    variant: Annotated[
        str | None,
        typer.Option(
            help="One of the task's [record.variants] alone, such as off_target. Default: the task itself and, where neither "
            "--episodes nor --first-seed is given, all of its variants.",
            show_default=False,
        ),
    ] = None,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Let the scripted expert of a simulated task record episode logs, one MCAP each.

    Example: vilp-data record --task arrange_blocks --episodes 24
    """
    from vilp_data.sims.record import RecordedEpisode, record_task

    spec = load_task(task, preset=preset)
    folder = out or default_root(spec.name, preset) / "logs"
    everything = variant is None and episodes is None and first_seed is None
    recorded: list[RecordedEpisode] = []
    for one in [variant, *(spec.record.variants if everything else ())]:
        numbers = spec.record if one is None else spec.record.variants.get(one, spec.record)
        count = episodes or numbers.episodes
        with progress_bar(f"recording {spec.name}" + ("" if one is None else f", {one}"), count) as advance:
            recorded += record_task(
                spec,
                folder,
                episodes=count,
                first_seed=numbers.first_seed if first_seed is None else first_seed,
                variant=one,
                workers=workers or 0,
                progress=advance,
            )
    succeeded = sum(episode.success for episode in recorded)
    if as_json:
        print_json([dataclasses.asdict(episode) for episode in recorded])
    else:
        print(
            f"{folder}: {number_of(len(recorded), 'log')}, {succeeded} successful"
            + ("" if succeeded == len(recorded) else "; failures are tagged, and ingest leaves them out")
        )
        if earlier := sum(not episode.says_what_made_it for episode in recorded):
            print(
                f"  {earlier} kept, made before logs told the code that made them: whether it was today's, nobody knows"
            )


def inspect(
    log: Annotated[Path, typer.Argument(help="A log: a file or a folder, whatever its format.", show_default=False)],
    task: Annotated[
        str | None,
        typer.Option(help="Show the demonstrations that this task finds in the log as well.", show_default=False),
    ] = None,
    suggest_spec: Annotated[
        bool, typer.Option("--suggest-spec", help="Write a task TOML for this log, with its reasons as comments.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Where --suggest-spec writes. Default: stdout.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Say what is in a log: topics, types, rates, gaps, image sizes, clocks; or suggest a task that reads it.

    Example: vilp-data inspect episode.mcap --suggest-spec -o mytask.toml
    """
    from vilp_data.log_summary import format_summary, summarise

    log = _one_log(log)
    if suggest_spec:
        _write_suggestion(log, out)
        return
    if out is not None:
        raise UsageError("-o says where --suggest-spec writes", remedy="add --suggest-spec, or redirect the output")
    summary = summarise(log)
    if as_json:
        shown = cuts_as_data([log], load_task(task)) if task is not None else {}
        print_json(dataclasses.asdict(summary) | shown)
        return
    print(format_summary(summary))
    if task is not None:
        print()
        print_cuts([log], load_task(task), as_json=False)


def _one_log(path: Path) -> Path:
    """The log at a path, or the only one in a plain folder. UsageError where a folder holds others, with their names."""
    if not path.is_dir() or is_one_log(path) or is_bag_folder(path):
        return path
    if is_dataset(path):
        raise a_dataset(path)
    found = find_logs([path])
    if len(found.logs) == 1 and not found.passed_over:
        return found.logs[0]
    names = some_of([str(log.relative_to(path)) for log in found.logs], 8)
    if found.passed_over:
        names += f"; not read: {some_of([str(other.relative_to(path)) for other in found.passed_over], 8)}"
    raise UsageError(
        "a folder of logs, not one log",
        where=path,
        found=names,
        remedy=f"`vilp-data inspect {found.logs[0]}`, or `vilp-data check {path}` for all of them",
    )


def _write_suggestion(log: Path, out: Path | None) -> None:
    from vilp_data.suggest_spec import suggest_spec

    if out is not None and out.exists():
        raise UsageError("it exists already", where=out, remedy="name another file, or delete it")
    text = suggest_spec(log, name=None if out is None else out.stem)
    if out is None:
        print(text, end="")
        return
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError("cannot be written", where=out, found=error.strerror, remedy="check the folder") from error
    print(f"{out}: a task for {log}; read its comments, then `vilp-data ingest {log} --task {out}`")


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
    labels: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="KEY=VALUE, a tag of every episode in these logs; may be given several times.",
            show_default=False,
        ),
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Take episodes that were removed on purpose as well.")] = False,
    show: Annotated[
        bool, typer.Option("--preview", help="Print the demonstrations in the logs, and write nothing.")
    ] = False,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Decode, align, resize and store the demonstrations in logs. What is there already is left alone.

    Example: vilp-data ingest bags/ --task mytask.toml
    """
    from vilp_data.ingest import ingest_logs
    from vilp_data.ingest_tags import tag_episodes

    pairs = label_pairs(labels or [])
    if task:
        spec = load_task(task, preset=preset)
        root = into or default_root(spec.name, preset)
    else:
        root, spec = _dataset_and_its_spec(into)
        console.print(f"dataset: {root}, its task {spec.name}", highlight=False)
    if show:
        if not print_cuts(logs, spec, as_json=as_json):
            raise typer.Exit(1)
        return
    revives = has_been_dataset(root) and not is_dataset(root)
    with progress_bar(f"ingesting into {root}", None) as advance:
        report = ingest_logs(
            logs, root, spec, workers=workers or cpu_count(), include_failures=include_failures,
            with_rollouts=with_rollouts, again=again, progress=advance,
        )  # fmt: skip
    tagged = tag_episodes(root, [*report.written, *report.fresh], pairs)
    remember(root)
    if as_json:
        print_json(dataclasses.asdict(report) | {"tagged": tagged})
    else:
        _say_ingested(root, report, revives=revives, tagged=tagged)
        for line in _failures(report.failed):
            print(line, file=sys.stderr)
    if report.failed:
        raise typer.Exit(1)


def _say_ingested(root: Path, report: IngestReport, *, revives: bool, tagged: Sequence[str]) -> None:
    """What became of the demonstrations. `tagged` got labels of --set. `revives`: an undo had left the folder with no more
    than its history."""
    print(
        f"{root}: {number_of(len(report.written), 'episode')} ingested, {len(report.fresh)} already there"
        + (f", {number_of(len(report.left_out), 'failure')} left out" if report.left_out else "")
        + (f", {len(report.failed)} could not be read" if report.failed else "")
    )
    if tagged:
        print(f"  {len(tagged)} got the labels of --set")
    if report.rollouts:
        many = number_of(len(report.rollouts), "rollout")
        print(f"  {many} of a policy left out; --with-rollouts stores what no model will learn from")
    if report.removed:
        stay = "1 episode was" if len(report.removed) == 1 else f"{len(report.removed)} episodes were"
        listed = ", ".join(report.removed[:5]) + (", …" if len(report.removed) > 5 else "")
        print(f"  {stay} removed on purpose before, and left out: {listed}; --again takes them")
    if report.replaced:
        print(f"  replaced, since their log or their range changed: {', '.join(report.replaced)}")
    if report.restated:
        print(
            f"  told otherwise by their log or the task now, their labels and names brought up to date: {', '.join(report.restated)}"
        )
    if report.passed_over:
        print(f"  passed over, recordings left open and links that lead nowhere: {', '.join(report.passed_over)}")
    if revives:
        print(f"  an earlier ingest here was taken back; its history goes on: `vilp-data log {shlex.quote(str(root))}`")
    for note in report.notes:
        print(f"  {note}")
    said = [(episode, finding) for episode, findings in sorted(report.findings.items()) for finding in findings]
    for one in alike_findings(said):
        others = (
            f" (the like of {some_of(one.episodes[1:], FULL_FAILURES)}; --json has all)" if one.episodes[1:] else ""
        )
        print(f"  {one.episodes[0]}: {one.sentence}{others}")


def _failures(failed: list[tuple[str, str]]) -> list[str]:
    """Every failure in full; of more than FULL_FAILURES that end in the same words, the first ones, a few of the others' names and how
    many more: a dataset that was fetched in part lacks files by the hundred."""
    alike: dict[str, list[tuple[str, str]]] = {}
    for name, message in failed:
        alike.setdefault(message.partition("\n")[0].rpartition(": ")[2], []).append((name, message))
    lines = []
    for what, group in alike.items():
        lines += [f"  {_named(name, message)}" for name, message in group[:FULL_FAILURES]]
        if rest := [name for name, _ in group[FULL_FAILURES:]]:
            lines.append(f"  {len(rest)} more, {what}: {some_of(rest, FULL_FAILURES)} (--json has all)")
    return lines


def _named(name: str, message: str) -> str:
    """The message, under the name of what it is about unless it begins with that."""
    return message if Path(message.partition(": ")[0]).name == name else f"{name}: {message}"


def _dataset_and_its_spec(given: Path | None) -> tuple[Path, TaskSpec]:
    try:
        root = find_dataset(given)
    except UsageError as error:
        raise UsageError(
            "which task do these logs belong to?",
            remedy=f"--task NAME or --task FILE.toml (built-in: {', '.join(task_names())})",
        ) from error
    return root, EpisodeStore(root).spec()
