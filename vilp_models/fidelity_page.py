"""A fidelity report as files: report.json for programs, report.md for people, worst.png to look at."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data.contact_sheet import ERROR_GAIN, SCALE, captioned, error_image, stacked, to_png
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
from vilp_models.report_files import markdown_table, number, page, read_fresh_report, shown, write_report_files

__all__ = ["contact_sheet", "read_fresh_report", "to_markdown", "to_table", "write_report"]

MEASURED = ("vqgan", "mean_frame", "copy", "previous_frame")
"""Whose errors a report holds, by the names of EpisodeFidelity."""


def write_report(report: FidelityReport, folder: Path, inputs: Mapping[str, Any]) -> list[Path]:
    """Write the three files into `folder`, report.json with its `inputs` last, and return their paths.

    Raises StoreError where they cannot be written."""
    table = {"inputs": inputs, **to_table(report)}
    sheet = to_png(contact_sheet([frame for view in report.views for frame in view.worst]))
    return write_report_files(folder, table, to_markdown(report), {"worst.png": sheet})


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
    parts = [
        ["# VQGAN fidelity on validation episodes"],
        markdown_table(
            "view | frames | PSNR | LPIPS | moving | mean frame | gain | copy | previous frame | codes used",
            [_view_cells(view) for view in report.views],
        ),
        [
            "PSNR in dB; from *moving* on over moving pixels alone, which are more than",
            f"{MOVING_THRESHOLD} of 255 from the episode's temporal median. LPIPS with {report.lpips_network}.",
            "The baselines repeat the mean training frame, the episode's first frame (copy), and the frame before.",
        ],
        markdown_table(
            "view | encoder key | largest error | codes that flip | PSNR change", map(_precision_cells, report.views)
        ),
        [f"float16 latents against a float32 encoder's, on every {PRECISION_STRIDE}th frame."],
        markdown_table(
            "episode | view | frames | PSNR | LPIPS | moving | mean frame",
            [_episode_cells(episode) for view in report.views for episode in view.episodes],
        ),
        [f"![worst frames: real, reconstructed, error x{ERROR_GAIN}](worst.png)"],
    ]
    return page(report.warnings, parts)


def contact_sheet(frames: list[WorstFrame]) -> U8:
    """Rows of real | reconstructed | absolute error x4, captioned: uint8 [H,W,3] RGB."""
    return stacked([_sheet_row(frame) for frame in frames])


def _sheet_row(frame: WorstFrame) -> U8:
    error = error_image(frame.real, frame.reconstructed)
    images = np.concatenate([frame.real, frame.reconstructed, error], axis=1)
    text = f"{frame.view}  {frame.episode}  frame {frame.index}  {psnr_from_mse(frame.mse):.1f} dB"
    return captioned(text, images.repeat(SCALE, axis=0).repeat(SCALE, axis=1))


def _view_table(view: ViewFidelity) -> dict[str, Any]:
    return {
        "encoder_key": view.key,
        "lpips": view.lpips,
        **{name: _errors_table(view.total(name)) for name in MEASURED},
        "moving_gain": number(view.gain_db),
        "codes": len(view.code_counts),
        "codes_used": view.codes_used,
        "code_perplexity": view.code_perplexity,
        "float16": {
            "max_latent_error": view.precision.max_error,
            "codes_flipped_share": view.precision.flipped_share,
            "psnr_change": number(view.precision.psnr_change),
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
        "psnr": number(errors.psnr),
        "moving_psnr": number(errors.moving_psnr),
        "moving_pixels": errors.moving_count,
    }


def _view_cells(view: ViewFidelity) -> list[str]:
    real, mean, first, previous = (view.total(name) for name in MEASURED)
    codes = f"{view.codes_used} of {len(view.code_counts)} (perplexity {view.code_perplexity:.0f})"
    moving = [shown(errors.moving_psnr) for errors in (real, mean, first, previous)]
    frames = sum(episode.frames for episode in view.episodes)
    gain = f"{view.gain_db:+.2f}"
    return [view.view, str(frames), shown(real.psnr), f"{view.lpips:.4f}", *moving[:2], gain, *moving[2:], codes]


def _precision_cells(view: ViewFidelity) -> list[str]:
    cost = view.precision
    flipped = f"{100 * cost.flipped_share:.3f} %"
    return [view.view, view.key, f"{cost.max_error:.2g}", flipped, f"{cost.psnr_change:+.3f} dB"]


def _episode_cells(episode: EpisodeFidelity) -> list[str]:
    real = episode.vqgan
    numbers = [shown(real.psnr), f"{episode.lpips:.4f}", shown(real.moving_psnr), shown(episode.mean_frame.moving_psnr)]
    return [episode.episode, episode.view, str(episode.frames), *numbers]
