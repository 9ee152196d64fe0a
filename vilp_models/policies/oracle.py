"""The low-level policy on the true future: what VILP would do if it imagined perfectly. An upper bound for it.

The chunk planned at step k is made of the pairs that VILP would make of its imagined frames: the real observation and the recorded
frame at k+Δt, then the recorded frames at k+Δt and k+2Δt, and so on; past the recording's end its last frame repeats.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from vilp_data.types import F32, U8
from vilp_models.low_level import LowLevelPolicy
from vilp_models.policies.base import Observation
from vilp_models.starts import Recording

Encode = Callable[[str, U8], F32]
"""View and frames uint8 [n,H,W,3] to latents float32 [n,c,h,w] before quantisation."""


class OraclePolicy:
    """Follows the recording that its seed names, from its first step on, counting the steps itself."""

    def __init__(
        self,
        network: LowLevelPolicy,
        recordings: Mapping[int, Recording],
        *,
        n_action_steps: int,
        encode: Encode | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """`encode` is for a network that sees latents; `tags` say which checkpoint it is."""
        self.network = network.eval()
        self.n_action_steps = n_action_steps
        self.tags: Mapping[str, str] = dict(tags or {})
        self._recordings, self._encode = recordings, encode
        self._followed: list[Recording] = []
        self._step = 0
        self._timings: dict[str, float] = {}

    def reset(self, seed: int | Sequence[int]) -> None:
        """Begin with the recordings that the seeds name. KeyError for one that there is not."""
        self._followed = [self._recordings[one] for one in ([seed] if isinstance(seed, int) else seed)]
        self._step, self._timings = 0, {}

    def act(self, observation: Observation) -> F32:
        stride = self.network.frame_stride
        steps = [self._step + p * stride for p in range(-(-self.n_action_steps // stride) + 1)]
        self._step += self.n_action_steps
        self._timings = {}
        n_pairs, n_environments = len(steps) - 1, len(self._followed)
        first, second = {}, {}
        for view in self.network.views:
            future = np.stack([[r.frame(view, step) for step in steps[1:]] for r in self._followed], axis=1)
            film = self._images(view, np.concatenate([observation.frames[view][None], future]))  # [P+1,B,…]
            first[view], second[view] = film[:-1].flatten(0, 1), film[1:].flatten(0, 1)
        later = [[r.low_dim[r.held(step)] for r in self._followed] for step in steps[1:-1]]
        low_dim = np.concatenate([observation.low_dim, *(np.stack(rows) for rows in later)])
        began = perf_counter()
        actions = self.network.act(first, second, torch.from_numpy(low_dim).to(self._device)).cpu().numpy()
        self._timings["low_level"] = perf_counter() - began
        chunk = actions.reshape(n_pairs, n_environments, stride, -1).transpose(1, 0, 2, 3)
        return np.ascontiguousarray(chunk.reshape(n_environments, n_pairs * stride, -1)[:, : self.n_action_steps])

    def timings(self) -> Mapping[str, float]:
        return dict(self._timings)

    @property
    def _device(self) -> torch.device:
        return self.network.action.mean.device

    def _images(self, view: str, film: U8) -> Tensor:
        """Frames uint8 [P+1,B,H,W,3] as the network sees them, on its device."""
        if self._encode is None:
            return torch.from_numpy(film).to(self._device)
        began = perf_counter()
        latents = self._encode(view, film.reshape(-1, *film.shape[2:]))
        self._timings["encode"] = self._timings.get("encode", 0.0) + perf_counter() - began
        return torch.from_numpy(latents.reshape(*film.shape[:2], *latents.shape[1:])).to(self._device)
