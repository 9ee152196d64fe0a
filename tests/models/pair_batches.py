"""Small random batches and the contract they fulfil, for tests of networks that need no dataset."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from vilp_data.dataset import WindowTensors
from vilp_data.pairs import PairTensors
from vilp_models.contract import DataContract

VIEWS = ("front", "side")
STRIDE, N_PLAN_FRAMES = 2, 3
LATENT_SHAPE = (3, 4, 6)
HEIGHT, WIDTH = 32, 48


def contract(views: tuple[str, ...] = VIEWS, **changes: Any) -> DataContract:
    """Two cameras, low_dim of 4 and actions of 2 columns, none of them of mean 0 and deviation 1."""
    moments = {"mean": [0.5, -0.25, 1.0], "std": [2.0, 0.5, 1.5]}
    made = DataContract(
        task="test",
        views=views,
        geometry=dict.fromkeys(views, (HEIGHT, WIDTH, "")),
        rate_hz=10.0,
        frame_stride=STRIDE,
        n_plan_frames=N_PLAN_FRAMES,
        latent_keys=dict.fromkeys(views, "key"),
        latent_shapes=dict.fromkeys(views, LATENT_SHAPE),
        low_dim_size=4,
        action_size=2,
        normaliser={f"latents/{view}": moments for view in views}
        | {"low_dim": {"mean": [1.0] * 4, "std": [2.0] * 4}, "action": {"mean": [100.0, -5.0], "std": [40.0, 2.0]}},
    )
    return replace(made, **changes)


def codebooks(n_codes: int = 16) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return {view: torch.randn(n_codes, LATENT_SHAPE[0], generator=generator) for view in VIEWS}


def pairs(size: int = 8) -> PairTensors:
    random = torch.Generator().manual_seed(0)
    return PairTensors(
        frames={v: torch.randint(256, (size, 2, HEIGHT, WIDTH, 3), generator=random).to(torch.uint8) for v in VIEWS},
        latents={v: torch.randn(size, 2, *LATENT_SHAPE, generator=random).half() for v in VIEWS},
        low_dim=1 + 2 * torch.randn(size, 4, generator=random),
        action=_actions(size, STRIDE, random),
        episode=torch.zeros(size, dtype=torch.int64),
        step=torch.arange(size),
    )


def window_batch(size: int = 8) -> WindowTensors:
    """Every action recorded."""
    random = torch.Generator().manual_seed(0)
    n_actions = N_PLAN_FRAMES * STRIDE
    return WindowTensors(
        frames={v: torch.randint(256, (size, HEIGHT, WIDTH, 3), generator=random).to(torch.uint8) for v in VIEWS},
        latents={v: torch.randn(size, N_PLAN_FRAMES, *LATENT_SHAPE, generator=random).half() for v in VIEWS},
        present_latents={v: torch.randn(size, *LATENT_SHAPE, generator=random).half() for v in VIEWS},
        latent_mask=torch.ones(size, N_PLAN_FRAMES, dtype=torch.bool),
        low_dim=1 + 2 * torch.randn(size, 4, generator=random),
        action=_actions(size, n_actions, random),
        action_mask=torch.ones(size, n_actions, dtype=torch.bool),
        episode=torch.zeros(size, dtype=torch.int64),
        step=torch.arange(size),
    )


def _actions(size: int, length: int, random: torch.Generator) -> torch.Tensor:
    return torch.tensor([100.0, -5.0]) + torch.tensor([40.0, 2.0]) * torch.randn(size, length, 2, generator=random)


def overfit(network: torch.nn.Module, batch: Any, *, steps: int, learning_rate: float = 2e-3) -> tuple[float, float]:
    """The loss on one batch before and after so many steps of Adam on it."""
    optimiser = torch.optim.Adam(network.parameters(), lr=learning_rate)
    generator = torch.Generator().manual_seed(0)
    losses = []
    for _ in range(steps):
        loss = sum(network.losses(batch, generator).values())  # type: ignore[operator]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    return losses[0], losses[-1]
