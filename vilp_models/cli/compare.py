"""`vilp-models compare`."""

from __future__ import annotations

import contextlib
import sys
from typing import Annotated

import typer

from vilp_data.cli.options import JsonOption, PresetOption, print_json, progress_bar
from vilp_models.cli.options import DataOption, TaskOption, VqganOption, dataset_of


def compare(
    sets: Annotated[str, typer.Option(help="Action sets; all others are measured against the first.")] = "small,hybrid",
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    policies: Annotated[
        str, typer.Option(help="Which of vilp, oracle (true future frames) and bc.")
    ] = "vilp,oracle,bc",
    training_seeds: Annotated[
        int, typer.Option(min=1, help="How many models of each kind are trained on each set.")
    ] = 3,
    seeds: Annotated[
        str, typer.Option(help="Simulator's starts FIRST:END of vilp and bc; the oracle's are validation episodes.")
    ] = "0:50",
    episodes: Annotated[
        int | None,
        typer.Option(min=1, help="How many validation episodes the oracle gets. Default: all.", show_default=False),
    ] = None,
    envs: Annotated[int, typer.Option(min=1, help="Environments that are planned for together.")] = 50,
    vqgan: VqganOption = None,
    restart: Annotated[
        bool, typer.Option("--restart", help="Train anew what is there of another recipe or dataset; the rest is kept.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Train on several action sets with several seeds each, roll all out from the same starts, and report what the labels change.

    Goes on where it stopped; each choice of --seeds is a report of its own, of all policies that were rolled out from them. One planner
    serves all: it learns from video alone, and must be trained.

    Example: vilp-models compare --data data/pusht --preset cpu --sets small,hybrid --seeds 100000:100050
    """  # fmt: skip
    from vilp_models.compare_sets import SetsComparison, compare_sets

    root, spec = dataset_of(data, task, preset)
    comparison = SetsComparison(
        root, spec, preset, _names(sets), _names(policies), training_seeds, seeds, episodes, envs, vqgan, restart
    )
    with contextlib.redirect_stdout(sys.stderr):  # trainings tell what they do; stdout is the report's alone
        table, report = compare_sets(comparison, print, progress_bar)
    print_json(table) if as_json else print(
        "\n".join([*report.lines(), f"{comparison.folder}/report.md shows it in full"])
    )


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())
