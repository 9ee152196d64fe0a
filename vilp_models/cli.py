"""`vilp-models`: train, evaluate, roll out. Thin: it parses, calls, prints."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

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


TaskOption = Annotated[
    str | None,
    typer.Option(help="Task whose recipes and [window] to use. Default: the dataset's own.", show_default=False),
]
RunOption = Annotated[
    Path | None, typer.Option(help="Where the run lives. Default: DATA/runs/MODEL-PRESET.", show_default=False)
]
VqganOption = Annotated[
    Path | None,
    typer.Option("--vqgan", help="The VQGAN run that made the latents. Default: the only one under DATA/runs."),
]
RestartOption = Annotated[
    bool, typer.Option("--restart", help="Begin anew, though a run of another recipe or dataset is there.")
]


ModelRunOption = Annotated[
    Path | None,
    typer.Option("--run", help="The trained run. Default: that of --preset, else the only one.", show_default=False),
]
DenoisingStepsOption = Annotated[
    int | None, typer.Option(min=1, help="Denoising steps. Default: the planner's recipe's.", show_default=False)
]
SamplerOption = Annotated[
    Literal["ddim", "dpm++"] | None, typer.Option(help="Default: the planner's recipe's.", show_default=False)
]
NoiseSeedOption = Annotated[int, typer.Option(min=0, help="Of the noise; the same seed imagines the same.")]


@train_app.command("vqgan")
def train_vqgan(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: RunOption = None,
    restart: RestartOption = False,
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
        run or default_run(root, "vqgan", preset),
        train_episodes=[entry.id for entry in episodes],
        split_hash=read_split(root).hash,
        restart=restart,
    )


@train_app.command("planner")
def train_planner(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: RunOption = None,
    vqgan: VqganOption = None,
    restart: RestartOption = False,
) -> None:
    """Train the video planner of each view on latents; goes on where it stopped, and does nothing when it is done.

    Example: vilp-models train planner --task pusht --preset cpu
    """
    from vilp_data.latent_runs import find_run
    from vilp_models.recipe import PlannerRecipe, load_recipe
    from vilp_models.train import train_planner as train

    root, spec = _dataset(data, task, preset)
    recipe = load_recipe(PlannerRecipe, "planner", spec.models, preset=preset, where=spec.name)
    folder = run or default_run(root, "planner", preset)
    train(root, spec, recipe, folder, vqgan=find_run(root, vqgan, "vqgan"), restart=restart)


@train_app.command("policy")
def train_policy(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: RunOption = None,
    vqgan: VqganOption = None,
    restart: RestartOption = False,
) -> None:
    """Train the low-level policy, from two frames to the actions between; goes on where it stopped.

    A recipe that sees latents or reconstructions needs a VQGAN run; others do not.

    Example: vilp-models train policy --task pusht --preset cpu
    """
    from vilp_data.latent_runs import find_run
    from vilp_models.recipe import PolicyRecipe, load_recipe
    from vilp_models.train import train_policy as train

    root, spec = _dataset(data, task, preset)
    recipe = load_recipe(PolicyRecipe, "policy", spec.models, preset=preset, where=spec.name)
    folder = run or default_run(root, "policy", preset)
    needs_vqgan = recipe.sees == "latents" or recipe.reconstructed_share > 0
    train(root, spec, recipe, folder, vqgan=find_run(root, vqgan, "vqgan") if needs_vqgan else None, restart=restart)


@train_app.command("bc")
def train_bc(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: RunOption = None,
    restart: RestartOption = False,
) -> None:
    """Train behaviour cloning, one observation to the next n_action_steps actions: a baseline; goes on where it stopped.

    Example: vilp-models train bc --task pusht --preset cpu
    """
    from vilp_models.recipe import BcRecipe, VilpRecipe, load_recipe
    from vilp_models.train import train_bc as train

    root, spec = _dataset(data, task, preset)
    recipe = load_recipe(BcRecipe, "bc", spec.models, preset=preset, where=spec.name)
    vilp = load_recipe(VilpRecipe, "vilp", spec.models, preset=preset, where=spec.name)
    folder = run or default_run(root, "bc", preset)
    train(root, spec, recipe, folder, n_action_steps=vilp.n_action_steps, restart=restart)


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


@evaluate_app.command("planner")
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
    from vilp_data.latent_runs import find_run
    from vilp_models.evaluate import Sampling
    from vilp_models.evaluate import evaluate_planner as evaluate
    from vilp_models.planner_page import summary

    root, spec = _dataset(data, task, preset)
    with progress_bar("imagining", None) as advance:
        table, folder = evaluate(
            root, spec, _model_run(root, run, "planner", preset), find_run(root, vqgan, "vqgan"),
            n_starts=starts, n_samples=samples, sampling=Sampling(seed, denoising_steps, sampler), progress=advance,
        )  # fmt: skip
    print_json(table) if as_json else print("\n".join(summary(table, folder)))
    if table["warnings"]:
        raise typer.Exit(1)


@evaluate_app.command("policy")
def evaluate_policy(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: ModelRunOption = None,
    vqgan: VqganOption = None,
    as_json: JsonOption = False,
) -> None:
    """Report the low-level policy's errors on held-out pairs, true and reconstructed, beside the mean action, the last one and staying.

    Example: vilp-models evaluate policy --data data/pusht --preset cpu
    """
    from vilp_data.latent_runs import find_run
    from vilp_models.evaluate import evaluate_policy as evaluate
    from vilp_models.policy_page import summary

    root, spec = _dataset(data, task, preset)
    with progress_bar("acting", None) as advance:
        table, folder = evaluate(
            root, spec, _model_run(root, run, "policy", preset), find_run(root, vqgan, "vqgan"), progress=advance
        )
    print_json(table) if as_json else print("\n".join(summary(table, folder)))
    if table["warnings"]:
        raise typer.Exit(1)


@app.command()
def generate(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: ModelRunOption = None,
    vqgan: VqganOption = None,
    episodes: Annotated[int, typer.Option(min=1, help="How many videos, spread over the validation episodes.")] = 6,
    long: Annotated[
        int | None,
        typer.Option(
            min=1, help="Feed the last imagined frame back until there are this many; needs planners without low_dim."
        ),
    ] = None,
    denoising_steps: DenoisingStepsOption = None,
    sampler: SamplerOption = None,
    seed: NoiseSeedOption = 0,
    out: Annotated[Path | None, typer.Option(help="Folder. Default: DATA/generated/RUN.", show_default=False)] = None,
) -> None:
    """Imagine from validation starts: real, reconstructed, imagined and error as video (.mp4), picture (.png) and recording (.rrd).

    Example: vilp-models generate --data data/pusht --preset cpu --long 60
    """
    from vilp_data.latent_runs import find_run
    from vilp_models.evaluate import Sampling, generate_videos

    root, spec = _dataset(data, task, preset)
    folder = _model_run(root, run, "planner", preset)
    target = out or root / "generated" / folder.name
    with progress_bar("imagining", episodes) as advance:
        lines = generate_videos(
            root, spec, folder, find_run(root, vqgan, "vqgan"), target,
            n_videos=episodes, long_frames=long, sampling=Sampling(seed, denoising_steps, sampler), progress=advance,
        )  # fmt: skip
    print("\n".join([*lines, f"in {target}; `rerun FILE.rrd` opens a recording"]))


@app.command()
def rollout(
    task: Annotated[
        str | None,
        typer.Option(help="Task whose [models] to use. Default: the dataset's own.", show_default=False),
    ] = None,
    preset: PresetOption = None,
    data: DataOption = None,
    policy: Annotated[
        str, typer.Option(help="replay, stay, oracle (true future frames), vilp or bc; see below.")
    ] = "replay",
    seeds: Annotated[
        str | None,
        typer.Option(help="Simulator's starts FIRST:END, without END itself. Default: 0:50.", show_default=False),
    ] = None,
    from_episodes: Annotated[
        str | None,
        typer.Option(
            help="Start at the first recorded state of episodes: val, train or all. Default for oracle: val.",
            show_default=False,
        ),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="How many of the dataset's episodes. Default: all.", show_default=False)
    ] = None,
    envs: Annotated[int, typer.Option(min=1, help="Environments that are planned for together.")] = 50,
    max_steps: Annotated[
        int | None, typer.Option(min=1, help="Steps of an episode. Default: the task's.", show_default=False)
    ] = None,
    against: Annotated[
        list[Path] | None,
        typer.Option(
            help="A finished rollout of the same starts to compare with. Default: that of stay, if any.",
            show_default=False,
        ),
    ] = None,
    logs: Annotated[
        bool, typer.Option("--logs/--no-logs", help="Write an MCAP log of each episode, and videos.")
    ] = True,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder. Default: DATA/rollouts/POLICY-PRESET-STARTS.", show_default=False),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(help="Where networks run. Default: an accelerator if there is one.", show_default=False),
    ] = None,
    render: Annotated[
        bool, typer.Option("--render", help="Replay: also draw the recorded states and compare with the stored frames.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Let a policy act in the simulator, and report mean of max reward and success rate with 95 % intervals.

    `--policy replay` alone proves the dataset instead: recorded actions must bring the recorded states back. With
    --from-episodes it is a policy like the others. Tune on seeds 0:50; report 100000:100050, once.

    Example: vilp-models rollout --data data/pusht --policy vilp --preset cpu --seeds 100000:100050
    """
    root, spec = _dataset(data, task, preset)
    if policy == "replay" and seeds is None and from_episodes is None:
        _prove_replay(root, spec, episodes=episodes, render=render, as_json=as_json)
        return
    from vilp_data.errors import UsageError
    from vilp_models.policies.load import FOLLOWS_RECORDINGS, HAS_MODELS, PolicyRequest, load_policy
    from vilp_models.recipe import VilpRecipe, load_recipe
    from vilp_models.rollout_report import finished_rollout, format_rollout, read_rollout, roll_out_into
    from vilp_models.simulator import require_simulator
    from vilp_models.starts import episode_starts, parse_seeds, seed_starts
    from vilp_models.trained import default_device

    if seeds is not None and (from_episodes is not None or episodes is not None):
        raise UsageError("episodes start at seeds or at recorded states, not both", remedy="leave one of them out")
    n_steps = max_steps or require_simulator(spec).max_steps
    if seeds is None and (from_episodes is not None or policy in FOLLOWS_RECORDINGS):
        side = from_episodes or "val"
        starts, recordings = episode_starts(EpisodeStore(root), side, limit=episodes)
        what = side if episodes is None else f"{side}-{len(starts)}"
    else:
        chosen = parse_seeds(seeds or "0:50")
        starts, recordings, what = seed_starts(chosen), {}, f"{chosen.start}-{chosen.stop}"
    recipe = load_recipe(VilpRecipe, "vilp", spec.models, preset=preset, where=spec.name)
    request = PolicyRequest(
        root, spec, preset, recipe.n_action_steps, device=device or default_device(), recordings=recordings
    )
    acting = load_policy(policy, request)
    folder = out or root / "rollouts" / "-".join([policy, *([preset] if preset and policy in HAS_MODELS else []), what])
    stay = root / "rollouts" / f"stay-{what}"
    if against is None:
        names = [start.name for start in starts]
        against = [stay] if finished_rollout(stay, task=spec.name, max_steps=n_steps, names=names) else []
    with progress_bar(f"rolling out {policy}", len(starts) * n_steps) as advance:
        roll_out_into(
            folder, spec, acting, starts, name=policy, what=what, max_steps=n_steps, environments=envs,
            against=[other for other in against if other != folder], with_logs=logs, progress=advance,
        )  # fmt: skip
    table = read_rollout(folder)
    print_json(table) if as_json else print("\n".join(format_rollout(table, folder)))


