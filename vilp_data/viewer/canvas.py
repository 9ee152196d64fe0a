"""A drawing on disk: images, plots and their layout written into a Rerun recording (.rrd)."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from vilp_data import shards
from vilp_data.decode import is_wall_clock
from vilp_data.errors import StoreError, UsageError
from vilp_data.plots import Plot
from vilp_data.types import F64, I64, U8
from vilp_data.viewer.rrd_pieces import RrdPieces

APPLICATION = "vilp"
TIMELINE = "log_time"
FLUSH_BYTES = 8 << 20  # image bytes held back before they are sent together
SPILL_BYTES = 32 << 20  # image bytes kept in memory before they go to a file
MAX_LEGEND = 9  # a longer legend would cover its plot
MAX_PANELS = 4  # plots side by side; the rest are tabs of the last
MAX_TABS = 8
LINE_WIDTH = 1.5
FAINT = 0.5  # of a line's brightness, where another of its colour matters more
MARK = (235, 235, 235)
MARK_SIZE = 2.5
COLOURS = np.array(
    [
        *([255, 107, 107], [79, 195, 108], [91, 157, 255], [255, 200, 87], [197, 139, 255]),
        *([77, 216, 216], [255, 159, 90], [245, 143, 198], [181, 192, 106], [191, 199, 213]),
    ],
    np.uint8,
)

Moment = dict[str, np.datetime64 | np.timedelta64]


class Picture(NamedTuple):
    """A panel that shows the images at an entity."""

    entity: str
    title: str


@dataclass(frozen=True)
class Drawn:
    """A drawing on disk. `middle` is the moment that a picture shows; `notes` say what was left out or chosen."""

    rrd: Path
    recording_id: str
    middle: Moment
    notes: tuple[str, ...] = ()


class Canvas:
    """An .rrd file in the making. Times are nanoseconds; images are RGB, top row first.

    On a wall clock times are shown as dates; any other is counted from `start_ns`. Images beyond SPILL_BYTES wait in a file without a
    name in `folder`."""

    def __init__(self, *, start_ns: int, folder: Path) -> None:
        self.id = uuid.uuid4().hex
        self._recording = rr.RecordingStream(APPLICATION, recording_id=self.id, send_properties=False)
        # Into memory, not to a file: Rerun's own file sink may hang on a full disk.
        self._stream = self._recording.binary_stream()
        self._wall_clock = is_wall_clock(start_ns)
        self._zero_ns = 0 if self._wall_clock else start_ns
        self._held: dict[str, list[tuple[int, bytes, str]]] = {}
        self._held_bytes = 0
        self._sent_bytes = 0
        self._pieces = RrdPieces(folder)

    def moment(self, time_ns: int) -> Moment:
        """How Rerun's calls are told a time: a date on a wall clock, else how long after the start."""
        if self._wall_clock:
            return {"timestamp": np.datetime64(time_ns, "ns")}
        return {"duration": np.timedelta64(time_ns - self._zero_ns, "ns")}

    def encoded_image(self, entity: str, time_ns: int, data: bytes, media_type: str) -> None:
        """One image as a file's bytes, `image/jpeg` or `image/png`."""
        self._held.setdefault(entity, []).append((time_ns, data, media_type))
        self._held_bytes += len(data)
        if self._held_bytes > FLUSH_BYTES:
            self._send_held()

    def depth_image(self, entity: str, time_ns: int, png: bytes, units_a_metre: float) -> None:
        """One image of distances, as a PNG of 16 bits, so many of whose units make a metre."""
        self._recording.set_time(TIMELINE, **self.moment(time_ns))
        self._recording.log(entity, rr.EncodedDepthImage(blob=png, media_type="image/png", meter=units_a_metre))
        self._sent(len(png))

    def frames(self, entity: str, frames: U8, times_ns: I64) -> None:
        """uint8 [n,H,W,3] RGB, or [n,H,W,1] grey, at int64 [n]."""
        _, height, width, channels = frames.shape
        colours = "L" if channels == 1 else "RGB"
        form = rr.components.ImageFormat(height=height, width=width, color_model=colours, channel_datatype="U8")
        self._recording.log(entity, rr.Image.from_fields(format=form), static=True)
        columns = rr.Image.columns(buffer=frames.reshape(len(frames), -1))
        self._recording.send_columns(entity, indexes=[self._index(times_ns)], columns=columns)
        self._sent(frames.nbytes)

    def plots(self, plots: Iterable[Plot]) -> None:
        for plot in plots:
            self.plots(plot.over)
            self._recording.log(plot.entity, _series(plot), static=True)
            times = self._index(np.array(plot.times_ns, np.int64))
            columns = rr.Scalars.columns(scalars=plot.table())
            self._recording.send_columns(plot.entity, indexes=[times], columns=columns)

    def layout(self, pictures: Sequence[Sequence[Picture]], panels: Sequence[list[Plot]]) -> None:
        """Rows of pictures, where there are any, over one row of plots, a panel's plots behind tabs; nothing else takes room."""
        last = [plot for panel in panels[MAX_PANELS - 1 :] for plot in panel]
        shown = [*panels[: MAX_PANELS - 1], *([last] if last else [])]
        axis = self._whole_time([time_ns for panel in panels for plot in panel for time_ns in plot.times_ns])
        columns = [_panel(panel, axis) for panel in shown]
        rows = [
            rrb.Horizontal(*(rrb.Spatial2DView(origin=p.entity, name=p.title) for p in row)) for row in pictures if row
        ]
        shares = [3.0] * len(rows)
        if columns:
            shares += [2.0 if len(rows) == 1 else 3.0]
            rows += [rrb.Horizontal(*columns)]
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

    def blocks(self) -> Iterator[bytes]:
        """All that was drawn, as an .rrd file's bytes. Read once."""
        self._send_held()
        if not self._pieces.any:
            yield self._stream.read() or b""
            return
        self._pieces.add(self._stream.read() or b"")
        yield from self._pieces.blocks()

    def discard(self) -> None:
        """Take out what was drawn and nobody will read: else Rerun complains of it on the terminal when it closes."""
        self._stream.read()

    def close(self) -> None:
        self._recording.disconnect()
        self._pieces.close()

    def _send_held(self) -> None:
        for entity, images in self._held.items():
            times = self._index(np.array([image[0] for image in images], np.int64))
            columns = rr.EncodedImage.columns(blob=[i[1] for i in images], media_type=[i[2] for i in images])
            self._recording.send_columns(entity, indexes=[times], columns=columns)
        sent, self._held_bytes = self._held_bytes, 0
        self._held.clear()
        self._sent(sent)

    def _sent(self, n_bytes: int) -> None:
        """So many more bytes of images are in the stream's memory."""
        self._sent_bytes += n_bytes
        if self._sent_bytes > SPILL_BYTES:
            self._sent_bytes = 0
            self._pieces.add(self._stream.read() or b"")

    def _whole_time(self, times_ns: list[int]) -> rrb.TimeAxis | None:
        """A time axis over all that was drawn, the same for all plots."""
        if not times_ns:
            return None
        ends = [rrb.TimeRangeBoundary.absolute(nanos=at - self._zero_ns) for at in (min(times_ns), max(times_ns))]
        return rrb.TimeAxis(view_range=rrb.TimeRange(start=ends[0], end=ends[1]))

    def _index(self, times_ns: npt.NDArray[Any]) -> rr.TimeColumn:
        if self._wall_clock:
            return rr.TimeColumn(TIMELINE, timestamp=times_ns.astype("datetime64[ns]"))
        return rr.TimeColumn(TIMELINE, duration=(times_ns - self._zero_ns).astype("timedelta64[ns]"))


