"""Draw a log or an ingested episode with Rerun: cameras side by side on top, actions and joints plotted below, log time.

    draw = partial(draw_log, Path("episode.mcap"))
    present(draw, screenshot=Path("view.png"), say=print)

Everything is drawn into an .rrd file first; a window, a browser page and a picture are three ways to look at that file.
"""

from __future__ import annotations

import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
from rerun.experimental import ViewerClient

from vilp_data import shards
from vilp_data.decode import decode_image, encoded_image, is_image
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import LogError, StoreError, UsageError, nearest
from vilp_data.latents import BATCH, FrameEncoder, latents_path, stale_reason
from vilp_data.numeric_fields import numeric_series
from vilp_data.plots import Plot, frame_psnr, panel_rank, vector_parts
from vilp_data.sources import open_log
from vilp_data.spec import ActionSpec, TaskSpec, VectorSpec
from vilp_data.types import F32, I32, I64, U8, LogEpisode, LogReader, Message
from vilp_data.viewer_process import (
    LOCALHOST,
    POLL_S,
    WINDOW_SIZE,
    ViewerProcess,
    free_port,
    require_display,
    rerun,
    wait_for_port,
)

APPLICATION = "vilp"
TIMELINE = "log_time"
WALL_CLOCK_NS = 946_684_800 * 10**9  # the year 2000: earlier stamps are shown as durations, not as dates
FLUSH_BYTES = 8 << 20  # image bytes held back before they go to the file
ERROR_GAIN = 4  # error images are this much brighter than the error, to be seen at all
MAX_LEGEND = 9  # a longer legend would cover its plot
MAX_PANELS = 4  # plots side by side; the rest are tabs of the last
MAX_TABS = 8
TIMEOUT_S = 60.0
SETTLE_S = 1.0  # the picture must not change for this long
LINE_WIDTH = 1.5
COLOURS = np.array(
    [
        *([255, 107, 107], [79, 195, 108], [91, 157, 255], [255, 200, 87], [197, 139, 255]),
        *([77, 216, 216], [255, 159, 90], [245, 143, 198], [181, 192, 106], [191, 199, 213]),
    ],
    np.uint8,
)

Moment = dict[str, np.datetime64 | np.timedelta64]
Say = Callable[[str], None]
Progress = Callable[[int], None]


@dataclass(frozen=True)
class Drawn:
    """A drawing on disk. `middle` is the moment that a picture shows; `notes` say what was left out or chosen."""

    rrd: Path
    recording_id: str
    middle: Moment
    notes: tuple[str, ...] = ()


Draw = Callable[[Path], Drawn]


# --- drawing a log ----------------------------------------------------------------------------------------------------


