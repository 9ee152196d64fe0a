"""`vilp-data`: one verb for each thing it makes. Thin: it parses, calls, prints."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vilp_data.engine import cpu_count
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, VilpDataError
from vilp_data.latents import FrameEncoder, load_encoder
from vilp_data.locate import default_root, find_dataset, remember
from vilp_data.spec import PRESETS, TaskSpec, load_task

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Episode logs in, latent shards out.",
)
console = Console(stderr=True)
INTERRUPTED = 130

DatasetArgument = Annotated[
    Path | None,
    typer.Argument(
        help="Dataset folder. Default: the one you are in, else the last one used here, else the only one under data/.",
        show_default=False,
    ),
]
TaskOption = Annotated[str, typer.Option(help="A built-in task (hanoi, pusht), or a path to a task TOML.")]
PresetOption = Annotated[
    str | None, typer.Option(help=f"Overrides from the task's [presets]: {', '.join(PRESETS)}.", show_default=False)
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
WorkersOption = Annotated[int | None, typer.Option(help="Processes. Default: one a core.", show_default=False)]


def main() -> None:
    """Run the command line `vilp-data`."""
    run_app(app, "vilp-data")


def run_app(commands: typer.Typer, name: str) -> None:
    """Run a command line whose errors end in words, not in a traceback.

    Exit codes: 0 done, 1 findings or partial loss, 2 wrong use, 130 stopped by Ctrl-C."""
    try:
        commands()
    except VilpDataError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            print(f"{name}: stopped; what was finished is kept, run the same command again to go on", file=sys.stderr)
        raise


# --- record, inspect, ingest ---------------------------------------------------------------------------------------------


@app.command()
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


@app.command()
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


@app.command()
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


# --- split ---------------------------------------------------------------------------------------------------------------


@app.command()
def split(
    dataset: DatasetArgument = None,
    ratio: Annotated[
        float | None, typer.Option(help="Share of training episodes. Default: the task's (0.9).", show_default=False)
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the draw. Default: the task's.", show_default=False)] = None,
    redraw: Annotated[bool, typer.Option(help="Forget the present assignment and draw anew.")] = False,
    check: Annotated[bool, typer.Option(help="Change nothing; say what is wrong with the split.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Assign every episode to training or validation, for good: later runs place only what is new.

    Example: vilp-data split --ratio 0.9
    """
    from vilp_data.dataset_split import check_dataset_split, find_split, lock_path, update_split

    root, spec = _open(dataset)
    if check:
        findings = check_dataset_split(root)
        print_json(findings) if as_json else print("\n".join(findings) or f"{lock_path(root)}: nothing wrong")
        raise typer.Exit(1 if findings else 0)
    kept = find_split(root) is not None and not redraw
    lock = update_split(
        root,
        ratio=spec.split.ratio if ratio is None else ratio,
        ratio_from="task" if ratio is None else "command line",
        seed=spec.split.seed if seed is None else seed,
        group_by=spec.split.group_by,
        strata=spec.split.strata,
        redraw=redraw,
    )
    if as_json:
        print(lock.to_json().decode())
        return
    train, val = lock.ids("train"), lock.ids("val")
    drawn = f"ratio {lock.ratio:g} from the {lock.ratio_from}, seed {lock.seed}"
    print(f"{lock_path(root)}: {len(train)} training, {len(val)} validation episodes ({drawn})")
    if kept:
        print("  episodes placed before stay where they are; --redraw draws anew")
    for group in lock.duplicates:
        print(f"  identical, kept on one side: {', '.join(group)}")
    crossing = [pair for pair in lock.near_duplicates if lock.assignment[pair.first] != lock.assignment[pair.second]]
    if crossing:
        closest = f"{crossing[0].first} and {crossing[0].second}"
        print(f"  {len(crossing)} pairs across the sides look nearly alike, closest {closest}; see the lock")


# --- latents -------------------------------------------------------------------------------------------------------------


@app.command()
def latents(
    dataset: DatasetArgument = None,
    run: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the trained frame encoder. Default: the only one under DATASET/runs.", show_default=False
        ),
    ] = None,
    encoder: Annotated[
        str, typer.Option(help="Kind of frame encoder, as registered under vilp.frame_encoders.")
    ] = "vqgan",
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Encode every stored frame once, with a trained frame encoder.

    Example: vilp-data latents data/hanoi --run data/hanoi/runs/vqgan-cpu
    """
    from vilp_data.latent_runs import encode_dataset, find_run

    root, spec = _open(dataset)
    folder = find_run(root, run, encoder)
    with latent_bar() as progress:
        done = encode_dataset(root, spec, encoder, folder, workers=workers or cpu_count(), progress=progress)
    if as_json:
        print_json(dataclasses.asdict(done))
        return
    for view, key in done.keys.items():
        print(
            f"{root}/latents/{view}/{key}: {done.shards[view]} shards"
            + ("" if done.written[view] else ", all there already")
        )
    if done.frames:
        bare = f"{done.ratio:.0%} of the bare forward loop ({done.bare_frames_per_s:.0f} frames/s)"
        print(f"{done.frames} frames encoded at {done.frames_per_s:.0f} frames/s, {bare}")
    if done.unseen:
        print(f"  {len(done.unseen)} training episodes are new to the encoder: {', '.join(done.unseen[:5])}")


@app.command("why-stale")
def why_stale(
    dataset: DatasetArgument = None,
    task: Annotated[
        str | None, typer.Option(help="Compare with this task's spec instead of the dataset's own.", show_default=False)
    ] = None,
    preset: PresetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Name the field that makes stored episodes or latents stale.

    Example: vilp-data why-stale data/hanoi --task hanoi
    """
    from vilp_data.staleness import stale_episodes, stale_latents

    root, spec = _open(dataset)
    spec = load_task(task, preset=preset) if task else spec
    reasons = stale_episodes(root, spec) | stale_latents(root, spec)
    if as_json:
        print_json(reasons)
    else:
        print("\n".join(f"{what}: {why}" for what, why in sorted(reasons.items())) or f"{root}: nothing is stale")
    raise typer.Exit(1 if reasons else 0)


