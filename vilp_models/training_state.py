"""Modules and optimisers as named arrays, and back: what checkpoints hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from vilp_models.checkpoint import Arrays


def arrays_of(tensors: Mapping[str, Tensor], *, prefix: str = "") -> Arrays:
    """Copies in main memory, under `prefix`."""
    return {f"{prefix}{name}": _array(tensor) for name, tensor in tensors.items()}


def under(prefix: str, arrays: Arrays) -> Arrays:
    """The arrays whose names begin with `prefix`, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def load_arrays(module: nn.Module, arrays: Arrays) -> None:
    """Overwrite the module's tensors. RuntimeError where names or shapes are others."""
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    for name, tensor in module.state_dict().items():
        if tensor.ndim == 0 and name in tensors:  # files hold no scalars, only vectors of one
            tensors[name] = tensors[name].reshape(())
    module.load_state_dict(tensors)


def optimizer_arrays(optimizer: Optimizer, *, prefix: str) -> Arrays:
    """What the optimiser remembers of each parameter, as <prefix><number>/<name>."""
    state: Mapping[int, Mapping[str, Tensor]] = optimizer.state_dict()["state"]
    return {
        f"{prefix}{number}/{name}": _array(value)
        for number, moments in state.items()
        for name, value in moments.items()
    }


def load_optimizer(optimizer: Optimizer, arrays: Arrays, *, prefix: str) -> None:
    """The inverse of `optimizer_arrays`; parameters must come in the same order."""
    state: dict[int, dict[str, Any]] = {}
    for path, array in under(prefix, arrays).items():
        number, name = path.split("/")
        state.setdefault(int(number), {})[name] = torch.from_numpy(array.reshape(()) if name == "step" else array)
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to("cpu", copy=True).contiguous().numpy()
