"""Training of every module that knows its own loss: planner, low-level policy, behaviour cloning."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer

from vilp_data.loader import BatchReader, Loader
from vilp_data.types import U8
from vilp_models.checkpoint import Arrays
from vilp_models.optimisation import Average, learning_rate, update
from vilp_models.processes import Processes
from vilp_models.recipe import TrainingRecipe
from vilp_models.training_state import arrays_of, load_arrays, load_optimizer, optimizer_arrays, under

Clips = Mapping[str, U8]
"""name -> uint8 [T,H,W,3], to be looked at while training runs."""


class Batch(Protocol):
    """What a dataset hands out: `WindowTensors`, `PairTensors`."""

    def to(self, device: torch.device | str) -> Self: ...


class LearningModule(Protocol):
    """What is trained here: an `nn.Module` with its own loss."""

    def losses(self, batch: Any, generator: torch.Generator) -> dict[str, Tensor]:
        """Scalars by name, whose sum is minimised. All that is random comes from `generator`, on the batch's device."""
        ...


class ModelTraining:
    """A module with its optimiser, its average and its place in the data.

    Step i is a function of recipe, dataset, i and the saved state alone (the batch of (seed, i), a generator of
    (seed, i, rank)), so saving and restoring between any two steps changes nothing.
    """

    def __init__(
        self,
        recipe: TrainingRecipe,
        build: Callable[[], LearningModule],
        dataset: BatchReader[Any],
        processes: Processes,
        *,
        clips: Callable[[nn.Module], Clips] | None = None,
    ) -> None:
        """`build` makes the untrained module, from torch's random state of the recipe's seed; `clips` draws what `clips()` returns
        from the module as it is used.

        Raises UsageError where no whole batch fits the dataset, or the processes cannot share one evenly."""
        self.recipe, self.processes = recipe, processes
        with torch.random.fork_rng():
            torch.manual_seed(recipe.seed)
            module = build()
        assert isinstance(module, nn.Module)
        self._losses = module.losses
        self.module: nn.Module = module.to(processes.device).train()
        self._clips = clips
        self.optimizer = adamw(self.module, recipe)
        averages = recipe.ema_power > 0 and recipe.ema_max > 0
        self.average = Average(self.module, power=recipe.ema_power, maximum=recipe.ema_max) if averages else None
        self._batches = BatchesInOrder(dataset, recipe, processes)
        self._generator = torch.Generator(processes.device)

    @property
    def waited_s(self) -> float:
        """Seconds that steps have waited for their batches."""
        return self._batches.waited_s

    def step(self, index: int) -> dict[str, Tensor]:
        """Do step `index`; its losses and the gradient's norm, as scalars on the device: nothing waits for it."""
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.recipe, index)
        batch = self._batches.of_step(index).to(self.processes.device)
        self._generator.manual_seed(step_seed(self.recipe.seed, index, self.processes.rank))
        with self.processes.autocast():
            losses = self._losses(batch, self._generator)
        total = torch.stack([loss.float() for loss in losses.values()]).sum()
        norm = update(self.optimizer, total, clip_norm=self.recipe.clip_norm, processes=self.processes)
        if self.average is not None:
            self.average.update(index)
        return {**{name: loss.detach() for name, loss in losses.items()}, "gradient_norm": norm}

    def clips(self) -> Clips:
        """What the averaged weights make of a few examples."""
        if self._clips is None:
            return {}
        self.module.eval()
        try:
            with torch.no_grad():
                if self.average is None:
                    return self._clips(self.module)
                with self.average.swapped_in():
                    return self._clips(self.module)
        finally:
            self.module.train()

    def save(self) -> tuple[Arrays, Arrays]:
        """(the tensors others load, averaged where the recipe averages; all else that resuming needs)."""
        trainer = optimizer_arrays(self.optimizer, prefix="optimizer/")
        model = arrays_of(self.module.state_dict())
        if self.average is not None:
            trainer |= arrays_of(self.average.parameters, prefix="weights/")
            model |= arrays_of(self.average.averages)
        return model, trainer

    def restore(self, model: Arrays, trainer: Arrays) -> None:
        """The inverse of `save`."""
        load_arrays(self.module, {**model, **under("weights/", trainer)})
        if self.average is not None:
            for name, average in self.average.averages.items():
                average.copy_(torch.from_numpy(model[name].reshape(average.shape)))
        load_optimizer(self.optimizer, trainer, prefix="optimizer/")

    def close(self) -> None:
        """End the thread that reads ahead."""
        self._batches.close()


class BatchesInOrder:
    """The batch of any step, read ahead while steps come in order. Counts the seconds that it was waited for."""

    def __init__(self, dataset: BatchReader[Any], recipe: TrainingRecipe, processes: Processes) -> None:
        self._seed = recipe.seed
        self._loader: Loader[Any] = Loader(
            dataset,
            batch_size=recipe.batch_size,
            seed=recipe.seed,
            rank=processes.rank,
            n_ranks=processes.count,
            pin_memory=processes.device.type == "cuda",
        )
        self._batches: Iterator[Any] | None = None
        self._next = -1
        self.waited_s = 0.0

    def of_step(self, index: int) -> Any:
        """This process's share of batch `index`, counted through the epochs."""
        started = time.perf_counter()
        epoch, step = divmod(index, len(self._loader))
        if self._batches is None or index != self._next or step == 0:
            self.close()
            self._loader.load_state_dict({"seed": self._seed, "epoch": epoch, "step": step})
            self._batches = iter(self._loader)
        batch = next(self._batches)
        self._next = index + 1
        self.waited_s += time.perf_counter() - started
        return batch

    def close(self) -> None:
        if self._batches is not None:
            self._batches.close()  # type: ignore[attr-defined]
            self._batches = None


def adamw(module: nn.Module, recipe: TrainingRecipe) -> Optimizer:
    """AdamW in which norms and biases (all that is a vector) do not decay."""
    trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
    groups = [
        {"params": [parameter for parameter in trained if parameter.ndim > 1], "weight_decay": recipe.weight_decay},
        {"params": [parameter for parameter in trained if parameter.ndim <= 1], "weight_decay": 0.0},
    ]
    return AdamW([group for group in groups if group["params"]], recipe.learning_rate, recipe.betas)


def step_seed(seed: int, index: int, rank: int) -> int:
    """A seed for torch's generators, well mixed even in the 32 bits that its CPU generator takes."""
    return int(np.random.Philox(key=seed, counter=[0, 0, rank, index]).random_raw()) >> 1
