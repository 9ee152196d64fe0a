"""What a planner imagines while it is trained, to look at: a few validation windows beside what was recorded."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from vilp_data.dataset import WindowDataset
from vilp_models.model_training import Clips
from vilp_models.planner import Planner
from vilp_models.vqgan import VqganEncoder

WINDOWS = 3


def planner_clips(
    windows: WindowDataset, view: str, encoder: VqganEncoder, *, device: torch.device
) -> Callable[[nn.Module], Clips]:
    """Draws clips uint8 [N,H,2W,3] of a planner of `view`: the recorded frames, as the encoder's VQGAN reconstructs them, beside
    the imagined ones. The same windows, spread over the dataset, and the same noise each time."""
    numbers = np.linspace(0, len(windows) - 1, WINDOWS).astype(np.int64)
    stored = windows.read(numbers)  # now, since a stale file should not end a run that is half done

    def draw(planner: nn.Module) -> Clips:
        assert isinstance(planner, Planner)
        batch = stored.to(device)
        recorded = batch.latents[view].float()
        noise = torch.randn(recorded.shape, generator=torch.Generator().manual_seed(0)).to(device)
        condition = planner.condition(batch.frames, batch.present_latents, batch.low_dim)
        both = torch.stack([recorded, planner.sample(condition, noise)], dim=2)
        clips = {}
        for number, clip in zip(numbers.tolist(), both.cpu().numpy(), strict=True):
            frames = encoder.decode(clip.reshape(-1, *clip.shape[2:])).reshape(
                *clip.shape[:2], *batch.frames[view].shape[1:]
            )
            clips[f"{view}: recorded and imagined/window {number}"] = np.concatenate(
                [frames[:, 0], frames[:, 1]], axis=2
            )
        return clips

    return draw
