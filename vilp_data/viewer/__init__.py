"""Draw a log or an ingested episode with Rerun: cameras side by side on top, actions and joints plotted below, log time.

    draw = partial(draw_log, Path("episode.mcap"))
    present(draw, screenshot=Path("view.png"), say=print)

Everything is drawn into an .rrd file first; a window, a browser page and a picture are three ways to look at that file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from vilp_data.decode.numeric_fields import numeric_series
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import DecodeError, LogError, UsageError, VilpDataError, nearest, some_of
from vilp_data.latents import BATCH, FrameEncoder, read_latents, stale_reason
from vilp_data.plots import Plot, frame_psnr, panel_rank
from vilp_data.sources import MessageError, open_log
from vilp_data.spec import ActionSpec, TaskSpec, VectorSpec
from vilp_data.types import F16, F32, I32, I64, U8, Episode, LogEpisode, LogReader, Message
from vilp_data.vector_parts import vector_parts
from vilp_data.viewer.canvas import Canvas, Drawn, Picture, entity_of, title_of, writing
from vilp_data.viewer.images import LogImages
from vilp_data.viewer.window import present

__all__ = ["Drawn", "draw_episode", "draw_log", "present"]

ERROR_GAIN = 4  # error images are this much brighter than the error, to be seen at all

SHOWN_WHOLE = 8  # names of episodes that have all their files

Progress = Callable[[int], None]


class LeftOut:
    """What a log holds that could not be drawn, and why."""

    def __init__(self) -> None:
        self._topics: list[str] = []
        self._messages: dict[str, tuple[int, VilpDataError]] = {}  # topic -> how many, the first one's error

    def topic(self, name: str, error: VilpDataError) -> None:
        """A whole topic."""
        self._topics.append(f"{name}: left out, {_reason(error)}")

    def message(self, topic: str, error: VilpDataError) -> None:
        """One message of a topic."""
        count, first = self._messages.get(topic, (0, error))
        self._messages[topic] = count + 1, first

    def notes(self) -> tuple[str, ...]:
        """A line for each topic that anything was left out of."""
        counted = [
            f"{topic}: {count} message{'' if count == 1 else 's'} left out; the first: {_reason(error)}"
            for topic, (count, error) in self._messages.items()
        ]
        return (*self._topics, *counted)


def _reason(error: VilpDataError) -> str:
    return f"{error.what} ({error.found})" if error.found else error.what


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
    """Draw one demonstration of a log (unless named the first that has all its files) into `rrd`, written whole or not at all.

    Every image topic becomes a panel, every other topic its numbers. Recorded JPEG and PNG bytes go in as they are. With a
    `spec`, its action topics come first. `progress` is told messages as they are read. Topics and messages that cannot be read
    are left out and counted in the notes. Raises what opening and reading a log raise, UsageError for an unknown `episode`,
    LogError where there is nothing to draw, StoreError where `rrd` cannot be written."""
    with open_log(log_path, array_rate_hz=array_rate_hz) as log:
        chosen, notes = _choose(log, episode)
        left_out = LeftOut()
        with writing(rrd, start_ns=chosen.start_ns) as canvas:
            cameras, plots = _draw_messages(canvas, log, chosen, left_out, progress)
            if not cameras and not plots:
                found = "; ".join(["no images and no numbers", *left_out.notes()])
                raise LogError(
                    "nothing to draw", where=log_path, found=found, remedy="`vilp-data inspect` lists its topics"
                )
            commands = {part.topic for part in spec.action.values() if part.topic} if spec else set()
            canvas.plots(plot for panel in plots.values() for plot in panel.values())
            ranked = sorted(plots, key=lambda topic: (panel_rank(topic, commands), topic))
            pictures = [Picture(entity_of(topic), title_of(topic)) for topic in cameras]
            canvas.layout([pictures], [list(plots[topic].values()) for topic in ranked])
        middle = canvas.moment((chosen.start_ns + chosen.end_ns) // 2)
        return Drawn(rrd, canvas.id, middle, (*notes, *left_out.notes()))


def _choose(log: LogReader, name: str | None) -> tuple[LogEpisode, tuple[str, ...]]:
    episodes = {episode.name: episode for episode in log.episodes()}
    if not episodes:
        raise LogError("no messages in this log", where=log.path, remedy="`vilp-data inspect` shows what it holds")
    if name is not None and name not in episodes:
        raise UsageError(f"no episode {name!r} in this log", where=log.path, remedy=nearest(name, episodes))
    if len(episodes) == 1 or name is not None:
        return episodes[name or next(iter(episodes))], ()
    whole: list[str] | None = getattr(
        log, "whole", None
    )  # of formats that keep an episode's parts in files of their own
    chosen = episodes[(whole or list(episodes))[0]]
    counted = f"{len(episodes)} episodes"
    if whole is not None and len(whole) < len(episodes):
        counted += (
            f", of which {some_of(whole, SHOWN_WHOLE) or 'none'} {'has' if len(whole) == 1 else 'have'} all their files"
        )
    return chosen, (f"{log.path}: {counted}, showing {chosen.name}; --episode NAME shows another",)


def _draw_messages(
    canvas: Canvas, log: LogReader, chosen: LogEpisode, left_out: LeftOut, progress: Progress | None
) -> tuple[list[str], dict[str, dict[str, Plot]]]:
    """(image topics, topic -> group -> plot) of one demonstration; images go to the file as they come."""
    cameras: dict[str, None] = {}
    plots: dict[str, dict[str, Plot]] = {}
    names = {topic.name: topic.names for topic in log.topics()}
    images = LogImages(canvas)
    for message in _readable_messages(log, chosen, left_out):
        if progress is not None:
            progress(1)
        if not images.shows(message):
            _plot_message(plots.setdefault(message.topic, {}), message, names[message.topic])
            continue
        try:
            images.draw(message)
        except DecodeError as error:
            left_out.message(message.topic, error)
        else:
            cameras[message.topic] = None
    for topic, lost in images.end():
        left_out.message(topic, lost)
    return sorted(cameras), {topic: panel for topic, panel in plots.items() if panel}


def _readable_messages(log: LogReader, chosen: LogEpisode, left_out: LeftOut) -> Iterator[Message]:
    """The messages of every topic whose schema is understood, those left out that do not fit theirs."""
    readable: list[str] = []
    for topic in log.topics():
        try:
            log.messages([topic.name])  # refused here, before any message is read, where the schema is not understood
        except LogError as error:
            left_out.topic(topic.name, error)
        else:
            readable.append(topic.name)
    messages = iter(log.messages(readable, start_ns=chosen.start_ns, end_ns=chosen.end_ns))
    while True:
        try:
            yield next(messages)
        except StopIteration:
            return
        except MessageError as error:
            left_out.message(str(error.where).rpartition(", topic ")[2], error)


def _plot_message(panel: dict[str, Plot], message: Message, names: Sequence[str]) -> None:
    for group, values in numeric_series(message, names).items():
        if group not in panel:
            panel[group] = Plot(title_of(message.topic, group), entity_of(message.topic, group))
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
    with writing(rrd, start_ns=int(episode.log_time_ns[0])) as canvas:
        rows: list[list[Picture]] = []
        fidelity: list[Plot] = []
        for view, frames in episode.frames.items():
            shown, times = _first_shown(episode.source_index[view], episode.log_time_ns)
            canvas.frames(f"{view}/real", frames[shown], times)
            rows.append([Picture(f"{view}/real", f"{view}: real" if encoders else view)])
            encoder = (encoders or {}).get(view)
            if encoder is None:
                continue
            stale = stale_reason(store.root, entry, view, encoder.key)
            if stale is not None:
                notes.append(f"{view}: no reconstruction, its latents are {stale}; run `vilp-data latents`")
                continue
            rebuilt = _reconstruct(encoder, read_latents(store.root, entry, view, encoder.key), shown)
            fidelity.append(_draw_reconstruction(canvas, view, frames[shown], rebuilt, times))
            rows[-1].append(Picture(f"{view}/reconstructed", f"{view}: reconstructed"))
            rows[-1].append(Picture(f"{view}/error", f"{view}: error × {ERROR_GAIN}"))
        panels = [fidelity] if fidelity else []
        if episode.action is not None:
            panels += _vector_plots("action", episode, episode.action, spec.action)
        panels += _vector_plots("low_dim", episode, episode.low_dim, spec.low_dim)
        canvas.plots(plot for panel in panels for plot in panel)
        # Without reconstructions all views share one row; with them each view has its own.
        canvas.layout(rows if fidelity else [[row[0] for row in rows]], panels)
    return Drawn(rrd, canvas.id, canvas.moment(int(episode.log_time_ns[episode.n_steps // 2])), tuple(notes))


def _first_shown(source_index: I32, log_time_ns: I64) -> tuple[I64, I64]:
    """(frames [m], times [m]): each frame that some step observes, at the first step that does."""
    known = source_index >= 0
    frames, first = np.unique(source_index[known], return_index=True)
    return frames.astype(np.int64), log_time_ns[known][first]


def _reconstruct(encoder: FrameEncoder, latents: F16, rows: I64) -> U8:
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
    kind: str, episode: Episode, values: F32, parts: Mapping[str, ActionSpec | VectorSpec]
) -> list[list[Plot]]:
    """One panel for each part of a stored vector, so that metres and radians keep their own scales."""
    times = episode.log_time_ns.tolist()
    return [
        [Plot(title_of(kind, name), entity_of(kind, name), labels, times, columns.tolist())]
        for name, (labels, columns) in vector_parts(values, parts, episode.column_names.get(kind, {})).items()
    ]
