"""Truth against dream, drawn with Rerun: for each view real, reconstructed, imagined and error; below, curves and actions.

    draw = partial(draw_generated, store, open_generated_episode(store, folder, "episode"))
    present(draw, save=Path("dream.rrd"))

Everything lies on the episode's own clock, so that one cursor moves all. Lines of what was made are broken where it looked at the
world again, and a diamond marks that moment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np

from vilp_data.contact_sheet import ERROR_GAIN
from vilp_data.episode_files import open_steps
from vilp_data.episodes import EpisodeStore
from vilp_data.generated_episode import KINDS, GeneratedEpisode, Kind, shown_frames
from vilp_data.plots import Plot
from vilp_data.types import F32, F64, I32, I64, U8
from vilp_data.vector_parts import vector_parts
from vilp_data.viewer.canvas import Canvas, Drawn, Picture, entity_of, title_of, writing

PANELS = ("real", *KINDS, "error")
PNG_LEVEL = 2
"""Of 9: twice as fast as the usual one, and a tenth larger."""

Progress = Callable[[int], None]


def draw_generated(
    store: EpisodeStore, generated: GeneratedEpisode, rrd: Path, *, progress: Progress | None = None
) -> Drawn:
    """Draw what was imagined along an episode beside the episode, into `rrd`. Memory does not grow with its length.

    `progress` is told how many frames were drawn. Raises StoreError where the dataset's files are damaged, or `rrd` cannot be written."""
    entry, spec = store.entry(generated.episode), store.spec()
    arrays = open_steps(store, entry)
    times: I64 = np.asarray(arrays["log_time_ns"])
    with writing(rrd, start_ns=int(times[0])) as canvas:
        rows = [_draw_view(canvas, store, generated, view, times, progress) for view in generated.views]
        panels = [_measured("PSNR in dB", "psnr", generated, generated.psnr_db, times)]
        if generated.lpips:
            panels.append(_measured("LPIPS", "lpips", generated, generated.lpips, times))
        recorded = arrays.get("action")
        names = entry.column_names.get("action", {})
        parts = vector_parts(generated.action, spec.action, names)
        truth = vector_parts(recorded, spec.action, names) if recorded is not None else {}
        panels += [
            [_actions(name, labels, made, truth.get(name, (labels, None))[1], generated, times)]
            for name, (labels, made) in parts.items()
        ]
        canvas.plots(plot for panel in panels for plot in panel)
        canvas.layout(rows, panels)
    return Drawn(rrd, canvas.id, canvas.moment(int(times[generated.step[generated.shown_first]])))


def _draw_view(
    canvas: Canvas, store: EpisodeStore, generated: GeneratedEpisode, view: str, times: I64, progress: Progress | None
) -> list[Picture]:
    for part in shown_frames(store, generated, view):
        panels = (part.real, part.reconstructed, part.imagined, part.error)
        for name, frames in zip(PANELS, panels, strict=True):
            for row, frame in enumerate(frames, start=part.first):
                canvas.encoded_image(entity_of(view, name), int(times[generated.step[row]]), as_png(frame), "image/png")
        if progress is not None:
            progress(len(part.real))
    titles = {name: f"{view}: {name}" for name in PANELS} | {"error": f"{view}: error × {ERROR_GAIN}"}
    return [Picture(entity_of(view, name), titles[name]) for name in PANELS]


def as_png(frame: U8) -> bytes:
    """A frame uint8 [H,W,3] or [H,W,1] as the bytes of a PNG, without loss."""
    return cv2.imencode(".png", frame[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])[1].tobytes()


def _measured(
    title: str, entity: str, generated: GeneratedEpisode, values: Mapping[Kind, Mapping[str, F32]], times: I64
) -> list[Plot]:
    """A plot for each view: what was imagined, what reconstruction costs, and the first frame of each plan marked."""
    at, plots = times[generated.step], []
    first = np.flatnonzero(np.diff(generated.plan, prepend=-1))
    for view in generated.views:
        imagined = values["imagined"][view]
        looked = Plot("", entity_of(view, f"{entity}.looked"), style="points")
        _fill(looked, "looked again", at[first], imagined[first])
        ceiling = Plot("", entity_of(view, f"{entity}.reconstructed"), style="faint")
        _fill(ceiling, "reconstructed", at, values["reconstructed"][view])
        plot = Plot(f"{view}: {title}", entity_of(view, f"{entity}.imagined"), over=(ceiling, looked))
        broken_at, broken = _broken(at, imagined[:, None], generated.plan)
        _fill(plot, "imagined", broken_at, broken[:, 0])
        plots.append(plot)
    return plots


def _actions(
    part: str, labels: list[str], made: F32, recorded: F32 | None, generated: GeneratedEpisode, times: I64
) -> Plot:
    entity = f"{part}." if part else ""
    over = []
    if recorded is not None:
        names = [f"{label} recorded" for label in labels]
        over.append(
            Plot("", entity_of("action", f"{entity}recorded"), names, times.tolist(), recorded.tolist(), "faint")
        )
    looked = Plot("", entity_of("action", f"{entity}looked"), ["looked again"] * len(labels), style="points")
    looked.times_ns, looked.rows = times[generated.plan_step].tolist(), made[generated.plan_step].tolist()
    over.append(looked)
    broken_at, broken = _broken(times, made, generated.plan_of_step)
    return Plot(
        title_of("action", part), entity_of("action", f"{entity}predicted"), [f"{label} predicted" for label in labels],
        broken_at.tolist(), broken.tolist(), over=tuple(over),
    )  # fmt: skip


def _fill(plot: Plot, name: str, times: I64, values: F32 | F64) -> None:
    plot.names, plot.times_ns, plot.rows = [name], times.tolist(), [[value] for value in values.tolist()]


def _broken(times: I64, values: F32, plan: I32) -> tuple[I64, F32]:
    """The rows [n,m] and their times, with a row of NaN just before each first row of a plan: a line that breaks there."""
    begins = np.flatnonzero(np.diff(plan))  # the last row of each plan but the last
    gap = np.full((len(begins), values.shape[1]), np.nan, np.float32)
    return np.insert(times, begins + 1, times[begins] + 1), np.insert(values, begins + 1, gap, axis=0)
