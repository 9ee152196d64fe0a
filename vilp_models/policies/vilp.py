"""VILP: imagine the next frames of every view, act towards them for a while, look again (paper, "Receding horizon").

    encode      the present frame's latents, where the planner or the low-level policy uses them
    condition   what the planner makes of the present, once for all denoising steps
    denoise     a clip of latents for each view
    decode      only those frames that the executed actions lead to; not at all for a low-level policy that sees latents
    act         the low-level policy between adjacent frames, the first of them the real observation

Shape suffixes: B environments, N planned frames, P pairs of adjacent frames, A action.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vilp_data.errors import UsageError
from vilp_data.types import F32, U8
from vilp_models.low_level import LowLevelPolicy
from vilp_models.planner import Planner, Sampler
from vilp_models.policies.base import Observation
from vilp_models.recipe import Precision
from vilp_models.vqgan import VqganEncoder


@dataclass(frozen=True)
class Plan:
    """actions  float32 [B,n_action_steps,A]
    latents  view -> [B,N,c,h,w], imagined, before quantisation
    films    view -> uint8 [B,1+P,H,W,C], the observation and the imagined frames that the actions lead to; empty for a low-level
             policy that sees latents
    """

    actions: F32
    latents: Mapping[str, Tensor]
    films: Mapping[str, Tensor]


class VilpPolicy:
    """`base.Policy` of planners, one a view, the views' VQGANs and a low-level policy, all on one device."""

    def __init__(
        self,
        planners: Mapping[str, Planner],
        encoders: Mapping[str, VqganEncoder],
        low_level: LowLevelPolicy,
        *,
        n_action_steps: int,
        denoising_steps: int | None = None,
        sampler: Sampler | None = None,
        precision: Precision = "f32",
        decode_all: bool = False,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """`denoising_steps` and `sampler` are the planners' recipes' unless told otherwise; `precision` is of all but encoding.
        `decode_all` decodes frames that nobody looks at too: the plain way, to measure against. `tags` say which checkpoints these
        are; how they sample is added.

        Raises UsageError for more denoising steps than there are noise levels, where the planned frames do not reach as far as
        n_action_steps, and for a low-level policy that wants to know low_dim at frames that are only imagined."""
        first = next(iter(planners.values()))
        self.n_pairs = -(-n_action_steps // low_level.frame_stride)
        if self.n_pairs > first.n_plan_frames:
            raise UsageError(
                "a plan does not reach as far as the actions to execute",
                found=f"n_action_steps = {n_action_steps}, {first.n_plan_frames} frames of {low_level.frame_stride} steps",
                remedy=f"set models.vilp.n_action_steps to at most {first.n_plan_frames * low_level.frame_stride}",
            )
        if low_level.low_dim is not None and self.n_pairs > 1:
            raise UsageError(
                "this low-level policy was trained with low_dim, which nobody knows at imagined frames",
                remedy="train it with models.policy.low_dim = false, or plan anew after each pair "
                f"(models.vilp.n_action_steps = {low_level.frame_stride})",
            )
        self.planners = {view: planner.eval() for view, planner in planners.items()}
        self.encoders, self.low_level = dict(encoders), low_level.eval()
        self.n_action_steps = n_action_steps
        n_steps = {planner.denoising_steps(denoising_steps) for planner in planners.values()}
        samplers = {sampler or planner.recipe.sampler for planner in planners.values()}
        self.tags: Mapping[str, str] = {
            **(tags or {}),
            "denoising_steps": ", ".join(map(str, sorted(n_steps))),
            "sampler": ", ".join(sorted(samplers)),
            "precision": precision,
        }
        self.device = low_level.action.mean.device
        self._steps, self._sampler, self._precision = denoising_steps, sampler, precision
        self._n_decoded = first.n_plan_frames if decode_all else self.n_pairs
        self._sees_latents = low_level.recipe.sees == "latents"
        self._encodes = self._sees_latents or any(planner.sees_latents for planner in planners.values())
        self._seeds: list[int] = []
        self._n_plans = 0
        self._timings: dict[str, float] = {}

    def reset(self, seed: int | Sequence[int]) -> None:
        """Begin anew. The noise of plan k of an environment is a function of its seed and k."""
        self._seeds = [seed] if isinstance(seed, int) else list(seed)
        self._n_plans, self._timings = 0, {}

    def timings(self) -> Mapping[str, float]:
        return dict(self._timings)

    def act(self, observation: Observation) -> F32:
        """Plan, and give the actions that lead to the planned frames: float32 [B, n_action_steps, A]."""
        return self.plan(observation).actions

    @torch.inference_mode()
    def plan(self, observation: Observation) -> Plan:
        """What `act` imagines and would do."""
        self._timings = {}
        frames = {view: torch.as_tensor(observation.frames[view]).to(self.device) for view in self.planners}
        low_dim = torch.as_tensor(observation.low_dim).to(self.device)
        present: dict[str, Tensor] = {}
        if self._encodes:
            with self._timed("encode"):  # rounded as the latents that were trained on
                present = {v: self.encoders[v].encode_tensor(images).half() for v, images in frames.items()}
        imagined = self._imagine(frames, present, low_dim)
        films: dict[str, Tensor] = {}
        if self._sees_latents:
            seen = {view: torch.cat([present[view][:, None].float(), clip], dim=1) for view, clip in imagined.items()}
        else:
            with self._timed("decode"), self._autocast():
                films = {view: self._decoded(view, frames[view], clip) for view, clip in imagined.items()}
            seen = films
        with self._timed("act"), self._autocast():
            actions = self._actions(seen, low_dim).cpu().numpy()
        self._n_plans += 1
        return Plan(actions, imagined, films)

    @torch.inference_mode()
    def imagined_frames(self, plan: Plan) -> dict[str, U8]:
        """view -> uint8 [B,P,H,W,C]: the imagined frames that a plan's actions lead to."""
        frames = {view: film[:, 1:] for view, film in plan.films.items()}
        for view, clip in plan.latents.items() if not frames else ():
            images = self.encoders[view].decode_tensor(clip[:, : self.n_pairs].flatten(0, 1))
            frames[view] = images.view(len(clip), self.n_pairs, *images.shape[1:])
        return {view: images.cpu().numpy() for view, images in frames.items()}

    def _imagine(
        self, frames: Mapping[str, Tensor], present: Mapping[str, Tensor], low_dim: Tensor
    ) -> dict[str, Tensor]:
        """View -> latents float32 [B,N,c,h,w] of what comes next."""
        with self._timed("condition"), self._autocast():
            conditions = {v: planner.condition(frames, present, low_dim) for v, planner in self.planners.items()}
        with self._timed("denoise"), self._autocast():
            return {
                view: planner.sample(
                    conditions[view], self._noise(planner.clip_shape), steps=self._steps, sampler=self._sampler
                )
                for view, planner in self.planners.items()
            }

    def _noise(self, shape: Sequence[int]) -> Tensor:
        """Unit noise [B,*shape]. Views with latents of one shape get the same."""
        drawn = [
            np.random.default_rng([seed, self._n_plans]).standard_normal(shape, np.float32) for seed in self._seeds
        ]
        return torch.from_numpy(np.stack(drawn)).to(self.device)

    def _decoded(self, view: str, now_BHWC: Tensor, clip_BNCHW: Tensor) -> Tensor:
        """The observation and the imagined frames that the actions lead to: uint8 [B,1+P,H,W,3]."""
        images = self.encoders[view].decode_tensor(clip_BNCHW[:, : self._n_decoded].flatten(0, 1))
        imagined = images.view(len(now_BHWC), self._n_decoded, *images.shape[1:])
        return torch.cat([now_BHWC[:, None], imagined[:, : self.n_pairs]], dim=1)

    def _actions(self, film: Mapping[str, Tensor], low_dim: Tensor) -> Tensor:
        """From films [B,1+P or more,…] of every view to [B,n_action_steps,A]."""
        n_pairs, size = self.n_pairs, len(low_dim)
        first = {view: images[:, :n_pairs].flatten(0, 1) for view, images in film.items()}
        second = {view: images[:, 1 : n_pairs + 1].flatten(0, 1) for view, images in film.items()}
        actions = self.low_level.act(first, second, low_dim.repeat_interleave(n_pairs, dim=0))
        return actions.view(size, -1, actions.shape[-1])[:, : self.n_action_steps]

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._precision == "bf16")

    @contextlib.contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self._timings[part] = self._timings.get(part, 0.0) + time.perf_counter() - started
