"""What every training step ends with: schedule, gradients averaged and clipped, one optimiser step, weights averaged over time."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import Literal, Protocol

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from vilp_data.errors import VilpDataError
from vilp_models.processes import Processes


class DivergedError(VilpDataError):
    """A loss or gradient is no longer a finite number."""


class Schedule(Protocol):
    """The part of a recipe that decides the learning rate of each step."""

    @property
    def steps(self) -> int: ...
    @property
    def learning_rate(self) -> float: ...
    @property
    def warmup_steps(self) -> int: ...
    @property
    def schedule(self) -> Literal["constant", "cosine"]: ...


def learning_rate(recipe: Schedule, index: int) -> float:
    """Of step `index`: linear warm-up, then constant, or half a cosine down to zero at the last step."""
    if index < recipe.warmup_steps:
        return recipe.learning_rate * (index + 1) / recipe.warmup_steps
    if recipe.schedule == "constant":
        return recipe.learning_rate
    done = (index - recipe.warmup_steps) / max(1, recipe.steps - recipe.warmup_steps)
    return recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * done))


def update(optimizer: Optimizer, loss: Tensor, *, clip_norm: float | None, processes: Processes) -> Tensor:
    """One optimiser step down the gradient of `loss`, averaged over the processes; the gradient's norm before clipping.

    Nothing waits for the device: whoever reads the norm sees there whether the step was a finite one."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    processes.average([parameter.grad for parameter in parameters if parameter.grad is not None])
    norm = torch.nn.utils.clip_grad_norm_(parameters, clip_norm or math.inf)
    optimizer.step()
    return norm.detach()


class Average:
    """The exponential moving average of a module's parameters: decay 1 - (1 + step)^-power, at most `maximum`."""

    def __init__(self, module: nn.Module, *, power: float, maximum: float) -> None:
        self.parameters = {name: parameter.detach() for name, parameter in module.named_parameters()}
        self.averages = {name: parameter.clone() for name, parameter in self.parameters.items()}
        self.power, self.maximum = power, maximum

    @torch.no_grad()
    def update(self, index: int) -> None:
        """Take in the weights after step `index`."""
        decay = min(self.maximum, 1 - (1 + index) ** -self.power)
        torch._foreach_lerp_(list(self.averages.values()), list(self.parameters.values()), 1 - decay)

    @contextlib.contextmanager
    def swapped_in(self) -> Iterator[None]:
        """The module computes with the averages inside."""
        self._swap()
        try:
            yield
        finally:
            self._swap()

    @torch.no_grad()
    def _swap(self) -> None:
        for name, parameter in self.parameters.items():
            kept = parameter.clone()
            parameter.copy_(self.averages[name])
            self.averages[name].copy_(kept)
