"""`vilp-models rollout`: a policy in the simulator, or the proof that a dataset replays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vilp_data.cli.options import JsonOption, PresetOption, print_json, progress_bar
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.spec import TaskSpec
from vilp_models.cli.options import (
    DataOption,
    DenoisingStepsOption,
    SamplerOption,
    SetOption,
    TaskOption,
    VqganOption,
    dataset_of,
)

if TYPE_CHECKING:
    from vilp_models.starts import Recording, Start


PolicyOption = Annotated[str, typer.Option(help="replay, stay, oracle (true future frames), vilp or bc; see below.")]
SeedsOption = Annotated[
    str | None,
    typer.Option(help="Simulator's starts FIRST:END, without END itself. Default: 0:50.", show_default=False),
]
FromEpisodesOption = Annotated[
    str | None,
    typer.Option(
        help="Start at the first recorded state of the task's own episodes (not of other goals or objects): val, train or all. "
        "Default for oracle: val.",
        show_default=False,
    ),
]
EpisodesOption = Annotated[
    int | None, typer.Option(min=1, help="How many of the dataset's episodes. Default: all.", show_default=False)
]
EnvsOption = Annotated[int, typer.Option(min=1, help="Environments that are planned for together.")]
MaxStepsOption = Annotated[
    int | None, typer.Option(min=1, help="Steps of an episode. Default: the task's.", show_default=False)
]
AgainstOption = Annotated[
    list[Path] | None,
    typer.Option(
        help="A finished rollout of the same starts to compare with. Default: that of stay, if any.",
        show_default=False,
    ),
]
LogsOption = Annotated[bool, typer.Option("--logs/--no-logs", help="Write an MCAP log of each episode, and videos.")]
OutOption = Annotated[
    Path | None,
    typer.Option(help="Folder. Default: DATA/rollouts/POLICY-PRESET-SET-SETTINGS-STARTS.", show_default=False),
]
PrecisionOption = Annotated[
    Literal["f32", "bf16"],
    typer.Option(help="What imagining computes in; encoding is always as latents were made."),
]
DeviceOption = Annotated[
    str | None,
    typer.Option(help="Where networks run. Default: an accelerator if there is one.", show_default=False),
]
RenderOption = Annotated[
    bool, typer.Option("--render", help="Replay: also draw the recorded states and compare with the stored frames.")
]


def rollout(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    policy: PolicyOption = "replay",
    seeds: SeedsOption = None,
    from_episodes: FromEpisodesOption = None,
    episodes: EpisodesOption = None,
    envs: EnvsOption = 50,
    max_steps: MaxStepsOption = None,
    against: AgainstOption = None,
    logs: LogsOption = True,
    out: OutOption = None,
    vqgan: VqganOption = None,
    action_set: SetOption = None,
    denoising_steps: DenoisingStepsOption = None,
    sampler: SamplerOption = None,
    precision: PrecisionOption = "f32",
    device: DeviceOption = None,
    render: RenderOption = False,
    as_json: JsonOption = False,
) -> None:
    """Let a policy act in the simulator, and report mean of max reward and success rate with 95 % intervals.

    `--policy replay` alone proves the dataset instead: recorded actions must bring the recorded states back. With
    --from-episodes it is a policy like the others. Tune on seeds 0:50; report 100000:100050, once.

    Example: vilp-models rollout --data data/pusht --policy vilp --preset cpu --seeds 100000:100050
    """
    root, spec = dataset_of(data, task, preset)
    if policy == "replay" and seeds is None and from_episodes is None:
        _prove_replay(root, spec, episodes=episodes, render=render, as_json=as_json)
        return
    from vilp_models.policies.load import FOLLOWS_RECORDINGS, PolicyRequest, load_policy
    from vilp_models.recipe import VilpRecipe, load_recipe
    from vilp_models.rollout_report import finished_rollout, format_rollout, read_rollout, roll_out_into
    from vilp_models.simulator import require_simulator
    from vilp_models.starts import starts_digest
    from vilp_models.trained import default_device

    settings = _settings(denoising_steps, sampler, precision)
    _refuse_mixture(policy, seeds, from_episodes, episodes, settings, action_set)
    n_steps = max_steps or require_simulator(spec).max_steps
    side = from_episodes or ("val" if seeds is None and policy in FOLLOWS_RECORDINGS else None)
    starts, recordings, what = _starts(root, spec, seeds or "0:50", side, episodes)
    recipe = load_recipe(VilpRecipe, "vilp", spec.models, preset=preset, where=spec.name)
    request = PolicyRequest(
        root, spec, preset, recipe.n_action_steps, device=device or default_device(), recordings=recordings,
        vqgan=vqgan, action_set=action_set, denoising_steps=denoising_steps, sampler=sampler, precision=precision,
    )  # fmt: skip
    acting = load_policy(policy, request)
    label = what.replace(":", "-")
    models = _models(policy, preset, action_set, vqgan)
    folder = out or root / "rollouts" / "-".join([policy, *models, *settings, label])
    stay = root / "rollouts" / f"stay-{label}"
    if against is None:
        begun = starts_digest(require_simulator(spec), starts)
        against = [stay] if finished_rollout(stay, task=spec.name, max_steps=n_steps, starts_sha256=begun) else []
    with progress_bar(f"rolling out {policy}", len(starts) * n_steps) as advance:
        roll_out_into(
            folder, spec, acting, starts, name=policy, what=what, max_steps=n_steps, environments=envs,
            against=[other for other in against if other != folder], with_logs=logs, progress=advance,
        )  # fmt: skip
    table = read_rollout(folder)
    print_json(table) if as_json else print("\n".join(format_rollout(table, folder)))


def _starts(
    root: Path, spec: TaskSpec, seeds: str, side: str | None, episodes: int | None
) -> tuple[list[Start], Mapping[int, Recording], str]:
    """The starts, the recordings that they have, and what to call them: episodes of a side of the split, else seeds."""
    from vilp_models.simulator import Worlds
    from vilp_models.starts import episode_starts, parse_seeds, unseen_starts

    if side is None:
        return unseen_starts(EpisodeStore(root), spec, parse_seeds(seeds)), {}, seeds
    world = Worlds(spec, cameras=False)
    starts, recordings = episode_starts(EpisodeStore(root), side, limit=episodes, world=world.own_tags())
    world.close()
    return starts, recordings, side if episodes is None else f"{side}-{len(starts)}"


def _refuse_mixture(
    policy: str,
    seeds: str | None,
    from_episodes: str | None,
    episodes: int | None,
    settings: list[str],
    action_set: str | None,
) -> None:
    """UsageError for options that do not go together, or not with the policy."""
    from vilp_models.policies.load import HAS_MODELS

    if seeds is not None and (from_episodes is not None or episodes is not None):
        raise UsageError("episodes start at seeds or at recorded states, not both", remedy="leave one of them out")
    if settings and policy != "vilp":
        remedy = "leave --denoising-steps, --sampler and --precision out, or roll out vilp"
        raise UsageError(f"the policy {policy!r} imagines nothing", found=", ".join(settings), remedy=remedy)
    if action_set is not None and policy not in HAS_MODELS:
        raise UsageError(
            f"the policy {policy!r} learns from nothing", found=f"--set {action_set}", remedy="leave --set out"
        )


def _models(policy: str, preset: str | None, action_set: str | None, vqgan: Path | None) -> list[str]:
    """Which models act, as a folder's name tells it."""
    from vilp_models.policies.load import HAS_MODELS

    return [name for name in (preset, action_set, vqgan and vqgan.name) if name] if policy in HAS_MODELS else []


