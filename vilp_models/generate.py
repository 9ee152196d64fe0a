"""Imagined videos to look at: clips from validation starts, and long ones that feed their last frame back.

A generated video is, for each view, real | reconstructed | imagined | error, from the present frame on: as MP4, as a contact sheet,
and as a Rerun recording with the PSNR of every frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vilp_data.contact_sheet import ERROR_GAIN, captioned, error_image, grid, stacked, to_png
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.latents import open_latents
from vilp_data.mp4 import write_mp4
from vilp_data.plots import frame_psnr
from vilp_data.shards import write_atomic
from vilp_data.spec import WindowSpec
from vilp_data.types import F16, F32, F64, U8
from vilp_data.viewer.canvas import draw_clip
from vilp_models.imagined import Decoder, Imagination, decode_frames, read_recorded, recorded_starts, spread

PANEL_HEIGHT = 192
"""Pixels: small images are enlarged to about this in a video."""

SHEET_COLUMNS = 13
"""Frames of a long video on its contact sheet, evenly spread."""


@dataclass(frozen=True)
class ViewVideo:
    """uint8 [F,H,W,3] each. Frame 0 is the present: `imagined` begins with what the planner is given of it, its reconstruction."""

    real: U8
    reconstructed: U8
    imagined: U8

    @property
    def error(self) -> U8:
        """|real - imagined|, brighter."""
        return error_image(self.real, self.imagined)

    def panels(self) -> dict[str, U8]:
        error = f"error x{ERROR_GAIN}"
        return {"real": self.real, "reconstructed": self.reconstructed, "imagined": self.imagined, error: self.error}


@dataclass(frozen=True)
class Generated:
    """One video: `frame_stride` steps of 1 / `rate_hz` seconds apart, from step `step` of an episode. After `n_recorded` frames the
    episode is over, and the real frames repeat its last."""

    episode: str
    step: int
    frame_stride: int
    rate_hz: float
    n_recorded: int
    views: Mapping[str, ViewVideo]

    @property
    def n_frames(self) -> int:
        return len(next(iter(self.views.values())).real)

    @property
    def psnr(self) -> dict[str, F64]:
        """view -> dB of every imagined frame that was recorded, float64 [F]: NaN for the present, and past the end."""
        out = {}
        for view, video in self.views.items():
            values = frame_psnr(video.real, video.imagined)
            values[0] = values[self.n_recorded :] = np.nan
            out[view] = values
        return out


def imagine_clips(
    store: EpisodeStore,
    imagination: Imagination,
    decoders: Mapping[str, Decoder],
    entries: Sequence[EpisodeEntry],
    window: WindowSpec,
    *,
    n_clips: int,
) -> Iterator[Generated]:
    """The planner's horizon from starts evenly spread over `entries`, one sample each. Raises what reading windows raises."""
    keys = {view: decoders[view].key for view in imagination.planners}
    for entry, steps in spread(recorded_starts(store, entries, window), n_clips):
        for recorded in read_recorded(store, entry, steps, keys, window, batch_size=1):
            imagined = imagination.of(recorded, n_samples=1)
            videos = {}
            for view, decoder in decoders.items():
                latents = np.concatenate([recorded.present_latents[view][:, None], recorded.latents[view]], axis=1)[0]
                rebuilt = decode_frames(decoder, latents)
                future = decode_frames(decoder, imagined[view][0, 0])
                videos[view] = ViewVideo(
                    np.concatenate([recorded.present[view], recorded.future[view][0]]),
                    rebuilt,
                    np.concatenate([rebuilt[:1], future]),
                )
            n = window.n_plan_frames + 1
            yield Generated(entry.id, int(recorded.step[0]), window.frame_stride, entry.rate_hz, n, videos)


def imagine_long(
    store: EpisodeStore,
    imagination: Imagination,
    decoders: Mapping[str, Decoder],
    entry: EpisodeEntry,
    window: WindowSpec,
    *,
    n_frames: int,
) -> Generated:
    """`n_frames` imagined frames from the first valid step of an episode: a plan's last frame, decoded and encoded again, is the
    present of the next plan (the paper's protocol for long videos).

    Raises UsageError where a planner was trained with low_dim, which nobody imagines."""
    require_no_low_dim(imagination)
    arrays = open_steps(store, entry, decoders)
    valid = np.flatnonzero(arrays["valid"])
    if not len(valid):
        raise UsageError("no valid step to begin at", where=entry.id, remedy="`vilp-data check` says why; name another")
    start = int(valid[0])
    after = valid[np.searchsorted(valid, start + np.arange(n_frames + 1) * window.frame_stride, side="right") - 1]
    n_recorded = int((start + np.arange(n_frames + 1) * window.frame_stride <= valid[-1]).sum())
    index = {view: arrays[f"source_index/{view}"][after] for view in decoders}
    rebuilt = {
        view: decode_frames(decoder, open_latents(store.root, entry, view, decoder.key)[index[view]])
        for view, decoder in decoders.items()
    }
    present = {view: open_frames(store, entry, view)[index[view][:1]] for view in decoders}
    imagined = _fed_back(imagination, decoders, present, arrays["low_dim"].shape[1], entry.id, start, n_frames, window)
    videos = {
        view: ViewVideo(
            open_frames(store, entry, view)[index[view]],
            rebuilt[view],
            np.concatenate([rebuilt[view][:1], imagined[view]]),
        )
        for view in decoders
    }
    return Generated(entry.id, start, window.frame_stride, entry.rate_hz, n_recorded, videos)


