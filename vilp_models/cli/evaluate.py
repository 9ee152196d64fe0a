"""`vilp-models evaluate MODEL`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from vilp_data.cli.options import JsonOption, PresetOption, label_pairs, print_json, progress_bar
from vilp_data.episodes import EpisodeStore
from vilp_models.cli.options import (
    DataOption,
    DenoisingStepsOption,
    ModelRunOption,
    NoiseSeedOption,
    SamplerOption,
    SetOption,
    TaskOption,
    VqganOption,
    dataset_of,
)
from vilp_models.runs import find_model_run

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Judge a trained model on the validation episodes of a dataset."
)


@app.command("vqgan")
def evaluate_vqgan(
    data: DataOption = None,
    preset: PresetOption = None,
    run: ModelRunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Report what the VQGAN loses on validation episodes: PSNR and LPIPS, moving pixels, codes, float16; worst frames as a picture.

    Example: vilp-models evaluate vqgan --data data/hanoi
    """
    from vilp_data.dataset_split import side_episodes
    from vilp_models.fidelity import fidelity_report, report_inputs
    from vilp_models.fidelity_page import read_fresh_report, write_report

    root, _ = dataset_of(data, None, None)
    folder = find_model_run(root, "vqgan", given=run, preset=preset)
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


@app.command("planner")
def evaluate_planner(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: ModelRunOption = None,
    vqgan: VqganOption = None,
    starts: Annotated[
        int, typer.Option(min=1, help="Starts, evenly spread over the validation episodes; at most all there are.")
    ] = 200,
    samples: Annotated[int, typer.Option(min=1, help="Imagined futures of each start.")] = 8,
    denoising_steps: DenoisingStepsOption = None,
    sampler: SamplerOption = None,
    seed: NoiseSeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Report whether imagined frames beat copying the present one: latent error and PSNR at every step of the horizon, with intervals.

    Example: vilp-models evaluate planner --data data/pusht --preset cpu
    """
    from vilp_models.evaluate import Sampling
    from vilp_models.evaluate import evaluate_planner as evaluate
    from vilp_models.planner_page import summary

    root, spec = dataset_of(data, task, preset)
    folder = find_model_run(root, "planner", given=run, preset=preset)
    vqgan_run = find_model_run(root, "vqgan", given=vqgan, preset=preset, option="--vqgan")
    with progress_bar("imagining", None) as advance:
        table, report = evaluate(
            root, spec, folder, vqgan_run,
            n_starts=starts, n_samples=samples, sampling=Sampling(seed, denoising_steps, sampler), progress=advance,
        )  # fmt: skip
    print_json(table) if as_json else print("\n".join(summary(table, report)))
    if table["warnings"]:
        raise typer.Exit(1)


@app.command("policy")
def evaluate_policy(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: ModelRunOption = None,
    vqgan: VqganOption = None,
    action_set: SetOption = None,
    where: Annotated[
        list[str] | None,
        typer.Option(help="KEY=VALUE: on episodes with this tag alone; several must all fit.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Report the low-level policy's errors on held-out pairs, true and reconstructed, beside the mean action, the last one and staying.

    Example: vilp-models evaluate policy --data data/pusht --preset cpu
    """
    from vilp_models.evaluate import evaluate_policy as evaluate
    from vilp_models.policy_page import summary

    root, spec = dataset_of(data, task, preset)
    folder = find_model_run(root, "policy", given=run, preset=preset, action_set=action_set)
    vqgan_run = find_model_run(root, "vqgan", given=vqgan, preset=preset, option="--vqgan")
    with progress_bar("acting", None) as advance:
        table, report = evaluate(
            root, spec, folder, vqgan_run, action_set=action_set, where=label_pairs(where or []), progress=advance
        )
    print_json(table) if as_json else print("\n".join(summary(table, report)))
    if table["warnings"]:
        raise typer.Exit(1)


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
