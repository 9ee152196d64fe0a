"""`vilp-data actions`: which episodes give action labels."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vilp_data.action_set_lock import DIGITS, ActionSetLock
from vilp_data.cli.options import DatasetArgument, JsonOption, PresetOption, open_dataset, print_json
from vilp_data.errors import number_of
from vilp_data.task_toml import load_task


def actions(
    dataset: DatasetArgument = None,
    recipe: Annotated[
        str | None,
        typer.Option(
            help="small, hybrid, off_target, or a path to a recipe TOML. Default: list the sets there are, and prove each again.",
            show_default=False,
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option("--data", help="The dataset folder again, as the other tool has it.", show_default=False),
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(help="Whose recipes are meant by name. Default: the dataset's task.", show_default=False),
    ] = None,
    preset: PresetOption = None,
    redraw: Annotated[
        bool, typer.Option(help="Forget the set that is locked and choose anew; models trained on it no longer fit.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Lock an action set: which training episodes give action labels; all others give video only.

    The file action_sets/NAME.lock.json holds the exact episodes, the statistics of their actions, and a proof that none validates. It
    stays as it is when episodes are added, and is proved again whenever it is read.

    Example: vilp-data actions --recipe hybrid
    """
    from vilp_data.dataset_action_sets import load_recipe, lock_action_set, set_path

    root, spec = open_dataset(dataset or data)
    if recipe is None:
        _list_sets(root, as_json=as_json)
        return
    name, wanted = load_recipe(recipe, spec.name if task is None else load_task(task).name, preset=preset)
    given = recipe if preset is None else f"{recipe} --preset {preset}"
    lock = lock_action_set(root, name, wanted, given=given, redraw=redraw)
    if as_json:
        print(lock.to_json().decode())
        return
    print("\n".join([f"{set_path(root, name)}: {_counted(lock)}", *_details(lock)]))


def _list_sets(root: Path, *, as_json: bool) -> None:
    from vilp_data.dataset_action_sets import check_sets

    found = check_sets(root)
    if as_json:
        print_json(
            {
                name: {
                    "key": lock.key if lock else None,
                    "episodes": sorted(lock.episodes) if lock else [],
                    "wrong": list(map(str, wrong)),
                }
                for name, (lock, wrong) in found.items()
            }
        )
    elif not found:
        print(f"{root}: no action set yet; `vilp-data actions --recipe small` locks one")
    else:
        for name, (lock, wrong) in found.items():
            print(
                "\n".join(
                    [f"{name}: {_counted(lock) if lock else 'cannot be read'}", *(f"  {error}" for error in wrong)]
                )
            )
    if any(wrong for _, wrong in found.values()):
        raise typer.Exit(1)


def _counted(lock: ActionSetLock) -> str:
    sides = f"{len(lock.video_only)} video only, {len(lock.validation)} validation"
    give = "gives" if len(lock.episodes) == 1 else "give"
    return f"{number_of(len(lock.episodes), 'episode')} {give} labels, {sides} (key {lock.key[:DIGITS]})"


def _details(lock: ActionSetLock) -> list[str]:
    lines, n_steps = [], sum(source.n_steps for source in lock.sources)
    for source in lock.sources:
        share = f"{source.effective_epochs * source.n_steps / n_steps:.0%} of the samples drawn"
        epochs = f"{source.effective_epochs:.3g} effective epochs"
        tags = lock.recipe.source[source.name]
        lines.append(
            f"  {source.name} ({tags}): {number_of(len(source.episodes), 'episode')}, {source.n_steps} steps, {share}, {epochs}"
        )
    training = len(lock.episodes) + len(lock.video_only)
    if lock.recipe.video not in (None, training):
        lines.append(f"  the paper's video is {lock.recipe.video} episodes; here {training} train")
    return lines
