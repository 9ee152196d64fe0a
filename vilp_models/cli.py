"""`vilp-models`: train, evaluate, roll out. Thin: it parses, calls, prints."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from vilp_data.cli import JsonOption, PresetOption, print_json, progress_bar, run_app
from vilp_data.episodes import EpisodeStore
from vilp_data.locate import default_root, find_dataset, is_dataset, remember
from vilp_data.spec import TaskSpec, load_task

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Train and judge the models on a dataset.",
)
train_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Train a model on the training episodes of a dataset."
)
evaluate_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Judge a trained model on the validation episodes of a dataset."
)
app.add_typer(train_app, name="train")
app.add_typer(evaluate_app, name="evaluate")

DataOption = Annotated[
    Path | None, typer.Option("--data", help="Dataset folder. Default: data/TASK.", show_default=False)
]


def main() -> None:
    """Run the command line; exit codes as of `vilp-data`."""
    run_app(app, "vilp-models")


@train_app.command("vqgan")
def train_vqgan(
    task: Annotated[
        str | None,
        typer.Option(help="Task whose [models.vqgan] recipe to use. Default: the dataset's own.", show_default=False),
    ] = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: Annotated[
        Path | None, typer.Option(help="Where the run lives. Default: DATA/runs/vqgan-PRESET.", show_default=False)
    ] = None,
    restart: Annotated[
        bool, typer.Option("--restart", help="Begin anew, though a run of another recipe is there.")
    ] = False,
) -> None:
    """Train the VQGAN on frames of the training episodes; goes on where it stopped, and does nothing when it is done.

    Example: vilp-models train vqgan --task hanoi --preset cpu
    """
    from vilp_data.dataset_split import read_split, side_episodes
    from vilp_models.recipe import vqgan_recipe
    from vilp_models.train import train_vqgan as train

    root, spec = _dataset(data, task, preset)
    episodes = side_episodes(EpisodeStore(root), "train")
    recipe = vqgan_recipe(spec.models, preset=preset, where=spec.name)
    train(
        root,
        spec,
        recipe,
        run or default_run(root, preset),
        train_episodes=[entry.id for entry in episodes],
        split_hash=read_split(root).hash,
        restart=restart,
    )


@evaluate_app.command("vqgan")
def evaluate_vqgan(
    data: DataOption = None,
    run: Annotated[
        Path | None, typer.Option(help="The trained run. Default: the only one under DATA/runs.", show_default=False)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Report what the VQGAN loses on validation episodes: PSNR and LPIPS, moving pixels, codes, float16; worst frames as a picture.

    Example: vilp-models evaluate vqgan --run data/hanoi/runs/vqgan-cpu
    """
    from vilp_data.dataset_split import side_episodes
    from vilp_data.latent_runs import find_run
    from vilp_models.fidelity import fidelity_report, report_inputs
    from vilp_models.fidelity_page import read_fresh_report, write_report

    root, _ = _dataset(data, None, None)
    folder = find_run(root, run, "vqgan")
    store = EpisodeStore(root)
    episodes = [entry.id for entry in side_episodes(store, "val")]
    inputs = report_inputs(store, folder, episodes)
    table = read_fresh_report(folder / "fidelity", inputs)
    if table is None:
        with progress_bar("fidelity", None) as advance:
            report = fidelity_report(store, folder, episodes, progress=advance)
        write_report(report, folder / "fidelity", inputs)
        table = read_fresh_report(folder / "fidelity", inputs)
    assert table is not None
    print_json(table) if as_json else print("\n".join(format_fidelity(table, folder / "fidelity")))
    if table["warnings"]:
        raise typer.Exit(1)


@app.command()
def rollout(
    data: DataOption = None,
    policy: Annotated[
        str, typer.Option(help="replay: the recorded actions, from the recorded first state.")
    ] = "replay",
    episodes: Annotated[
        int | None, typer.Option(min=1, help="How many of the dataset's episodes. Default: all.", show_default=False)
    ] = None,
    render: Annotated[
        bool, typer.Option("--render", help="Also draw the recorded states and compare with the stored frames.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Play ingested episodes through the simulator: the recorded states must come back.

    Example: vilp-models rollout --data data/pusht --policy replay --episodes 5
    """
    from vilp_data.errors import UsageError, nearest
    from vilp_models.rollout import format_render, format_replay, make_env, render_match, replay

    if policy != "replay":
        raise UsageError(f"no policy called {policy!r}", remedy=nearest(policy, ["replay"]))
    root, spec = _dataset(data, None, None)
    store = EpisodeStore(root)
    env = make_env(spec, cameras=render)
    tolerance = env.metadata.get("replay_tolerance")
    reports, failed = [], 0
    for entry in store.index()[:episodes]:
        episode = store.read(entry.id)
        report = replay(episode, env)
        reports.append(dataclasses.asdict(report))
        failed += tolerance is not None and not report.proves(tolerance)
        lines = format_replay(report, tolerance=tolerance)
        if render:
            match = render_match(episode, env)
            failed += not match.proves()
            lines += format_render(match)
            reports[-1]["render"] = dataclasses.asdict(match)
        if not as_json:
            print("\n".join(lines))
    env.close()
    if as_json:
        print_json(reports)
    if failed:
        raise typer.Exit(1)


def default_run(root: Path, preset: str | None) -> Path:
    """Where a preset's VQGAN lives within its dataset."""
    return root / "runs" / f"vqgan-{preset or 'default'}"


def format_fidelity(table: dict[str, Any], folder: Path) -> list[str]:
    """The report's summary for a terminal: a line a view, then the warnings."""
    lines = []
    for view, row in table["views"].items():
        moving = {name: _db(row[name]["moving_psnr"]) for name in ("vqgan", "mean_frame", "copy")}
        baselines = f"mean frame {moving['mean_frame']}, copy {moving['copy']}"
        codes = f"{row['codes_used']} of {row['codes']} codes used"
        lines.append(
            f"{view}: PSNR {_db(row['vqgan']['psnr'])} dB, moving pixels {moving['vqgan']} dB ({baselines}); {codes}"
        )
    warnings = [f"warning: {warning}" for warning in table["warnings"]]
    return [*lines, *warnings, f"{folder}/report.md and worst.png show it in full"]


def _db(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _dataset(data: Path | None, task: str | None, preset: str | None) -> tuple[Path, TaskSpec]:
    """The dataset folder, and its spec; the models' tables come from the task's file of today where a task is named."""
    if data is None and task is not None:
        name = load_task(task).name
        data = next((root for root in (default_root(name, preset), default_root(name, None)) if is_dataset(root)), None)
    root = find_dataset(data)
    remember(root)
    print(f"dataset: {root}", file=sys.stderr)
    spec = EpisodeStore(root).spec()
    return root, spec if task is None else spec.model_copy(update={"models": load_task(task, preset=preset).models})
