"""The verb salvage."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vilp_data.cli.options import JsonOption, print_json


def salvage(
    log: Annotated[Path, typer.Argument(help="A damaged MCAP file, ROS 1 bag or db3 file.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="The clean MCAP to write.", show_default=False)],
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file that is there.")] = False,
    drop_suspicious: Annotated[
        bool, typer.Option("--drop-suspicious", help="Leave out messages over which a checksum fails.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Get back what a damaged log still holds, as a clean MCAP, and say what was lost. Ends with 0 only if nothing was.

    Example: vilp-data salvage crashed.mcap -o clean.mcap
    """
    from vilp_data.salvage import salvage_log
    from vilp_data.salvage_report import format_report

    report = salvage_log(log, out, force=force, drop_suspicious=drop_suspicious)
    print_json(report.as_dict()) if as_json else print(format_report(report))
    if not report.complete:
        raise typer.Exit(1)