@contextmanager
def writing(rrd: Path, *, start_ns: int) -> Iterator[Canvas]:
    """A canvas, as `Canvas`, whose file appears under its name only once it is whole; on any error nothing is left behind.

    Raises UsageError where its folder is missing, StoreError where the file cannot be written."""
    if not rrd.parent.is_dir():
        raise UsageError("no such folder", where=rrd.parent, remedy="make it, or save somewhere else")
    if rrd.is_dir():
        raise StoreError("a folder is in the way", where=rrd, remedy="save under another name")
    canvas = Canvas(start_ns=start_ns, folder=rrd.parent)
    try:
        yield canvas
        with shards.atomic_file(rrd) as file:
            for block in canvas.blocks():
                file.write(block)
    except BaseException:
        canvas.discard()
        raise
    finally:
        canvas.close()


def draw_clip(
    rrd: Path, rows: Mapping[str, Mapping[str, U8]], times_ns: I64, psnr: Mapping[str, Mapping[str, F64]]
) -> Drawn:
    """Draw a clip that is no episode: for each view a row of named pictures, uint8 [n,H,W,3] at `times_ns` [n] since its start, and
    below a plot of each view's named PSNR in dB, float64 [n], where it is defined. Raises as `writing` does."""
    with writing(rrd, start_ns=0) as canvas:
        pictures = []
        for view, panels in rows.items():
            for name, frames in panels.items():
                canvas.frames(entity_of(view, name), frames, times_ns)
            pictures.append([Picture(entity_of(view, name), f"{view}: {name}") for name in panels])
        plots = [Plot(f"{view}: PSNR in dB", entity_of(view, "psnr")) for view in psnr]
        for plot, values in zip(plots, psnr.values(), strict=True):
            for row, time_ns in enumerate(times_ns.tolist()):
                plot.add(time_ns, {name: float(line[row]) for name, line in values.items()})
        canvas.plots(iter(plots))
        canvas.layout(pictures, [[plot] for plot in plots])
    return Drawn(rrd, canvas.id, canvas.moment(int(times_ns[len(times_ns) // 2])))


def entity_of(topic: str, group: str = "") -> str:
    """The place in the recording of a topic, or of one group of its numbers."""
    parts = [part for part in topic.split("/") if part] + [part for part in group.split(".") if part]
    return str(rr.new_entity_path(parts))


def title_of(topic: str, group: str = "") -> str:
    """Short, and enough to tell panels apart: the topic, and the last word of the group."""
    last = group.rpartition(".")[2]
    return f"{topic.strip('/')} {last}".strip()


def _n_series(plot: Plot) -> int:
    return len(plot.names) + sum(map(_n_series, plot.over))


def _series(plot: Plot) -> Any:
    colours = COLOURS[np.arange(len(plot.names)) % len(COLOURS)]
    if plot.style == "points":
        return rr.SeriesPoints(
            names=plot.names, colors=[MARK] * len(plot.names), markers="diamond", marker_sizes=MARK_SIZE
        )
    if plot.style == "faint":
        colours = (colours * FAINT).astype(np.uint8)
    return rr.SeriesLines(names=plot.names, colors=colours, widths=LINE_WIDTH)


def _panel(plots: Sequence[Plot], axis: rrb.TimeAxis | None) -> Any:
    views = [
        rrb.TimeSeriesView(
            origin=plot.entity,
            contents=[plot.entity, *(other.entity for other in plot.over)],
            name=plot.title,
            axis_x=axis,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=1 < _n_series(plot) <= MAX_LEGEND),
        )
        for plot in plots[:MAX_TABS]
    ]
    return views[0] if len(views) == 1 else rrb.Tabs(*views)
