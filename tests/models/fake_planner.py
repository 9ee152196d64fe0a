"""A planner that needs no training: it gives back what it is told to, or the present, plus so much of the noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


class FakePlanner:
    """Repeats the present frame's latents, plus `noise` times the noise it is given.

    With `futures` (bytes of the present frame -> latents [N,c,h,w]) it knows what comes. `calls` counts samples drawn."""

    def __init__(
        self,
        view: str,
        *,
        noise: float = 0.0,
        futures: Mapping[bytes, Tensor] | None = None,
        sees_low_dim: bool = False,
    ) -> None:
        self.view, self.noise, self.futures, self.sees_low_dim = view, noise, futures, sees_low_dim
        self.calls = 0

    def condition(self, frames: Mapping[str, Tensor], present_latents: Mapping[str, Tensor], low_dim: Tensor) -> Tensor:
        assert all(tensor.dtype == torch.uint8 for tensor in frames.values())
        assert len(low_dim) == len(frames[self.view])
        if self.futures is None:
            return present_latents[self.view]
        return torch.stack([self.futures[frame.numpy().tobytes()] for frame in frames[self.view]])

    def sample(self, condition: Tensor, noise: Tensor, *, steps: int | None = None, sampler: Any = None) -> Tensor:
        self.calls += 1
        known = (condition if condition.ndim == noise.ndim else condition[:, None].expand_as(noise)).float()
        return known + self.noise * noise