# --- view ----------------------------------------------------------------------------------------------------------------


@app.command()
def view(
    target: Annotated[str, typer.Argument(help="A log, or the id of an ingested episode.", show_default=False)],
    data: Annotated[
        Path | None,
        typer.Option(help="The dataset of an ingested episode. Default: as for the other verbs.", show_default=False),
    ] = None,
    episode: Annotated[
        str | None,
        typer.Option(help="Which demonstration of a log that holds many. Default: the first.", show_default=False),
    ] = None,
    run: Annotated[
        Path | None,
        typer.Option(help="The frame encoder to reconstruct with. Default: the only run there is.", show_default=False),
    ] = None,
    encoder: Annotated[
        str, typer.Option(help="Kind of frame encoder, as registered under vilp.frame_encoders.")
    ] = "vqgan",
    task: Annotated[
        str | None, typer.Option(help="The task of a log: its commands are plotted first.", show_default=False)
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve a page on 127.0.0.1 until Ctrl-C.")] = False,
    save: Annotated[Path | None, typer.Option(help="Write a Rerun recording (.rrd).", show_default=False)] = None,
    screenshot: Annotated[Path | None, typer.Option(help="Write a picture (.png).", show_default=False)] = None,
) -> None:
    """Show a log, or an ingested episode beside its reconstruction, in Rerun.

    Example: vilp-data view episode.mcap --screenshot v.png
    """
    from functools import partial

    from vilp_data.viewer import draw_episode, draw_log, present

    if Path(target).exists():
        named = load_task(task) if task else None
        rate_hz = named.rate_hz if named and named.rate_hz else 10.0
        draw = partial(draw_log, Path(target), episode=episode, spec=named, array_rate_hz=rate_hz)
    else:
        root, spec = _dataset_with(target, data)
        encoders = _encoders_of(root, spec, encoder, run)
        draw = partial(draw_episode, EpisodeStore(root), target, encoders=encoders)
    present(draw, web=web, save=save, screenshot=screenshot, say=print)


def _dataset_with(episode_id: str, data: Path | None) -> tuple[Path, TaskSpec]:
    """The dataset that holds this episode. UsageError where there is none, or the id is rather a path with a mistake in it."""
    try:
        root, spec = _open(data)
        EpisodeStore(root).entry(episode_id)
    except UsageError as error:
        if data is None and (Path(episode_id).suffix or "/" in episode_id):
            remedy = "give a log's path, or the id of an ingested episode"
            raise UsageError("no such log", where=episode_id, remedy=remedy) from error
        raise
    return root, spec


def _encoders_of(root: Path, spec: TaskSpec, name: str, run: Path | None) -> dict[str, FrameEncoder]:
    """The encoders of the run that is named, else of the only one; none where there is none, or several."""
    from vilp_data.latent_runs import find_run

    if run is None and len(list((root / "runs").glob(f"{name}*"))) != 1:
        return {}
    folder = find_run(root, run, name)
    return {view: load_encoder(name, folder, view) for view in spec.views}


# --- shared by the verbs -------------------------------------------------------------------------------------------------


def _open(given: Path | None) -> tuple[Path, TaskSpec]:
    root = find_dataset(given)
    if given is None:
        console.print(f"dataset: {root}", highlight=False)
    remember(root)
    return root, EpisodeStore(root).spec()


def print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, sort_keys=True, default=str))


class Advance(Protocol):
    """Moves a bar to `done`; `total` where it was not known before."""

    def __call__(self, done: int, total: int | None = None) -> None: ...


@contextmanager
def progress_bar(label: str, total: int | None) -> Iterator[Advance]:
    """A bar with count, rate and time left, on a terminal; elsewhere nothing."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(label, total=total, rate="")

        def advance(done: int, total: int | None = None) -> None:
            speed = bar.tasks[task].speed
            bar.update(task, completed=done, total=total, rate=f"{speed:.2f}/s" if speed else "")

        yield advance


@contextmanager
def latent_bar() -> Iterator[Callable[[int, int, float], None]]:
    """The encoder's bar: frames done, frames/s, and how that compares with the bare forward loop."""
    columns = (
        TextColumn("encoding"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("frames  {task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("encoding", total=None, rate="")

        def advance(done: int, of: int, bare_frames_per_s: float) -> None:
            elapsed = bar.tasks[task].elapsed or 0.0
            speed = done / elapsed if elapsed else 0.0
            bar.update(
                task, completed=done, total=of, rate=f"{speed:.0f}/s, {speed / bare_frames_per_s:.0%} of bare forward"
            )

        yield advance
