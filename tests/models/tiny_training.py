"""A module, a dataset without files and a loop that train in milliseconds, for tests of training itself."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vilp_models.checkpoint import RunState
from vilp_models.model_training import ModelTraining
from vilp_models.processes import Processes
from vilp_models.recipe import TrainingRecipe
from vilp_models.training_loop import Trainee, fit


@dataclass
class Points:
    """Samples of a plane: x float32 [B,3], their numbers int64 [B]."""

    x: Tensor
    number: Tensor

    def to(self, device: torch.device | str) -> Points:
        return Points(self.x.to(device), self.number.to(device))


class PointDataset:
    """`n` points, each a function of its number; `read` remembers which were asked for."""

    def __init__(self, n: int = 40) -> None:
        self.points = torch.from_numpy(np.random.default_rng(0).normal(size=(n, 3)).astype(np.float32))
        self.asked: list[list[int]] = []

    def __len__(self) -> int:
        return len(self.points)

    def read(self, numbers: np.ndarray, *, pin_memory: bool = False) -> Points:
        self.asked.append(numbers.tolist())
        return Points(self.points[numbers], torch.from_numpy(numbers))


class Plane(nn.Module):
    """Learns x·(1, -2, 3) + 0.5 from points with noise on them; its buffer is a constant of the data."""

    def __init__(self, noise: float = 0.1) -> None:
        super().__init__()
        self.noise = noise
        self.hidden, self.norm, self.out = nn.Linear(3, 8), nn.LayerNorm(8), nn.Linear(8, 1)
        self.register_buffer("offset", torch.tensor(0.5))

    def losses(self, batch: Points, generator: torch.Generator) -> dict[str, Tensor]:
        wanted = batch.x @ batch.x.new_tensor([1.0, -2.0, 3.0]) + self.offset
        seen = batch.x + self.noise * torch.randn(batch.x.shape, generator=generator, device=batch.x.device)
        found = self.out(F.silu(self.norm(self.hidden(seen)))).squeeze(1)
        return {"fit": F.mse_loss(found.float(), wanted), "size": 1e-3 * self.out.weight.square().mean()}


def plane_recipe(**changes: Any) -> TrainingRecipe:
    table = {"steps": 12, "batch_size": 8, "learning_rate": 1e-2, "warmup_steps": 2, "ema_max": 0.9}
    return TrainingRecipe.model_validate({**table, **changes})


def plane_training(processes: Processes | None = None, *, noise: float = 0.1, **changes: Any) -> ModelTraining:
    recipe = plane_recipe(**changes)
    return ModelTraining(
        recipe, lambda: Plane(noise), PointDataset(), processes or Processes(recipe.precision, device="cpu")
    )


def fit_to(run: Path, trainee: Trainee, steps: int, processes: Processes | None = None, **options: Any) -> RunState:
    """`fit` without a bar, for a run of `steps` steps."""
    processes = processes or Processes(device="cpu")
    return fit(trainee, run, RunState(0, steps, ("v",), "s", {"a": "key-a"}), {}, processes, show=False, **options)


def killed_at(step: int, trainee: Trainee, go: Callable[[], object]) -> None:
    """Run `go`, which trains `trainee`, in a process of its own that is killed in the middle of `step`."""
    child = os.fork()
    if child == 0:
        original = trainee.step

        def step_or_die(index: int) -> dict[str, Tensor]:
            if index == step:
                os.kill(os.getpid(), signal.SIGKILL)
            return original(index)

        trainee.step = step_or_die  # type: ignore[method-assign]
        try:
            go()
        finally:
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status)
    assert os.WTERMSIG(status) == signal.SIGKILL


def in_two_processes(task: Callable[[Processes], dict[str, np.ndarray]], folder: Path) -> list[dict[str, np.ndarray]]:
    """What `task` gives in each of two processes that train together, exchanging gradients over gloo."""
    import socket

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder.mkdir(parents=True, exist_ok=True)
    children = []
    for rank in range(2):
        child = os.fork()
        if child == 0:
            try:
                _be_rank(rank, port)
                processes = Processes(device="cpu")
                arrays = task(processes)
                np.savez(folder / f"{rank}.npz", **arrays)
                processes.end()
                os._exit(0)
            except BaseException:
                import traceback

                traceback.print_exc()
                os._exit(1)
        children.append(child)
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0]
    return [dict(np.load(folder / f"{rank}.npz")) for rank in range(2)]


def _be_rank(rank: int, port: int) -> None:
    from accelerate.state import AcceleratorState

    AcceleratorState._reset_state(reset_partial_state=True)
    os.environ.update(
        RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE="2", LOCAL_WORLD_SIZE="2",
        MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), ACCELERATE_USE_CPU="true",
    )  # fmt: skip
    torch.set_num_threads(1)
