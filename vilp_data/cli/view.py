"""The verb view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vilp_data.cli.options import open_dataset, progress_bar
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, number_of
from vilp_data.latents import FrameEncoder, load_encoder
from vilp_data.locate import is_dataset
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task


def view(
    target: Annotated[
        str | None,
        typer.Argument(
            help="A log, the id of an ingested episode, or with --html a dataset folder; with --generated the id of a generated one."
            " Default: the first of these.",
            show_default=False,
        ),
    ] = None,
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
        typer.Option(
            help="The frame encoder to reconstruct with; of a dataset's page, whose fidelity to show. Default: the only run there is.",
            show_default=False,
        ),
    ] = None,
    encoder: Annotated[
        str, typer.Option(help="Kind of frame encoder, as registered under vilp.frame_encoders.")
    ] = "vqgan",
    task: Annotated[
        str | None, typer.Option(help="The task of a log: its commands are plotted first.", show_default=False)
    ] = None,
    generated: Annotated[
        str | None,
        typer.Option(
            help="Show what VILP imagined along an episode: a folder of DATA/generated, by `vilp-models generate --whole`.",
            show_default=False,
        ),
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve a page on 127.0.0.1 until Ctrl-C.")] = False,
    save: Annotated[Path | None, typer.Option(help="Write a Rerun recording (.rrd).", show_default=False)] = None,
    screenshot: Annotated[Path | None, typer.Option(help="Write a picture (.png).", show_default=False)] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            help="Write one self-contained page: of a dataset, its episodes to look through; with --generated, playable clips.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Show a log, or an ingested episode beside its reconstruction, or what was imagined beside what happened, in Rerun; or a whole
    dataset as a page.

    Example: vilp-data view episode.mcap --screenshot v.png
    """
    from functools import partial

    from vilp_data.viewer import draw_episode, draw_log, present

    if generated is not None:
        _view_generated(generated, target, data, web=web, save=save, screenshot=screenshot, html=html)
        return
    dataset = _dataset_named(target, data, html)
    if dataset is not None:
        _view_dataset(dataset, run, html, in_rerun=web or save is not None or screenshot is not None)
        return
    if html is not None:
        remedy = (
            "name a dataset folder, or with --generated what was imagined; --web and --save show a log or an episode"
        )
        raise UsageError("--html is a page of a dataset, or of what was imagined", where=target, remedy=remedy)
    if target is None:
        remedy = "give a log, the id of an ingested episode, a dataset with --html PAGE.html, or --generated RUN"
        raise UsageError("nothing was named to look at", remedy=remedy)
    if Path(target).exists():
        named = load_task(task) if task else None
        rate_hz = named.rate_hz if named and named.rate_hz else 10.0
        draw = partial(draw_log, Path(target), episode=episode, spec=named, array_rate_hz=rate_hz)
    else:
        root, spec = _dataset_with(target, data)
        encoders = _encoders_of(root, spec, encoder, run)
        draw = partial(draw_episode, EpisodeStore(root), target, encoders=encoders)
    present(draw, web=web, save=save, screenshot=screenshot, say=print)


def _dataset_named(target: str | None, data: Path | None, html: Path | None) -> Path | None:
    """The dataset whose page is asked for: the target where it is a dataset folder, and without a target the one of the other verbs."""
    if target is not None:
        return Path(target) if is_dataset(Path(target)) else None
    return open_dataset(data)[0] if html is not None else None


def _view_dataset(root: Path, run: Path | None, html: Path | None, *, in_rerun: bool) -> None:
    from vilp_data.check.page import require_place
    from vilp_data.latent_runs import find_run
    from vilp_data.viewer.dataset_facts import dataset_facts
    from vilp_data.viewer.dataset_page import write_dataset_page

    if html is None or in_rerun:
        remedy = f"`vilp-data view {root} --html PAGE.html`; for one episode in Rerun `vilp-data view ID --data {root}`"
        raise UsageError(
            "a dataset is shown as a page; --web, --save and --screenshot show one episode", where=root, remedy=remedy
        )
    require_place(html)
    if run is not None:
        run = find_run(root, run, "vqgan")
    with progress_bar("checking", None):
        facts = dataset_facts(root, run=run)
    with progress_bar("drawing", len(facts.entries)) as advance:
        form = write_dataset_page(html, facts, progress=advance)
    told = (
        f"{number_of(len(facts.entries), 'episode')}, up to {form.n_frames} frames of each view"
        if facts.entries
        else "no episodes"
    )
    print(f"wrote {html} ({html.stat().st_size / 1e6:.1f} MB): {told}; it opens in any browser")


def _view_generated(
    run: str,
    episode_id: str | None,
    data: Path | None,
    *,
    web: bool,
    save: Path | None,
    screenshot: Path | None,
    html: Path | None,
) -> None:
    from functools import partial

    from vilp_data.generated_episode import find_generated, generated_ids, open_generated_episode
    from vilp_data.viewer import present
    from vilp_data.viewer.generated import draw_generated
    from vilp_data.viewer.generated_page import write_generated_page

    root, _ = open_dataset(data)
    store, folder = EpisodeStore(root), find_generated(root, run)
    ids = generated_ids(folder)
    if episode_id is None and len(ids) > 1:
        print(f"{folder}: {number_of(len(ids), 'episode')}, showing {ids[0]}; name another to see it")
    opened = open_generated_episode(store, folder, episode_id or ids[0])
    if html is not None:
        write_generated_page(html, store, opened)
        print(f"wrote {html} ({html.stat().st_size / 1e6:.1f} MB); it opens in any browser")
    if html is None or web or save or screenshot:
        draw = partial(draw_generated, store, opened)
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
