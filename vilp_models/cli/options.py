"""Options that several verbs share, and the dataset they mean."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.locate import default_root, find_dataset, is_dataset, remember
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task, task_names

DataOption = Annotated[
    Path | None, typer.Option("--data", help="Dataset folder. Default: data/TASK.", show_default=False)
]
TaskOption = Annotated[
    str | None,
    typer.Option(
        help="The dataset's task, whose recipes, [window] and [sim] to use. Default: as ingested; with --preset as built in.",
        show_default=False,
    ),
]
RunOption = Annotated[
    Path | None, typer.Option(help="Where the run lives. Default: DATA/runs/MODEL-PRESET.", show_default=False)
]
VqganOption = Annotated[
    Path | None,
    typer.Option(
        "--vqgan",
        help="The VQGAN run that made the latents. Default: that of --preset, else the only one.",
        show_default=False,
    ),
]
SetOption = Annotated[
    str | None,
    typer.Option(
        "--set",
        help="The action set (`vilp-data actions`) to learn from, or learnt from; its runs are MODEL-PRESET-SET. Default: none.",
        show_default=False,
    ),
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


def dataset_of(data: Path | None, task: str | None, preset: str | None) -> tuple[Path, TaskSpec]:
    """The dataset folder, and its spec; what decides nothing in ingested files (the window, the simulator, the models' tables)
    comes from the task's file of today where a task or a preset is named. A preset alone means the built-in task that the dataset was
    ingested with; a dataset of another task has no presets of its own but the models'.

    Raises UsageError where the dataset is none of `task`."""
    if data is None and task is not None:
        name = load_task(task).name
        data = next((root for root in (default_root(name, preset), default_root(name, None)) if is_dataset(root)), None)
    root = find_dataset(data)
    remember(root)
    print(f"dataset: {root}", file=sys.stderr)
    spec = EpisodeStore(root).spec()
    if task is None and preset is not None and spec.name in task_names():
        task = spec.name
    if task is None:
        return root, spec
    today = load_task(task, preset=preset)
    if today.name != spec.name:
        raise UsageError(
            "this dataset is of another task",
            where=root,
            found=f"ingested as {spec.name}, --task is {today.name}",
            remedy=f"name a dataset of {today.name} with --data, or leave --task out",
        )
    holds = {part: today.action[part].holds for part in spec.action if part in today.action}
    action = {name: part.model_copy(update={"holds": holds.get(name)}) for name, part in spec.action.items()}
    changed = {"action": action, "window": today.window, "sim": today.sim, "models": today.models}
    return root, spec.model_copy(update=changed)
