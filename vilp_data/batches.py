"""Batches of tensors: what every kind of sample has in common once it is one.

A batch's tensors share one block of memory, page-locked on request, and move between devices together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import torch

_ALIGNMENT = 64

Layout = Mapping[str, tuple[tuple[int, ...], torch.dtype]]
"""name -> shape and type of each tensor to allocate."""


@dataclass(frozen=True)
class TensorBatch:
    """A dataclass whose fields are tensors, mappings of tensors, or None; `step` [B] is one of them."""

    step: torch.Tensor

    def __len__(self) -> int:
        return len(self.step)

    def to(self, device: torch.device | str) -> Self:
        """The same samples on another device; copies from pinned memory do not block."""
        return self.map(lambda tensor: tensor.to(device, non_blocking=True))

    def map(self, function: Callable[[torch.Tensor], torch.Tensor]) -> Self:
        """The same samples with `function` applied to every tensor."""
        moved: dict[str, Any] = {}
        for name in (item.name for item in fields(self)):
            value = getattr(self, name)
            if isinstance(value, dict):
                moved[name] = {view: function(tensor) for view, tensor in value.items()}
            else:
                moved[name] = None if value is None else function(value)
        return type(self)(**moved)


def allocated(layout: Layout, *, pin_memory: bool) -> dict[str, torch.Tensor]:
    """Uninitialised tensors that share one block of memory: many blocks of several MB a batch would fragment the heap."""
    begins, end = [], 0
    for shape, dtype in layout.values():
        begins.append(end)
        end += -(-math.prod(shape) * dtype.itemsize // _ALIGNMENT) * _ALIGNMENT
    block = _block(end, pin_memory=pin_memory)
    return {
        name: block[begin : begin + math.prod(shape) * dtype.itemsize].view(dtype).view(shape)
        for begin, (name, (shape, dtype)) in zip(begins, layout.items(), strict=True)
    }


def _block(n_bytes: int, *, pin_memory: bool) -> torch.Tensor:
    if pin_memory:
        return torch.empty(n_bytes, dtype=torch.uint8, pin_memory=True)
    # torch would ask for aligned memory, and glibc's heap grows on that instead of reusing what was freed: 50 MB more
    return torch.from_numpy(np.empty(n_bytes, np.uint8))