def require_no_low_dim(imagination: Imagination) -> None:
    """Raise UsageError where a planner must be told low_dim, which only the present has."""
    for view, planner in imagination.planners.items():
        if planner.sees_low_dim:
            raise UsageError(
                "long videos need planners without low_dim: it is not imagined, and later plans would not know it",
                found=f"the planner of view {view!r} was trained with low_dim",
                remedy="set low_dim = false in [models.planner] and train again, or leave --long out",
            )


def _fed_back(
    imagination: Imagination,
    decoders: Mapping[str, Decoder],
    present: Mapping[str, U8],
    low_dim_size: int,
    episode: str,
    start: int,
    n_frames: int,
    window: WindowSpec,
) -> dict[str, U8]:
    """view -> imagined frames uint8 [n_frames,H,W,3]."""
    done: dict[str, list[U8]] = {view: [] for view in decoders}
    for first in range(0, n_frames, window.n_plan_frames):
        latents: dict[str, F16] = {view: decoder.encode(present[view]) for view, decoder in decoders.items()}
        low_dim: F32 = np.zeros((1, low_dim_size), np.float32)  # planners that see none ignore it
        names = [(episode, start + first * window.frame_stride)]
        plan = imagination.samples(present, latents, low_dim, names=names, n_samples=1)
        present = {}
        for view, decoder in decoders.items():
            done[view].append(decode_frames(decoder, plan[view][0, 0]))
            present[view] = done[view][-1][-1:]
    return {view: np.concatenate(parts)[:n_frames] for view, parts in done.items()}


# --- files


def write_generated(generated: Generated, folder: Path, name: str) -> list[Path]:
    """Write NAME.mp4, NAME.png and NAME.rrd into `folder`; their paths. Raises StoreError where they cannot be written."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}{suffix}" for suffix in (".mp4", ".png", ".rrd")]
    write_mp4(paths[0], video_frames(generated), fps=generated.rate_hz / generated.frame_stride)
    write_atomic(paths[1], to_png(sheet(generated)))
    step_ns = round(1e9 * generated.frame_stride / generated.rate_hz)
    pictures = {view: video.panels() for view, video in generated.views.items()}
    psnr = {
        view: {
            "imagined": values,
            "reconstructed": frame_psnr(generated.views[view].real, generated.views[view].reconstructed),
        }
        for view, values in generated.psnr.items()
    }
    draw_clip(paths[2], pictures, np.arange(generated.n_frames) * step_ns, psnr)
    return paths


def video_frames(generated: Generated) -> U8:
    """Every frame's panels side by side, enlarged and captioned, a row a view: uint8 [F,H,W,3]."""
    out = []
    for index in range(generated.n_frames):
        rows = []
        for view, video in generated.views.items():
            scale = max(1, PANEL_HEIGHT // video.real.shape[1])
            panels = [
                captioned(name, frames[index].repeat(scale, axis=0).repeat(scale, axis=1))
                for name, frames in video.panels().items()
            ]
            rows.append(captioned(_caption(generated, view, index), np.concatenate(panels, axis=1)))
        out.append(stacked(rows))
    return np.stack(out)


def sheet(generated: Generated) -> U8:
    """Rows of panels for each view, a column a time: all frames of a clip, some of a long video; uint8 [H,W,3]."""
    last = generated.n_frames - 1
    shown = np.unique(np.linspace(0, last, min(SHEET_COLUMNS, last + 1)).round().astype(int)).tolist()
    columns = [f"{i * generated.frame_stride / generated.rate_hz:.1f} s" for i in shown]
    parts = []
    for view, video in generated.views.items():
        rows = {name: [frames[i] for i in shown] for name, frames in video.panels().items()}
        parts.append(captioned(_caption(generated, view), grid(rows, columns)))
    return stacked(parts)


def _caption(generated: Generated, view: str, index: int | None = None) -> str:
    text = f"{view}  {generated.episode}  from step {generated.step}"
    if index is None:
        past = generated.n_recorded < generated.n_frames
        return text + (f"; recorded for {generated.n_recorded - 1} frames, then its last one" if past else "")
    over = "  (episode over)" if index >= generated.n_recorded else ""
    return f"{text}  +{index * generated.frame_stride / generated.rate_hz:.1f} s{over}"
