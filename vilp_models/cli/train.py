"""`vilp-models train MODEL`."""

from __future__ import annotations

from pathlib import Path

import typer

from vilp_data.cli.options import PresetOption
from vilp_data.episodes import EpisodeStore
from vilp_models.cli.options import (
    DataOption,
    RestartOption,
    RunOption,
    SetOption,
    TaskOption,
    VqganOption,
    dataset_of,
)
from vilp_models.runs import default_run, find_model_run

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Train a model on the training episodes of a dataset."
)


@app.command("vqgan")
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

    root, spec = dataset_of(data, task, preset)
    folder = run or default_run(root, "vqgan", preset)
    episodes = side_episodes(EpisodeStore(root), "train")
    recipe = vqgan_recipe(spec.models, preset=preset, where=spec.name)
    train(
        root,
        spec,
        recipe,
        folder,
        train_episodes=[entry.id for entry in episodes],
        split_hash=read_split(root).hash,
        restart=restart,
    )
    _say_where(folder)


@app.command("planner")
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
    from vilp_models.recipe import PlannerRecipe, load_recipe
    from vilp_models.train import train_planner as train

    root, spec = dataset_of(data, task, preset)
    recipe = load_recipe(PlannerRecipe, "planner", spec.models, preset=preset, where=spec.name)
    folder = run or default_run(root, "planner", preset)
    vqgan_run = find_model_run(root, "vqgan", given=vqgan, preset=preset, option="--vqgan")
    train(root, spec, recipe, folder, vqgan=vqgan_run, restart=restart)
    _say_where(folder)


@app.command("policy")
def train_policy(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: RunOption = None,
    vqgan: VqganOption = None,
    action_set: SetOption = None,
    restart: RestartOption = False,
) -> None:
    """Train the low-level policy, from two frames to the actions between; goes on where it stopped.

    A recipe that sees latents or reconstructions needs a VQGAN run; others do not.

    Example: vilp-models train policy --task pusht --preset cpu
    """
    from vilp_models.recipe import PolicyRecipe, load_recipe
    from vilp_models.train import train_policy as train

    root, spec = dataset_of(data, task, preset)
    recipe = load_recipe(PolicyRecipe, "policy", spec.models, preset=preset, where=spec.name)
    folder = run or default_run(root, "policy", preset, action_set)
    vqgan_run = None
    if recipe.sees == "latents" or recipe.reconstructed_share > 0:
        vqgan_run = find_model_run(root, "vqgan", given=vqgan, preset=preset, option="--vqgan")
    train(root, spec, recipe, folder, vqgan=vqgan_run, action_set=action_set, restart=restart)
    _say_where(folder)


@app.command("bc")
def train_bc(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: RunOption = None,
    action_set: SetOption = None,
    restart: RestartOption = False,
) -> None:
    """Train behaviour cloning, one observation to the next n_action_steps actions: a baseline; goes on where it stopped.

    Example: vilp-models train bc --task pusht --preset cpu
    """
    from vilp_models.recipe import BcRecipe, VilpRecipe, load_recipe
    from vilp_models.train import train_bc as train

    root, spec = dataset_of(data, task, preset)
    recipe = load_recipe(BcRecipe, "bc", spec.models, preset=preset, where=spec.name)
    vilp = load_recipe(VilpRecipe, "vilp", spec.models, preset=preset, where=spec.name)
    folder = run or default_run(root, "bc", preset, action_set)
    train(root, spec, recipe, folder, n_action_steps=vilp.n_action_steps, action_set=action_set, restart=restart)
    _say_where(folder)


def _say_where(folder: Path) -> None:
    print(f"the run: {folder}")
