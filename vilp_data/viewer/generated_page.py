"""Truth against dream as one page of HTML: playable clips, curves whose cursor follows them, means. It needs nothing from elsewhere."""

from __future__ import annotations

import base64
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vilp_data import shards
from vilp_data.check.style import STYLE as PAGE_STYLE
from vilp_data.contact_sheet import ERROR_GAIN, as_rgb, jpeg_uri
from vilp_data.episode_files import open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.generated_episode import KINDS, GeneratedEpisode, shown_frames
from vilp_data.mp4 import enlarged, write_mp4
from vilp_data.spec import TaskSpec
from vilp_data.types import F32, F64, U8, Bool
from vilp_data.vector_parts import vector_parts
from vilp_data.viewer.curves import Line, curve
from vilp_data.viewer.generated_style import SCRIPT, STYLE

PANELS = ("real", *KINDS, f"error × {ERROR_GAIN}")
PANEL_HEIGHT = 192
"""Pixels: small images are enlarged to about this, so that a player's smoothing does not blur their pixels."""

KIND_HEADS = ["recon\u00adstructed", "imagined"]
"""KINDS over narrow columns: the first may be hyphenated."""

UNKNOWN = "–"

POSTER_QUALITY = 95

BLOCK_BYTES = 3 << 20
"""Of a clip, turned into text at a time; a multiple of three."""

Progress = Callable[[int], None]


class _Clip(NamedTuple):
    """A view's video, and the size of one of its panels in pixels."""

    path: Path
    width: int
    height: int
    poster: U8


def write_generated_page(
    path: Path, store: EpisodeStore, generated: GeneratedEpisode, *, progress: Progress | None = None
) -> None:
    """Write the page, whole or not at all. Clips are made one after another in a temporary folder: memory does not grow with them.

    `progress` is told how many frames were put into clips. Raises StoreError where the folder cannot be written, or the dataset's
    files are damaged."""
    entry, spec = store.entry(generated.episode), store.spec()
    shown = _Episode(entry, spec, generated, open_steps(store, entry))
    with tempfile.TemporaryDirectory(prefix="vilp-page-") as folder:
        clips = {
            view: _clip(Path(folder) / f"{number}.mp4", store, generated, view, shown.fps, progress)
            for number, view in enumerate(generated.views)
        }
        with shards.atomic_file(path) as file:
            for text in _page(shown, clips):
                file.write(text.encode())


class _Episode:
    """What a page needs to know of an episode: places on its time axis are 0 … 1."""

    def __init__(
        self, entry: EpisodeEntry, spec: TaskSpec, generated: GeneratedEpisode, arrays: Mapping[str, np.ndarray]
    ) -> None:
        self.entry, self.spec, self.generated = entry, spec, generated
        times = np.asarray(arrays["log_time_ns"], np.float64)
        self.seconds: F64 = (times - times[0]) / 1e9
        self.duration_s = float(self.seconds[-1]) or 1.0
        self.recorded: F32 | None = arrays.get("action")
        self.fps = entry.rate_hz / generated.frame_stride
        self.at: F64 = self.seconds[generated.step] / self.duration_s
        self.plans_at: F64 = self.seconds[generated.plan_step] / self.duration_s
        self.first_of_plan = frozenset(np.flatnonzero(np.diff(generated.plan, prepend=-1)).tolist())

    def action_parts(self) -> Iterator[tuple[str, F32, F32 | None]]:
        """(name, predicted [F], recorded [F] or None) of each value of the action."""
        names = self.entry.column_names.get("action", {})
        parts = vector_parts(self.generated.action, self.spec.action, names)
        recorded = vector_parts(self.recorded, self.spec.action, names) if self.recorded is not None else {}
        for part, (labels, made) in parts.items():
            unit = self.spec.action[part].unit if part in self.spec.action else None
            for column, label in enumerate(labels):
                truth = recorded[part][1][:, column] if part in recorded else None
                yield f"{part} {label}".strip() + (f" ({unit})" if unit else ""), made[:, column], truth


# --- clips --------------------------------------------------------------------------------------------------------------


