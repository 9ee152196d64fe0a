"""The verb render."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from vilp_data.cli.options import JsonOption, WorkersOption, print_json, progress_bar
from vilp_data.engine import cpu_count


def render(
    demonstrations: Annotated[
        list[Path],
        typer.Argument(help="HDF5 files of robosuite or robomimic with simulator states.", show_default=False),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the logs.", show_default=False)],
    camera: Annotated[
        list[str] | None,
        typer.Option(help="A camera by robosuite's name, once or more. Default: agentview.", show_default=False),
    ] = None,
    height: Annotated[int, typer.Option(min=16, max=480, help="Rows of an image.")] = 96,
    width: Annotated[int, typer.Option(min=16, max=640, help="Columns of an image.")] = 96,
    rate: Annotated[
        float, typer.Option(min=1, help="States a second, where a file does not say (control_freq).")
    ] = 20.0,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw demonstrations that hold simulator states and no pictures into logs, one MCAP each.

    Example: vilp-data render demo.hdf5 -o logs --camera agentview --camera robot0_eye_in_hand
    """
    from vilp_data.sims.render_demos import RenderOptions, render_demonstrations

    options = RenderOptions(tuple(dict.fromkeys(camera or ("agentview",))), height, width, rate)
    with progress_bar("rendering", None) as advance:
        rendered = render_demonstrations(demonstrations, out, options, workers=workers or cpu_count(), progress=advance)
    if as_json:
        print_json([dataclasses.asdict(demo) for demo in rendered])
        return
    succeeded = sum(demo.success for demo in rendered)
    print(f"{out}: {len(rendered)} logs, {succeeded} end in success")
    for demo in rendered:
        print(f"  {demo.path.name}: {demo.n_steps} steps" + ("" if demo.success else ", not a success"))
