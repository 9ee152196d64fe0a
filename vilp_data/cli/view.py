"""The verb view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vilp_data.cli.options import open_dataset
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.latents import FrameEncoder, load_encoder
from vilp_data.locate import a_dataset, is_dataset
from vilp_data.spec import TaskSpec, load_task


def view(
    target: Annotated[str, typer.Argument(help="A log, or the id of an ingested episode.", show_default=False)],
    data: Annotated[
        Path | None,
        typer.Option(help="The dataset of an ingested episode. Default: as for the other verbs.", show_default=False),
    ] = None,
    episode: Annotated[
        str | None,
        typer.Option(
            help="Which demonstration of a log that holds many. Default: the first whole one.", show_default=False
        ),
    ] = None,
    run: Annotated[
        Path | None,
        typer.Option(help="The frame encoder to reconstruct with. Default: the only run there is.", show_default=False),
    ] = None,
    encoder: Annotated[
        str, typer.Option(help="Kind of frame encoder, as registered under vilp.frame_encoders.")
    ] = "vqgan",
    task: Annotated[
        str | None, typer.Option(help="The task of a log: its commands are plotted first.", show_default=False)
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve a page on 127.0.0.1 until Ctrl-C.")] = False,
    save: Annotated[Path | None, typer.Option(help="Write a Rerun recording (.rrd).", show_default=False)] = None,
    screenshot: Annotated[Path | None, typer.Option(help="Write a picture (.png).", show_default=False)] = None,
) -> None:
    """Show a log, or an ingested episode beside its reconstruction, in Rerun.

    Example: vilp-data view episode.mcap --screenshot v.png
    """
    from functools import partial

    from vilp_data.viewer import draw_episode, draw_log, present

    if is_dataset(Path(target)):
        raise a_dataset(Path(target))
    if Path(target).exists():
        named = load_task(task) if task else None
        rate_hz = named.rate_hz if named and named.rate_hz else 10.0
        draw = partial(draw_log, Path(target), episode=episode, spec=named, array_rate_hz=rate_hz)
    else:
        root, spec = _dataset_with(target, data)
        encoders = _encoders_of(root, spec, encoder, run)
        draw = partial(draw_episode, EpisodeStore(root), target, encoders=encoders)
    present(draw, web=web, save=save, screenshot=screenshot, say=print)


def _dataset_with(episode_id: str, data: Path | None) -> tuple[Path, TaskSpec]:
    """The dataset that holds this episode. UsageError where there is none, or the id is rather a path with a mistake in it."""
    try:
        root, spec = open_dataset(data)
        EpisodeStore(root).entry(episode_id)
    except UsageError as error:
        if data is None and (Path(episode_id).suffix or "/" in episode_id):
            remedy = "give a log's path, or the id of an ingested episode"
            raise UsageError("no such log", where=episode_id, remedy=remedy) from error
        raise
    return root, spec


def _encoders_of(root: Path, spec: TaskSpec, name: str, run: Path | None) -> dict[str, FrameEncoder]:
    """The encoders of the run that is named, else of the only one; none where there is none, or several."""
    from vilp_data.latent_runs import find_run

    if run is None and len(list((root / "runs").glob(f"{name}*"))) != 1:
        return {}
    folder = find_run(root, run, name)
    return {view: load_encoder(name, folder, view) for view in spec.views}
