"""Behaviour cloning: one observation to the same chunk of actions that VILP executes. The baseline without a video."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from vilp_data.dataset import WindowTensors
from vilp_data.errors import UsageError
from vilp_data.types import F32
from vilp_models.contract import DataContract
from vilp_models.low_level import mlp
from vilp_models.normaliser import Normaliser
from vilp_models.policies.base import Observation
from vilp_models.recipe import BcRecipe
from vilp_models.vision import ResNet18
from vilp_models.vqgan import to_signed


class BcNetwork(nn.Module):
    """A ResNet-18 for each view and one MLP over their features and low_dim, which gives all actions of a chunk at once."""

    def __init__(self, recipe: BcRecipe, contract: DataContract, n_action_steps: int) -> None:
        """`n_action_steps` (paper N_e) actions t, t + 1, … are learnt from an observation at step t."""
        super().__init__()
        self.views, self.n_action_steps, self.action_size = contract.views, n_action_steps, contract.action_size
        channels = {view: contract.image_channels(view) for view in self.views}
        nets = {view: ResNet18(recipe.vision_width, n, recipe.pool) for view, n in channels.items()}
        self.vision = nn.ModuleDict(nets)
        features = sum(net.features for net in nets.values())
        self.low_dim = None
        if recipe.low_dim and contract.low_dim_size:
            self.low_dim = Normaliser(contract.normaliser["low_dim"])
            features += contract.low_dim_size
        self.head = mlp(features, recipe.hidden, n_action_steps * self.action_size)
        self.action = Normaliser(contract.normaliser["action"])

    def losses(self, batch: WindowTensors, generator: torch.Generator) -> dict[str, Tensor]:
        """{"action": mean squared error of the recorded actions, in units of their deviations}. Nothing is drawn.

        Raises UsageError where windows have no actions, or fewer than a chunk has."""
        recorded, mask = _chunk(batch, self.n_action_steps)
        predicted = self(batch.frames, batch.low_dim)
        error = (predicted - self.action.normalised(recorded)).square().mean(dim=-1)
        return {"action": (error * mask).sum() / mask.sum().clamp(min=1)}

    @torch.no_grad()
    def act(self, frames: Mapping[str, Tensor], low_dim: Tensor) -> Tensor:
        """float32 [B,n_action_steps,A] in the dataset's unit, from view -> uint8 [B,H,W,3] and low_dim float32 [B,L]."""
        return self.action.restored(self(frames, low_dim))

    def forward(self, frames: Mapping[str, Tensor], low_dim: Tensor) -> Tensor:
        """Normalised actions, float32 [B,n_action_steps,A]."""
        features = [self.vision[view](to_signed(frames[view])) for view in self.views]
        if self.low_dim is not None:
            features.append(self.low_dim.normalised(low_dim.float()))
        # In float32 even where the convolutions run in bf16, as in `low_level`.
        with torch.autocast(features[0].device.type, enabled=False):
            actions: Tensor = self.head(torch.cat([part.float() for part in features], dim=1))
        return actions.view(-1, self.n_action_steps, self.action_size)


class BcPolicy:
    """`base.Policy` with a trained network, on the device that the network is on."""

    def __init__(self, network: BcNetwork, *, tags: Mapping[str, str] | None = None) -> None:
        """`tags` say which checkpoint it is."""
        self.network = network.eval()
        self.n_action_steps = network.n_action_steps
        self.tags: Mapping[str, str] = dict(tags or {})
        self._timings: dict[str, float] = {}

    def reset(self, seed: int | Sequence[int]) -> None:
        """Nothing is remembered and nothing is random."""
        self._timings = {}

    def act(self, observation: Observation) -> F32:
        device = self.network.action.mean.device
        began = time.perf_counter()
        frames = {view: torch.as_tensor(images).to(device) for view, images in observation.frames.items()}
        actions: F32 = self.network.act(frames, torch.as_tensor(observation.low_dim).to(device)).cpu().numpy()
        self._timings = {"act": time.perf_counter() - began}
        return actions

    def timings(self) -> Mapping[str, float]:
        return dict(self._timings)


def _chunk(batch: WindowTensors, n_action_steps: int) -> tuple[Tensor, Tensor]:
    """The first actions of every window, and which of them were recorded."""
    if batch.action is None or batch.action.shape[1] < n_action_steps:
        n_there = 0 if batch.action is None else batch.action.shape[1]
        raise UsageError(
            "windows do not hold the actions of a chunk",
            found=f"n_action_steps = {n_action_steps}, windows of {n_there} actions",
            remedy="n_action_steps must be at most n_plan_frames times frame_stride, and episodes must have actions",
        )
    return batch.action[:, :n_action_steps], batch.action_mask[:, :n_action_steps]