def _clip(
    path: Path, store: EpisodeStore, generated: GeneratedEpisode, view: str, fps: float, progress: Progress | None
) -> _Clip:
    height = generated.imagined[view].shape[1]
    scale = max(1, round(PANEL_HEIGHT / height))
    posters: list[U8] = []

    def frames() -> Iterator[U8]:
        for part in shown_frames(store, generated, view):
            together = np.concatenate(
                [as_rgb(panel) for panel in (part.real, part.reconstructed, part.imagined, part.error)], axis=2
            )
            if part.first <= generated.shown_first < part.first + len(together):
                posters.append(enlarged(together[generated.shown_first - part.first], scale))
            yield from together
            if progress is not None:
                progress(len(together))

    write_mp4(path, frames(), fps=fps, scale=scale)
    width = generated.imagined[view].shape[2] * scale
    return _Clip(path, width, height * scale, posters[0])


# --- the page -----------------------------------------------------------------------------------------------------------


def _page(shown: _Episode, clips: Mapping[str, _Clip]) -> Iterator[str]:
    generated, title = shown.generated, shown.generated.episode
    yield (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}: truth against dream</title><style>{PAGE_STYLE}{STYLE}</style></head><body><main>"
        f"<header><h1>Truth against dream</h1>{_lead(shown)}{_tally(shown)}</header>"
    )
    yield f"<section><h2>Clips</h2>{_transport(shown)}"
    for view, clip in clips.items():
        yield from _figure(view, clip)
    yield f"</section><section><h2>Curves</h2>{_key()}{''.join(_curves(shown))}{_scale(shown)}</section>"
    yield f"<section><h2>Means</h2>{''.join(_tables(shown))}</section>"
    made = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in generated.maker.settings.items())
    yield f'<section><h2>Made by</h2><dl class="made">{made}</dl></section>'
    yield (
        "<footer>Written by <code>vilp-data view --generated --html</code>. At every plan the policy saw the recorded present,"
        " imagined what comes next and said what it would do; the world then went on as it was recorded.</footer>"
    )
    yield f'</main><script type="application/json" id="frames">{_frames(shown)}</script><script>{SCRIPT}</script></body></html>\n'


def _lead(shown: _Episode) -> str:
    generated = shown.generated
    told = (
        f"{len(generated.plan_step)} plans over {shown.entry.n_steps} steps ({shown.duration_s:.1f} s), "
        f"{len(generated.step)} imagined frames{' of each view' if len(generated.views) > 1 else ''}"
    )
    if shown.entry.outcome != "unknown":
        told += f"; the recording is a {shown.entry.outcome}"
    return f'<p class="mono">{escape(generated.episode)}</p><p class="soft">{escape(told)}</p>'


def _tally(shown: _Episode) -> str:
    made = shown.generated
    cells = [
        (_mean(list(made.psnr_db[kind].values()), 1), f"dB PSNR, {kind}") for kind in ("imagined", "reconstructed")
    ]
    if made.lpips:
        cells += [
            (_mean(list(made.lpips[kind].values()), 3), f"LPIPS, {kind}") for kind in ("imagined", "reconstructed")
        ]
    return '<ul class="tally">' + "".join(f"<li><b>{value}</b>{what}</li>" for value, what in cells) + "</ul>"


def _transport(shown: _Episode) -> str:
    speeds = "".join(
        f'<option value="{s:g}"{" selected" if s == 1 else ""}>{s:g}×</option>' for s in (0.25, 0.5, 1.0, 2.0, 4.0)
    )
    return (
        '<div class="transport"><button type="button">Play</button>'
        f'<input type="range" min="0" max="{len(shown.generated.step) - 1}" value="0" aria-label="time">'
        f'<select aria-label="speed">{speeds}</select><output></output></div>'
    )


def _figure(view: str, clip: _Clip) -> Iterator[str]:
    names = "".join(f"<span>{name}</span>" for name in PANELS)
    panels = "".join(
        f'<figure class="{kind}"><canvas width="{clip.width}" height="{clip.height}"></canvas><figcaption>{name}</figcaption></figure>'
        for kind, name in zip(("real", *KINDS, "error"), PANELS, strict=True)
    )
    yield f'<div class="clip"><h3>{escape(view)}</h3><div class="names">{names}</div><div class="panels">{panels}</div>'
    poster = jpeg_uri(clip.poster, quality=POSTER_QUALITY)
    yield f'<video controls loop muted playsinline preload="auto" poster="{poster}" src="data:video/mp4;base64,'
    with clip.path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            yield base64.b64encode(block).decode()
    yield '"></video></div>'


def _key() -> str:
    return (
        '<p class="key"><b>Imagined frames, predicted actions</b>; <i>reconstructed frames, recorded actions</i>. An upright line:'
        " there it looked at the world again. Click to go there.</p>"
    )


