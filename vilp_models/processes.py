"""The processes and the device that train one model together, as `accelerate launch` set them up: a thin hold on accelerate."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence

import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import broadcast
from torch import Tensor

from vilp_models.recipe import Precision


class Processes:
    """One of `count` processes that hold the same weights; each computes on its share of every batch.

    rank     this one's number; the main one, 0, alone writes files and prints
    device   where this one computes
    """

    def __init__(self, precision: Precision = "f32", *, device: str | torch.device | None = None) -> None:
        """As the environment says (`accelerate launch`), or this process alone on `device`, such as "cuda:1". Of several processes
        each has its own accelerator, unless `device` is "cpu", which leaves them out."""
        # accelerate keeps one precision a process, and a process may train models of several, one after the other
        AcceleratorState._reset_state()
        cpu = True if device is not None and torch.device(device).type == "cpu" else None
        self._accelerator = Accelerator(mixed_precision="bf16" if precision == "bf16" else "no", cpu=bool(cpu))
        self.rank: int = self._accelerator.process_index
        self.count: int = self._accelerator.num_processes
        self.device: torch.device = self._accelerator.device
        if device is not None and self.count == 1:
            self.device = torch.device(device)

    @property
    def is_main(self) -> bool:
        return self.rank == 0

    def autocast(self) -> contextlib.AbstractContextManager[None]:
        """The forward pass in the recipe's precision."""
        context: contextlib.AbstractContextManager[None] = self._accelerator.autocast()
        return context

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its mean over the processes, in one exchange. All must call with the same shapes."""
        if self.count == 1 or not tensors:
            return
        flat = self._accelerator.reduce(torch.cat([tensor.flatten() for tensor in tensors]), "mean")
        for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(mean.view_as(tensor))

    def total(self, tensor: Tensor) -> Tensor:
        """The sum over the processes."""
        return tensor if self.count == 1 else self._accelerator.reduce(tensor, "sum")

    def any(self, here: bool) -> bool:
        """Whether it is so in any process. All must ask, and wait for each other."""
        return bool(self.total(torch.tensor(int(here), device=self.device)))

    def copy_from_main(self, tensors: Iterable[Tensor]) -> None:
        """Overwrite each tensor with the main process's."""
        if self.count > 1:
            for tensor in tensors:
                tensor.copy_(broadcast(tensor, from_process=0))

    def wait(self) -> None:
        """Until all processes are here."""
        self._accelerator.wait_for_everyone()

    def end(self) -> None:
        """Leave the others; nothing above works any more."""
        if self.count > 1:
            self.wait()
            self._accelerator.end_training()
