"""`vilp-models generate`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer

from vilp_data.cli.options import PresetOption, progress_bar
from vilp_data.errors import UsageError
from vilp_data.generated_episode import generated_name
from vilp_data.spec import TaskSpec
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

EpisodesOption = Annotated[int, typer.Option(min=1, help="How many videos, spread over the validation episodes.")]
LongOption = Annotated[
    int | None,
    typer.Option(
        min=1, help="Feed the last imagined frame back until there are this many; needs planners without low_dim."
    ),
]
WholeOption = Annotated[
    bool,
    typer.Option(
        "--whole", help="Walk along whole episodes as VILP would act on them, for `vilp-data view --generated`."
    ),
]
EpisodeOption = Annotated[
    list[str] | None,
    typer.Option(help="With --whole: this validation episode; may be given again.", show_default=False),
]
OutOption = Annotated[
    Path | None,
    typer.Option(help="Folder. Default: DATA/generated/RUN, with an action set RUN-SET.", show_default=False),
]


def generate(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: ModelRunOption = None,
    vqgan: VqganOption = None,
    episodes: EpisodesOption = 6,
    long: LongOption = None,
    whole: WholeOption = False,
    episode: EpisodeOption = None,
    action_set: SetOption = None,
    denoising_steps: DenoisingStepsOption = None,
    sampler: SamplerOption = None,
    seed: NoiseSeedOption = 0,
    out: OutOption = None,
) -> None:
    """Imagine from validation starts: real, reconstructed, imagined and error as video (.mp4), picture (.png) and recording (.rrd).

    With --whole, from every n_action_steps steps of whole episodes on, with the actions that VILP's low-level policy makes of it.

    Example: vilp-models generate --data data/pusht --preset cpu --long 60
    """
    from vilp_models.evaluate import Sampling, generate_videos

    _refuse_mixture(whole, long, episode, action_set)
    root, spec = dataset_of(data, task, preset)
    folder = find_model_run(root, "planner", given=run, preset=preset)
    vqgan_run = find_model_run(root, "vqgan", given=vqgan, preset=preset, option="--vqgan")
    target = out or root / "generated" / "-".join([folder.name, *([action_set] if action_set else [])])
    if whole:
        _whole(
            root, spec, preset, folder, vqgan_run, target, n_episodes=episodes, ids=episode or [], action_set=action_set,
            denoising_steps=denoising_steps, sampler=sampler, seed=seed,
            given={"--task": task, "--run": run, "--vqgan": vqgan, "--out": out},
        )  # fmt: skip
        return
    with progress_bar("imagining", episodes) as advance:
        lines = generate_videos(
            root, spec, folder, vqgan_run, target,
            n_videos=episodes, long_frames=long, sampling=Sampling(seed, denoising_steps, sampler), progress=advance,
        )  # fmt: skip
    print("\n".join([*lines, f"in {target}; `rerun FILE.rrd` opens a recording"]))


def _refuse_mixture(whole: bool, long: int | None, episode: list[str] | None, action_set: str | None) -> None:
    if whole and long is not None:
        raise UsageError(
            "--long feeds imagined frames back, --whole looks at the real ones", remedy="leave one of them out"
        )
    without = {"--episode": episode, "--set": action_set}
    for option, value in without.items() if not whole else ():
        if value:
            raise UsageError(f"{option} is for whole episodes", remedy=f"add --whole, or leave {option} out")


def _whole(
    root: Path,
    spec: TaskSpec,
    preset: str | None,
    planner: Path,
    vqgan: Path,
    out: Path,
    *,
    n_episodes: int,
    ids: list[str],
    action_set: str | None,
    denoising_steps: int | None,
    sampler: Literal["ddim", "dpm++"] | None,
    seed: int,
    given: Mapping[str, object],
) -> None:
    from vilp_models.recipe import VilpRecipe, load_recipe
    from vilp_models.whole_episode import WholeRequest, generate_whole

    policy = find_model_run(root, "policy", preset=preset, action_set=action_set, option="--preset")
    recipe = load_recipe(VilpRecipe, "vilp", spec.models, preset=preset, where=spec.name)
    told = {
        **given,
        "--preset": preset,
        "--set": action_set,
        "--denoising-steps": denoising_steps,
        "--sampler": sampler,
        "--seed": seed or None,
    }
    said = {option: value.resolve() if isinstance(value, Path) else value for option, value in told.items()}
    words = tuple(str(word) for option, value in said.items() if value is not None for word in (option, value))
    request = WholeRequest(
        root, spec, planner, vqgan, policy, recipe.n_action_steps, action_set, seed, denoising_steps, sampler, words
    )
    with progress_bar("imagining", n_episodes) as advance:
        for line in generate_whole(request, out, n_episodes=n_episodes, ids=ids, progress=advance):
            print(line)
    look = ["vilp-data", "view", "--generated", generated_name(root, out), "--data", str(root)]
    print(f"in {out}; look at them with `{shlex.join(look)}`")
