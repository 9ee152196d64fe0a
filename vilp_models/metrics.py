"""Image metrics on uint8 arrays, pure. Frames are [...,H,W,3]; masks are bool [...,H,W]."""

from __future__ import annotations

import math

import numpy as np
import torch

from vilp_data.types import F32, U8, Bool
from vilp_models.lpips import Lpips

MOVING_THRESHOLD = 10
"""A pixel moves where some channel is more than this (of 255) from the episode's temporal median at that pixel.
Simulated and JPEG-compressed still backgrounds stay under it; a robot or an object passing does not."""

MAX_PSNR_DB = 100.0
"""What equal images score, so that averages stay finite; more than one wrong value in a megapixel scores less."""


def squared_error(real: U8, other: U8) -> F32:
    """Squared difference of every pixel, mean over channels: float32 [...,H,W]. `other` broadcasts."""
    difference = real.astype(np.float32) - other.astype(np.float32)
    error: F32 = np.square(difference).mean(axis=-1, dtype=np.float32)
    return error


def psnr_from_mse(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared error between images whose peak is 255; NaN stays NaN."""
    if math.isnan(mse):
        return math.nan
    return MAX_PSNR_DB if mse <= 0 else min(MAX_PSNR_DB, 10 * math.log10(255.0**2 / mse))


def psnr(real: U8, other: U8, mask: Bool | None = None) -> float:
    """PSNR in dB over all pixels of all frames together, or over those in `mask`; NaN where the mask is empty."""
    error = squared_error(real, other)
    if mask is not None:
        error = error[np.broadcast_to(mask, error.shape)]
    return psnr_from_mse(float(error.mean(dtype=np.float64)) if error.size else math.nan)


def temporal_median(frames: U8) -> U8:
    """Median over time of every pixel and channel, uint8 [n,H,W,3] to [H,W,3]; of two middle values the lower."""
    middle = (len(frames) - 1) // 2
    median: U8 = np.partition(frames, middle, axis=0)[middle]
    return median


def moving_mask(frames: U8, median: U8, *, threshold: int = MOVING_THRESHOLD) -> Bool:
    """Which pixels differ from the background by more than `threshold` in some channel: bool [...,H,W]."""
    above = np.maximum(frames, median) - np.minimum(frames, median)
    moving: Bool = np.any(above > threshold, axis=-1)
    return moving


@torch.inference_mode()
def lpips_distance(model: Lpips, real: U8, other: U8, *, batch_size: int = 16) -> F32:
    """LPIPS of each pair of frames [n,H,W,3]: float32 [n]."""
    device = model.shift.device
    out = []
    for start in range(0, len(real), batch_size):
        part = slice(start, start + batch_size)
        a, b = (torch.tensor(x[part], device=device).permute(0, 3, 1, 2) / 127.5 - 1 for x in (real, other))
        out.append(model(a, b).cpu().numpy())
    return np.concatenate(out) if out else np.empty(0, np.float32)
