"""What the verbs share: arguments, bars, JSON."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.locate import find_dataset, remember
from vilp_data.spec import PRESETS, TaskSpec

console = Console(stderr=True)

DatasetArgument = Annotated[
    Path | None,
    typer.Argument(
        help="Dataset folder. Default: the one you are in, else the last one used here, else the only one under data/.",
        show_default=False,
    ),
]
TaskOption = Annotated[
    str, typer.Option(help="A built-in task (hanoi, pusht, can, …: docs/tasks.md), or a path to a task TOML.")
]
PresetOption = Annotated[
    str | None, typer.Option(help=f"Overrides from the task's [presets]: {', '.join(PRESETS)}.", show_default=False)
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
WorkersOption = Annotated[int | None, typer.Option(help="Processes. Default: one a core.", show_default=False)]


def open_dataset(given: Path | None) -> tuple[Path, TaskSpec]:
    root = find_dataset(given)
    if given is None:
        console.print(f"dataset: {root}", highlight=False)
    remember(root)
    return root, EpisodeStore(root).spec()


def label_pairs(labels: list[str]) -> dict[str, str]:
    """KEY=VALUE texts as a mapping. Raises UsageError for another."""
    pairs = {}
    for label in labels:
        key, equals, value = label.partition("=")
        if not equals or not key.strip():
            raise UsageError("not a label", found=repr(label), remedy="--set KEY=VALUE, such as --set operator=anna")
        pairs[key.strip()] = value
    return pairs


def print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, sort_keys=True, default=str))


LINE_EVERY_S = 30.0
"""Seconds between two lines of progress where there is no terminal."""


class Advance(Protocol):
    """Moves a bar to `done`; `total` where it was not known before."""

    def __call__(self, done: int, total: int | None = None) -> None: ...


@contextmanager
def progress_bar(label: str, total: int | None) -> Iterator[Advance]:
    """A bar with count, rate and time left on a terminal; elsewhere a line now and then, so that a log shows that work goes on."""
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

        said = time.monotonic()

        def advance(done: int, total: int | None = None) -> None:
            nonlocal said
            if not console.is_terminal and time.monotonic() - said >= LINE_EVERY_S:
                said = time.monotonic()
                console.print(f"{label}: {done}" + (f" of {total}" if total else ""), highlight=False)
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
