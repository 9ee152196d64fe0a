"""The verb check."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from vilp_data.cli.options import JsonOption, WorkersOption, console, open_dataset, print_json, progress_bar
from vilp_data.engine import cpu_count
from vilp_data.task_toml import load_task


def check(
    targets: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Logs, folders of logs, dataset folders. Default: the dataset, as for the other verbs.",
            show_default=False,
        ),
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(
            help="The task of the logs: it says which topics are actions and states. Default: guessed by their names.",
            show_default=False,
        ),
    ] = None,
    html: Annotated[Path | None, typer.Option(help="Write one self-contained page.", show_default=False)] = None,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Look for what is wrong with logs or a dataset: gaps, clocks, cameras, joints, actions a step off, copies.

    Exit code 1 where something is an error; warnings and notes alone leave it 0.

    Example: vilp-data check bags/ --html check.html
    """
    from vilp_data.check.findings import counts
    from vilp_data.check.page import require_place, write_page
    from vilp_data.check.sources import check_sources
    from vilp_data.check.text import format_report, json_report

    if html is not None:
        require_place(html)
    paths = targets or [open_dataset(None)[0]]
    spec = load_task(task) if task else None
    started = time.monotonic()
    with progress_bar("checking", None) as advance:
        report = check_sources(paths, spec=spec, workers=workers or cpu_count(), progress=advance)
    if as_json:
        print_json(json_report(report))
    else:
        print(format_report(report))
    if html is not None:  # after it: a full disk must not cost what was found
        write_page(html, report)
    console.print(
        f"checked in {time.monotonic() - started:.1f} s" + (f"; page: {html}" if html else ""), highlight=False
    )
    if counts(report.findings)["error"]:
        raise typer.Exit(1)
