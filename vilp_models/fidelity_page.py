"""A fidelity report as files: report.json for programs, report.md for people, worst.png to look at."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vilp_data.shards import write_atomic
from vilp_data.types import U8
from vilp_models.fidelity import (
    ENOUGH_DB,
    PRECISION_STRIDE,
    EpisodeFidelity,
    Errors,
    FidelityReport,
    ViewFidelity,
    WorstFrame,
)
from vilp_models.lpips_weights import FILES
from vilp_models.metrics import MOVING_THRESHOLD, psnr_from_mse

MEASURED = ("vqgan", "mean_frame", "copy", "previous_frame")
"""Whose errors a report holds, by the names of EpisodeFidelity."""

ERROR_GAIN = 4
SCALE = 2
CAPTION_HEIGHT = 18


def write_report(report: FidelityReport, folder: Path, inputs: Mapping[str, Any]) -> list[Path]:
    """Write the three files into `folder`, report.json with its `inputs` last, and return their paths.

    Raises StoreError where they cannot be written."""
    table = {"inputs": inputs, **to_table(report)}
    files = {
        "worst.png": to_png(contact_sheet([frame for view in report.views for frame in view.worst])),
        "report.md": to_markdown(report).encode(),
        "report.json": json.dumps(table, indent=2, allow_nan=False).encode() + b"\n",
    }
    for name, data in files.items():
        write_atomic(folder / name, data)
    return [folder / name for name in files]


def read_fresh_report(folder: Path, inputs: Mapping[str, Any]) -> dict[str, Any] | None:
    """The report.json in `folder` if it was made from equal `inputs` (see `report_inputs`), else None."""
    try:
        table: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return table if table.get("inputs") == inputs else None


def to_table(report: FidelityReport) -> dict[str, Any]:
    """The report as plain data; numbers that are not defined are null. PSNR in dB."""
    return {
        "lpips": {"network": report.lpips_network, "weights_sha256": FILES["alex"][1]},
        "moving_threshold": MOVING_THRESHOLD,
        "enough_db": ENOUGH_DB,
        "warnings": report.warnings,
        "views": {view.view: _view_table(view) for view in report.views},
    }


def to_markdown(report: FidelityReport) -> str:
    """Tables for people: the views, what float16 storage costs, then every episode."""
    warnings = [f"> **Warning:** {warning}" for warning in report.warnings]
    parts = [
        ["# VQGAN fidelity on validation episodes"],
        warnings,
        _table(
            "view | frames | PSNR | LPIPS | moving | mean frame | gain | copy | previous frame | codes used",
            [_view_cells(view) for view in report.views],
        ),
        [
            "PSNR in dB; from *moving* on over moving pixels alone, which are more than",
            f"{MOVING_THRESHOLD} of 255 from the episode's temporal median. LPIPS with {report.lpips_network}.",
            "The baselines repeat the mean training frame, the episode's first frame (copy), and the frame before.",
        ],
        _table(
            "view | encoder key | largest error | codes that flip | PSNR change", map(_precision_cells, report.views)
        ),
        [f"float16 latents against a float32 encoder's, on every {PRECISION_STRIDE}th frame."],
        _table(
            "episode | view | frames | PSNR | LPIPS | moving | mean frame",
            [_episode_cells(episode) for view in report.views for episode in view.episodes],
        ),
        [f"![worst frames: real, reconstructed, error x{ERROR_GAIN}](worst.png)"],
    ]
    return "\n\n".join("\n".join(part) for part in parts if part) + "\n"


def contact_sheet(frames: list[WorstFrame]) -> U8:
    """Rows of real | reconstructed | absolute error x4, captioned: uint8 [H,W,3] RGB."""
    rows = [_sheet_row(frame) for frame in frames]
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])


def to_png(image: U8) -> bytes:
    """Encode RGB uint8 [H,W,3]."""
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes()


def _sheet_row(frame: WorstFrame) -> U8:
    difference = np.abs(frame.real.astype(np.int16) - frame.reconstructed.astype(np.int16))
    error = np.clip(ERROR_GAIN * difference, 0, 255).astype(np.uint8)
    images = np.concatenate([frame.real, frame.reconstructed, error], axis=1)
    images = images.repeat(SCALE, axis=0).repeat(SCALE, axis=1)
    caption = np.zeros((CAPTION_HEIGHT, images.shape[1], 3), np.uint8)
    text = f"{frame.view}  {frame.episode}  frame {frame.index}  {psnr_from_mse(frame.mse):.1f} dB"
    cv2.putText(caption, text, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return np.concatenate([caption, images])


def _view_table(view: ViewFidelity) -> dict[str, Any]:
    return {
        "encoder_key": view.key,
        "lpips": view.lpips,
        **{name: _errors_table(view.total(name)) for name in MEASURED},
        "moving_gain": _number(view.gain_db),
        "codes": len(view.code_counts),
        "codes_used": view.codes_used,
        "code_perplexity": view.code_perplexity,
        "float16": {
            "max_latent_error": view.precision.max_error,
            "codes_flipped_share": view.precision.flipped_share,
            "psnr_change": _number(view.precision.psnr_change),
        },
        "episodes": {
            e.episode: {
                "frames": e.frames,
                "lpips": e.lpips,
                **{name: _errors_table(getattr(e, name)) for name in MEASURED},
            }
            for e in view.episodes
        },
    }


def _errors_table(errors: Errors) -> dict[str, float | int | None]:
    return {
        "psnr": _number(errors.psnr),
        "moving_psnr": _number(errors.moving_psnr),
        "moving_pixels": errors.moving_count,
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)


def _db(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2f}"


def _view_cells(view: ViewFidelity) -> list[str]:
    real, mean, first, previous = (view.total(name) for name in MEASURED)
    codes = f"{view.codes_used} of {len(view.code_counts)} (perplexity {view.code_perplexity:.0f})"
    moving = [_db(errors.moving_psnr) for errors in (real, mean, first, previous)]
    frames = sum(episode.frames for episode in view.episodes)
    gain = f"{view.gain_db:+.2f}"
    return [view.view, str(frames), _db(real.psnr), f"{view.lpips:.4f}", *moving[:2], gain, *moving[2:], codes]


def _precision_cells(view: ViewFidelity) -> list[str]:
    cost = view.precision
    flipped = f"{100 * cost.flipped_share:.3f} %"
    return [view.view, view.key, f"{cost.max_error:.2g}", flipped, f"{cost.psnr_change:+.3f} dB"]


def _episode_cells(episode: EpisodeFidelity) -> list[str]:
    real = episode.vqgan
    numbers = [_db(real.psnr), f"{episode.lpips:.4f}", _db(real.moving_psnr), _db(episode.mean_frame.moving_psnr)]
    return [episode.episode, episode.view, str(episode.frames), *numbers]


def _table(titles: str, rows: Iterable[list[str]]) -> list[str]:
    """A Markdown table from titles joined by " | " and rows of cells."""
    rule = "|" + " --- |" * len(titles.split(" | "))
    return [f"| {titles} |", rule, *(f"| {' | '.join(cells)} |" for cells in rows)]