def draw_log(
    log_path: Path,
    rrd: Path,
    *,
    episode: str | None = None,
    spec: TaskSpec | None = None,
    array_rate_hz: float = 10.0,
    progress: Progress | None = None,
) -> Drawn:
    """Draw one demonstration of a log (the first unless named) into `rrd`, written whole or not at all.

    Every image topic becomes a panel, every other topic its numbers. Recorded JPEG and PNG bytes go in as they are. With a
    `spec`, its action topics come first. `progress` is told messages as they are read. Raises what reading and decoding raise,
    UsageError for an unknown `episode`, LogError where there is nothing to draw."""
    with open_log(log_path, array_rate_hz=array_rate_hz) as log:
        chosen, notes = _choose(log, episode)
        with _writing(rrd, wall_clock=chosen.start_ns >= WALL_CLOCK_NS) as canvas:
            cameras, plots = _draw_messages(canvas, log, chosen, progress)
            if not cameras and not plots:
                remedy = "`vilp-data inspect` lists its topics"
                raise LogError("nothing to draw", where=log_path, found="no images and no numbers", remedy=remedy)
            commands = {part.topic for part in spec.action.values() if part.topic} if spec else set()
            canvas.plots(plot for panel in plots.values() for plot in panel.values())
            ranked = sorted(plots, key=lambda topic: (panel_rank(topic, commands), topic))
            views = [rrb.Spatial2DView(origin=_entity(topic), name=_title(topic)) for topic in cameras]
            canvas.layout([rrb.Horizontal(*views)] if views else [], [list(plots[topic].values()) for topic in ranked])
        return Drawn(rrd, canvas.id, canvas.moment((chosen.start_ns + chosen.end_ns) // 2), notes)


def _choose(log: LogReader, name: str | None) -> tuple[LogEpisode, tuple[str, ...]]:
    episodes = {episode.name: episode for episode in log.episodes()}
    if not episodes:
        raise LogError("no messages in this log", where=log.path, remedy="`vilp-data inspect` shows what it holds")
    if name is not None and name not in episodes:
        raise UsageError(f"no episode {name!r} in this log", where=log.path, remedy=nearest(name, episodes))
    chosen = episodes[name] if name is not None else next(iter(episodes.values()))
    if len(episodes) == 1 or name is not None:
        return chosen, ()
    return chosen, (f"{log.path}: {len(episodes)} episodes, showing {chosen.name}; --episode NAME shows another",)


def _draw_messages(
    canvas: Canvas, log: LogReader, chosen: LogEpisode, progress: Progress | None
) -> tuple[list[str], dict[str, dict[str, Plot]]]:
    """(image topics, topic -> group -> plot) of one demonstration; images go to the file as they come."""
    cameras: dict[str, None] = {}
    plots: dict[str, dict[str, Plot]] = {}
    topics = [topic.name for topic in log.topics()]
    for message in log.messages(topics, start_ns=chosen.start_ns, end_ns=chosen.end_ns):
        if is_image(message):
            cameras[message.topic] = None
            canvas.message_image(message)
        else:
            _plot_message(plots.setdefault(message.topic, {}), message)
        if progress is not None:
            progress(1)
    return sorted(cameras), {topic: panel for topic, panel in plots.items() if panel}


def _plot_message(panel: dict[str, Plot], message: Message) -> None:
    for group, values in numeric_series(message).items():
        if group not in panel:
            panel[group] = Plot(_title(message.topic, group), _entity(message.topic, group))
        panel[group].add(message.log_time_ns, values)


# --- drawing an ingested episode --------------------------------------------------------------------------------------


def draw_episode(
    store: EpisodeStore, episode_id: str, rrd: Path, *, encoders: Mapping[str, FrameEncoder] | None = None
) -> Drawn:
    """Draw an ingested episode into `rrd`: the stored frames of every view, actions and low_dim on the control clock.

    For each view in `encoders` whose latents are stored and fresh: the real frame beside the reconstructed one, their absolute
    difference (brightened ERROR_GAIN times) and the PSNR of each frame in dB. Raises UsageError for an unknown id, StoreError for
    damage."""
    entry, episode, spec = store.entry(episode_id), store.read(episode_id), store.spec()
    notes: list[str] = []
    with _writing(rrd, wall_clock=int(episode.log_time_ns[0]) >= WALL_CLOCK_NS) as canvas:
        rows: list[list[Any]] = []
        fidelity: list[Plot] = []
        for view, frames in episode.frames.items():
            shown, times = _first_shown(episode.source_index[view], episode.log_time_ns)
            canvas.frames(f"{view}/real", frames[shown], times)
            rows.append([rrb.Spatial2DView(origin=f"{view}/real", name=f"{view}: real" if encoders else view)])
            encoder = (encoders or {}).get(view)
            if encoder is None:
                continue
            stale = stale_reason(store.root, entry, view, encoder.key)
            if stale is not None:
                notes.append(f"{view}: no reconstruction, its latents are {stale}; run `vilp-data latents`")
                continue
            rebuilt = _reconstruct(encoder, latents_path(store.root, view, encoder.key, episode_id), shown)
            fidelity.append(_draw_reconstruction(canvas, view, frames[shown], rebuilt, times))
            rows[-1].append(rrb.Spatial2DView(origin=f"{view}/reconstructed", name=f"{view}: reconstructed"))
            rows[-1].append(rrb.Spatial2DView(origin=f"{view}/error", name=f"{view}: error × {ERROR_GAIN}"))
        panels = [fidelity] if fidelity else []
        if episode.action is not None:
            panels += _vector_plots("action", episode.action, spec.action, episode.log_time_ns)
        panels += _vector_plots("low_dim", episode.low_dim, spec.low_dim, episode.log_time_ns)
        canvas.plots(plot for panel in panels for plot in panel)
        # Without reconstructions all views share one row; with them each view has its own.
        pictures = [rrb.Horizontal(*row) for row in rows] if fidelity else [rrb.Horizontal(*(row[0] for row in rows))]
        canvas.layout(pictures, panels)
    return Drawn(rrd, canvas.id, canvas.moment(int(episode.log_time_ns[episode.n_steps // 2])), tuple(notes))


def _first_shown(source_index: I32, log_time_ns: I64) -> tuple[I64, I64]:
    """(frames [m], times [m]): each frame that some step observes, at the first step that does."""
    known = source_index >= 0
    frames, first = np.unique(source_index[known], return_index=True)
    return frames.astype(np.int64), log_time_ns[known][first]


def _reconstruct(encoder: FrameEncoder, path: Path, rows: I64) -> U8:
    latents = shards.read_shard(path).arrays["latents"]
    if rows.size and int(rows[-1]) >= len(latents):
        raise StoreError(
            "fewer latents than frames", where=path, found=f"{len(latents)}", remedy="run `vilp-data latents` again"
        )
    batches = [encoder.decode(latents[rows[start : start + BATCH]]) for start in range(0, len(rows), BATCH)]
    return np.concatenate(batches)


def _draw_reconstruction(canvas: Canvas, view: str, real: U8, rebuilt: U8, times: I64) -> Plot:
    difference = np.abs(real.astype(np.int16) - rebuilt)
    canvas.frames(f"{view}/reconstructed", rebuilt, times)
    canvas.frames(f"{view}/error", np.minimum(difference * ERROR_GAIN, 255).astype(np.uint8), times)
    plot = Plot(f"{view}: PSNR in dB", f"{view}/psnr")
    for time_ns, psnr in zip(times.tolist(), frame_psnr(real, rebuilt).tolist(), strict=True):
        plot.add(time_ns, {"PSNR": psnr})
    return plot


def _vector_plots(
    kind: str, values: F32, parts: Mapping[str, ActionSpec | VectorSpec], log_time_ns: I64
) -> list[list[Plot]]:
    """One panel for each part of a stored vector, so that metres and radians keep their own scales."""
    times = log_time_ns.tolist()
    return [
        [Plot(_title(kind, name), _entity(kind, name), labels, times, columns.tolist())]
        for name, (labels, columns) in vector_parts(values, parts).items()
    ]


# --- the file ---------------------------------------------------------------------------------------------------------


class Canvas:
    """An .rrd file being written. Times are nanoseconds; images are RGB, top row first."""

    def __init__(self, path: Path, *, wall_clock: bool) -> None:
        self.id = uuid.uuid4().hex
        self._recording = rr.RecordingStream(APPLICATION, recording_id=self.id, send_properties=False)
        self._recording.save(str(path))
        self._wall_clock = wall_clock
        self._held: dict[str, list[tuple[int, bytes, str]]] = {}
        self._held_bytes = 0

    def moment(self, time_ns: int) -> Moment:
        """How Rerun's calls are told a time: a date on a wall clock, else a duration since zero."""
        if self._wall_clock:
            return {"timestamp": np.datetime64(time_ns, "ns")}
        return {"duration": np.timedelta64(time_ns, "ns")}

    def message_image(self, message: Message) -> None:
        """One image message: its own bytes where a viewer can read those, else its pixels."""
        encoded, entity = encoded_image(message), _entity(message.topic)
        if encoded is None:
            self.frames(entity, decode_image(message)[None], np.array([message.log_time_ns]))
            return
        self._held.setdefault(entity, []).append((message.log_time_ns, *encoded))
        self._held_bytes += len(encoded[0])
        if self._held_bytes > FLUSH_BYTES:
            self._send_held()

    def frames(self, entity: str, frames: U8, times_ns: I64) -> None:
        """uint8 [n,H,W,3] at int64 [n]."""
        _, height, width, _ = frames.shape
        form = rr.components.ImageFormat(height=height, width=width, color_model="RGB", channel_datatype="U8")
        self._recording.log(entity, rr.Image.from_fields(format=form), static=True)
        columns = rr.Image.columns(buffer=frames.reshape(len(frames), -1))
        self._recording.send_columns(entity, indexes=[self._index(times_ns)], columns=columns)

    def plots(self, plots: Iterator[Plot]) -> None:
        for plot in plots:
            colours = COLOURS[np.arange(len(plot.names)) % len(COLOURS)]
            lines = rr.SeriesLines(names=plot.names, colors=colours, widths=LINE_WIDTH)
            self._recording.log(plot.entity, lines, static=True)
            times = self._index(np.array(plot.times_ns, np.int64))
            columns = rr.Scalars.columns(scalars=plot.table())
            self._recording.send_columns(plot.entity, indexes=[times], columns=columns)

    def layout(self, pictures: Sequence[Any], panels: Sequence[list[Plot]]) -> None:
        """Rows of pictures over one row of plots, a panel's plots behind tabs; nothing else takes room."""
        last = [plot for panel in panels[MAX_PANELS - 1 :] for plot in panel]
        shown = [*panels[: MAX_PANELS - 1], *([last] if last else [])]
        axis = self._whole_time([time_ns for panel in panels for plot in panel for time_ns in plot.times_ns])
        columns = [_panel(panel, axis) for panel in shown]
        rows = [*pictures, *([rrb.Horizontal(*columns)] if columns else [])]
        shares = [3.0] * len(pictures) + [2.0 if len(pictures) == 1 else 3.0] * (len(rows) - len(pictures))
        blueprint = rrb.Blueprint(
            rrb.Vertical(*rows, row_shares=shares),
            rrb.TopPanel(state="collapsed"),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
            auto_views=False,
            auto_layout=False,
        )
        self._recording.send_blueprint(blueprint)

    def close(self) -> None:
        self._send_held()
        self._recording.flush()
        self._recording.disconnect()

    def _send_held(self) -> None:
        for entity, images in self._held.items():
            times = self._index(np.array([image[0] for image in images], np.int64))
            columns = rr.EncodedImage.columns(blob=[i[1] for i in images], media_type=[i[2] for i in images])
            self._recording.send_columns(entity, indexes=[times], columns=columns)
        self._held.clear()
        self._held_bytes = 0

    def _whole_time(self, times_ns: list[int]) -> rrb.TimeAxis | None:
        """A time axis over all that was drawn, the same for all plots."""
        if not times_ns:
            return None
        ends = [rrb.TimeRangeBoundary.absolute(nanos=time_ns) for time_ns in (min(times_ns), max(times_ns))]
        return rrb.TimeAxis(view_range=rrb.TimeRange(start=ends[0], end=ends[1]))

    def _index(self, times_ns: npt.NDArray[Any]) -> rr.TimeColumn:
        if self._wall_clock:
            return rr.TimeColumn(TIMELINE, timestamp=times_ns.astype("datetime64[ns]"))
        return rr.TimeColumn(TIMELINE, duration=times_ns.astype("timedelta64[ns]"))


@contextmanager
def _writing(rrd: Path, *, wall_clock: bool) -> Iterator[Canvas]:
    """A canvas whose file appears under its name only once it is whole."""
    if not rrd.parent.is_dir():
        raise UsageError("no such folder", where=rrd.parent, remedy="make it, or save somewhere else")
    temporary = rrd.with_name(f".{rrd.name}.{uuid.uuid4().hex}.tmp")
    try:
        canvas = Canvas(temporary, wall_clock=wall_clock)
        try:
            yield canvas
        finally:
            canvas.close()
        temporary.replace(rrd)
    finally:
        temporary.unlink(missing_ok=True)


def _entity(topic: str, group: str = "") -> str:
    parts = [part for part in topic.split("/") if part] + [part for part in group.split(".") if part]
    return str(rr.new_entity_path(parts))


def _title(topic: str, group: str = "") -> str:
    """Short, and enough to tell panels apart: the topic, and the last word of the group."""
    last = group.rpartition(".")[2]
    return f"{topic.strip('/')} {last}".strip()


def _panel(plots: Sequence[Plot], axis: rrb.TimeAxis | None) -> Any:
    views = [
        rrb.TimeSeriesView(
            origin=plot.entity,
            contents=f"{plot.entity}",
            name=plot.title,
            axis_x=axis,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=1 < len(plot.names) <= MAX_LEGEND),
        )
        for plot in plots[:MAX_TABS]
    ]
    return views[0] if len(views) == 1 else rrb.Tabs(*views)


# --- looking at it ----------------------------------------------------------------------------------------------------


def present(
    draw: Draw, *, web: bool = False, save: Path | None = None, screenshot: Path | None = None, say: Say | None = None
) -> None:
    """Draw, and do what was asked: save the file, take a picture, serve a page until Ctrl-C; with nothing asked, open a window.

    Raises UsageError at once where a window is wanted and there is no display."""
    tell: Say = say or (lambda line: None)
    if not (web or save or screenshot):
        require_display()
    with tempfile.TemporaryDirectory(prefix="vilp-view-") as folder:
        drawn = draw(save or Path(folder) / "view.rrd")
        for note in drawn.notes:
            tell(note)
        if save:
            tell(f"saved {save} ({save.stat().st_size / 1e6:.1f} MB); open it with `rerun {save}`")
        if screenshot:
            take_screenshot(drawn, screenshot)
            tell(f"wrote {screenshot}")
        if web:
            serve_web(drawn, on_url=lambda url: tell(f"{url}\nCtrl-C ends it"))
        if not (web or save or screenshot):
            open_window(drawn)


def open_window(drawn: Drawn) -> None:
    """Show the drawing in a native window; returns when that is closed. Raises UsageError without a display."""
    require_display()
    arguments = [str(drawn.rrd), "--bind", LOCALHOST, "--port", str(free_port()), "--hide-welcome-screen"]
    with rerun(arguments) as viewer:
        try:
            code = viewer.process.wait()
        except KeyboardInterrupt:
            return
        if code != 0:
            viewer.check_alive()


def serve_web(
    drawn: Drawn, *, on_url: Say, web_port: int = 9090, data_port: int = 9876, timeout_s: float = TIMEOUT_S
) -> None:
    """Serve the drawing to browsers of this machine until Ctrl-C; `on_url` is told the address once it answers.

    The ports are wishes: a taken one is replaced by a free one, since a viewer that is there already would take the data."""
    web_port, data_port = free_port(web_port), free_port(data_port)
    data = quote(f"rerun+http://{LOCALHOST}:{data_port}/proxy", safe="")
    arguments = [str(drawn.rrd), "--serve-web", "--bind", LOCALHOST, "--port", str(data_port)]
    arguments += ["--web-viewer-port", str(web_port), "--server-memory-limit", "75%"]
    with rerun(arguments) as viewer:
        try:
            wait_for_port(viewer, web_port, timeout_s)
            on_url(f"http://{LOCALHOST}:{web_port}/?url={data}&renderer=webgl")
            viewer.process.wait()
            viewer.check_alive()
        except KeyboardInterrupt:
            return


def take_screenshot(drawn: Drawn, png: Path, *, timeout_s: float = TIMEOUT_S) -> None:
    """Write a picture of the drawing at its middle moment, without any display. Raises ViewerError with the package to install
    where there is no graphics driver, or when `timeout_s` is over; nothing is written then."""
    if not png.parent.is_dir():
        raise UsageError("no such folder", where=png.parent, remedy="make it, or save somewhere else")
    deadline = time.monotonic() + timeout_s
    port = free_port()
    arguments = [str(drawn.rrd.resolve()), "--headless", "--bind", LOCALHOST, "--port", str(port)]
    arguments += ["--hide-welcome-screen", "--window-size", WINDOW_SIZE]
    with rerun(arguments) as viewer:
        wait_for_port(viewer, port, timeout_s)
        client = ViewerClient.connect(f"rerun+http://{LOCALHOST}:{port}/proxy")
        _wait_until_loaded(viewer, client, drawn.recording_id, deadline)
        client.set_time(TIMELINE, play_state="paused", **drawn.middle)
        shards.write_atomic(png, _settled_picture(viewer, client, deadline))


def _wait_until_loaded(viewer: ViewerProcess, client: ViewerClient, recording_id: str, deadline: float) -> None:
    while time.monotonic() < deadline:
        viewer.check_alive()
        try:
            state = client.get_state()
        except (ConnectionError, RuntimeError):  # the port answers a little before the viewer does
            time.sleep(POLL_S)
            continue
        ours = [known for known in state.recordings if known.store_id.endswith(f":{recording_id}")]
        if ours and ours[0].timelines and not state.loading:
            return
        time.sleep(POLL_S)
    raise viewer.failure("the viewer did not load the drawing in time")


def _settled_picture(viewer: ViewerProcess, client: ViewerClient, deadline: float) -> bytes:
    """PNG bytes once the picture no longer changes: images are decoded, and panels drawn, some frames after they are asked for."""
    latest, since = b"", time.monotonic()
    while time.monotonic() < deadline:
        viewer.check_alive()
        picture: bytes = client.take_screenshot()
        if picture != latest:
            latest, since = picture, time.monotonic()
        elif time.monotonic() - since >= SETTLE_S:
            return picture
        time.sleep(POLL_S)
    raise viewer.failure("the viewer's picture did not settle in time")