def _curves(shown: _Episode) -> Iterator[str]:
    generated = shown.generated
    for view in generated.views:
        for name, measured, digits in (("PSNR in dB", generated.psnr_db, 1), ("LPIPS", generated.lpips, 3)):
            if measured:
                lines = [
                    Line("reconstructed", shown.at, _f64(measured["reconstructed"][view])),
                    Line("imagined", shown.at, _f64(measured["imagined"][view]), shown.first_of_plan),
                ]
                yield curve(f"{view}: {name}", lines, shown.plans_at, digits=digits)
    every = shown.seconds / shown.duration_s
    breaks = frozenset(generated.plan_step.tolist())
    for name, made, recorded in shown.action_parts():
        lines = [Line("recorded", every, _f64(recorded))] if recorded is not None else []
        lines.append(Line("predicted", every, _f64(made), breaks))
        yield curve(name, lines, shown.plans_at, digits=_digits(made))


def _scale(shown: _Episode) -> str:
    return f'<span class="scale"><span>0 s</span><span>{shown.duration_s:.1f} s</span></span>'


def _frames(shown: _Episode) -> str:
    """What the script knows of each frame."""
    generated = shown.generated
    return json.dumps(
        {
            "at": [round(x, 5) for x in shown.at.tolist()],
            "seconds": [round(x, 2) for x in shown.seconds[generated.step].tolist()],
            "step": generated.step.tolist(),
            "plan": generated.plan.tolist(),
            "ahead": generated.ahead.tolist(),
            "plans": len(generated.plan_step),
            "fps": shown.fps,
            "begin": generated.shown_first,
        },
        separators=(",", ":"),
    )


# --- means --------------------------------------------------------------------------------------------------------------


def _tables(shown: _Episode) -> Iterator[str]:
    generated = shown.generated
    for view in generated.views:
        columns = [(generated.psnr_db[kind][view], 1) for kind in KINDS]
        columns += [(generated.lpips[kind][view], 3) for kind in KINDS if generated.lpips]
        rows = []
        for ahead in np.unique(generated.ahead).tolist():
            rows.append([f"{ahead} ({ahead / shown.entry.rate_hz:.1f} s)", *_cells(generated.ahead == ahead, columns)])
        rows.append(["all", *_cells(np.ones(len(generated.step), np.bool_), columns)])
        measured = ["PSNR, dB", "LPIPS"][: len(columns) // len(KINDS)]
        head = ["steps ahead", "frames", *(KIND_HEADS * len(measured))]
        yield _table(view, head, rows, over=[("", 2), *((name, len(KINDS)) for name in measured)])
    errors = [
        _action_row(name, made, recorded) for name, made, recorded in shown.action_parts() if recorded is not None
    ]
    if errors:
        yield _table("action", ["", "mean error", "deviation of the recorded", "steps"], errors)


def _cells(rows: Bool, columns: list[tuple[F32, int]]) -> list[str]:
    return [str(int(rows.sum())), *(_mean([values[rows]], digits) for values, digits in columns)]


def _action_row(name: str, made: F32, recorded: F32) -> list[str]:
    known, digits = np.isfinite(made) & np.isfinite(recorded), _digits(made)
    deviation = f"{recorded[known].std():.{digits}f}" if known.any() else UNKNOWN
    return [name, _mean([np.abs(made - recorded)], digits), deviation, str(int(known.sum()))]


def _table(caption: str, head: list[str], rows: list[list[str]], *, over: Sequence[tuple[str, int]] = ()) -> str:
    """`over`: a row of headings above the others, each over so many of them."""
    groups = "".join(f'<th colspan="{span}">{escape(name)}</th>' for name, span in over)
    top = f"<tr>{groups}</tr>" * bool(over) + "<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>"
    body = "".join(
        f"<tr{' class=all' if row[0] == 'all' else ''}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><caption>{escape(caption)}</caption><thead>{top}</thead><tbody>{body}</tbody></table></div>'


def _mean(values: list[F32], digits: int) -> str:
    """Of what is known, in words."""
    together = np.concatenate(values)
    known = together[np.isfinite(together)]
    return f"{known.mean():.{digits}f}" if len(known) else UNKNOWN


def _digits(values: F32) -> int:
    """Decimal places that tell values of this size apart."""
    known = np.abs(values[np.isfinite(values)])
    largest = float(known.max()) if len(known) else 1.0
    return int(np.clip(2 - np.floor(np.log10(max(largest, 1e-6))), 0, 4))


def _f64(values: F32) -> F64:
    return values.astype(np.float64)