def _settings(denoising_steps: int | None, sampler: str | None, precision: str) -> list[str]:
    """What was asked for beside the recipe, as a folder's name tells it."""
    steps = [] if denoising_steps is None else [f"{denoising_steps}step{'' if denoising_steps == 1 else 's'}"]
    return [*steps, *([sampler] if sampler else []), *([precision] if precision != "f32" else [])]


def _prove_replay(root: Path, spec: TaskSpec, *, episodes: int | None, render: bool, as_json: bool) -> None:
    from vilp_models.replay import format_render, format_replay, format_replays, render_match, replay
    from vilp_models.simulator import Worlds

    store = EpisodeStore(root)
    worlds = Worlds(spec, cameras=render)
    reports, proven, shown = [], [], []
    for entry in store.index()[:episodes]:
        episode = store.read(entry.id)
        env = worlds.of(episode.tags)
        tolerance = env.metadata.get("replay_tolerance")
        report = replay(episode, env)
        reports.append(report)
        proven.append(tolerance is None or not report.fails(tolerance))
        lines = format_replay(report, tolerance=tolerance)
        shown.append(dataclasses.asdict(report))
        if render:
            match = render_match(episode, env)
            proven[-1] &= match.proves()
            lines += format_render(match)
            shown[-1]["render"] = dataclasses.asdict(match)
        if not as_json:
            print("\n".join(lines))
    worlds.close()
    print_json(shown) if as_json else print(format_replays(reports, proven))
    if not all(proven):
        raise typer.Exit(1)