def _prove_replay(root: Path, spec: TaskSpec, *, episodes: int | None, render: bool, as_json: bool) -> None:
    from vilp_models.replay import format_render, format_replay, render_match, replay
    from vilp_models.simulator import make_env

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


def _model_run(root: Path, given: Path | None, model: str, preset: str | None) -> Path:
    """The folder of the trained model: the one given, else the preset's, else the only one of its kind."""
    from vilp_data.latent_runs import find_run

    return find_run(root, given or (default_run(root, model, preset) if preset is not None else None), model)


def default_run(root: Path, model: str, preset: str | None) -> Path:
    """Where a preset's model of this kind lives within its dataset."""
    return root / "runs" / f"{model}-{preset or 'default'}"


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
    """The dataset folder, and its spec; what decides nothing in ingested files (the window, the models' tables) comes from the task's
    file of today where a task is named."""
    if data is None and task is not None:
        name = load_task(task).name
        data = next((root for root in (default_root(name, preset), default_root(name, None)) if is_dataset(root)), None)
    root = find_dataset(data)
    remember(root)
    print(f"dataset: {root}", file=sys.stderr)
    spec = EpisodeStore(root).spec()
    if task is None:
        return root, spec
    today = load_task(task, preset=preset)
    return root, spec.model_copy(update={"window": today.window, "models": today.models})
