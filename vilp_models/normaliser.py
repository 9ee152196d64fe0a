"""Mean and deviation of training values as part of a network, so that a checkpoint carries what it was trained with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn


class Normaliser(nn.Module):
    """(x - mean) / std along the channel axis, and back. Nothing here is trained."""

    mean: Tensor
    std: Tensor

    def __init__(self, moments: Mapping[str, Sequence[float]], *, axis: int = -1) -> None:
        """`moments` is {"mean": [C], "std": [C]}; `axis`, negative, is where values have their channels."""
        super().__init__()
        after = (1,) * (-axis - 1)
        for name in ("mean", "std"):
            self.register_buffer(name, torch.tensor(moments[name], dtype=torch.float32).view(-1, *after))

    def normalised(self, values: Tensor) -> Tensor:
        return (values - self.mean) / self.std

    def restored(self, normalised: Tensor) -> Tensor:
        return normalised * self.std + self.mean
