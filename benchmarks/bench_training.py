"""A training step of the planner from cached latents, against the same step that runs the VQGAN's encoder on the same frames first.

Both do the same optimiser steps on the same windows, in turns; the ratio is of medians. The share of a step that waits for its batch is
measured in the same steps. Networks have random weights.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from bench_loading import KEYS, VIEWS, write_dataset, write_split

from vilp_data.dataset import WindowDataset, WindowTensors
from vilp_data.spec import WindowSpec
from vilp_models.contract import DataContract
from vilp_models.model_training import ModelTraining
from vilp_models.planner import Planner
from vilp_models.processes import Processes
from vilp_models.recipe import PlannerRecipe, VqganRecipe, load_recipe
from vilp_models.trained import default_device
from vilp_models.vqgan import VqganEncoder, build_vqgan

VIEW = VIEWS[0]


class EncodesOnline(Planner):
    """The same planner without the cache: every planned frame goes through the encoder in every step, as published."""

    encoder: VqganEncoder
    frames: torch.Tensor  # uint8 [B N,H,W,3]; what is in them does not matter to the clock

    def losses(self, batch: WindowTensors, generator: torch.Generator) -> dict[str, torch.Tensor]:
        size, n_frames = batch.latents[VIEW].shape[:2]
        latents = self.encoder.encode_tensor(self.frames[: size * n_frames]).clone()  # clone: out of inference mode
        batch.latents[VIEW].copy_(latents.view(size, n_frames, *latents.shape[1:]))
        return super().losses(batch, generator)


def trainings(
    root: Path, recipe: PlannerRecipe, vqgan: VqganRecipe, *, height: int, width: int, n_frames: int
) -> dict[str, ModelTraining]:
    ones = {"mean": [0.0] * 3, "std": [1.0] * 3}
    contract = DataContract(
        task="bench", views=(VIEW,), geometry={VIEW: (height, width, "")}, rate_hz=10.0, frame_stride=2,
        n_plan_frames=n_frames, latent_keys={VIEW: KEYS[VIEW]}, latent_shapes={VIEW: (3, height // 8, width // 8)},
        normaliser={f"latents/{VIEW}": ones},
    )  # fmt: skip
    window = WindowSpec(n_plan_frames=n_frames, frame_stride=2)
    dataset = WindowDataset(root, split="train", latent_keys={VIEW: KEYS[VIEW]}, window=window, with_actions=False)
    processes = Processes(recipe.precision)
    cached = ModelTraining(recipe, lambda: Planner(recipe, contract, VIEW), dataset, processes)
    online = ModelTraining(recipe, lambda: EncodesOnline(recipe, contract, VIEW), dataset, processes)
    online.module.encoder = VqganEncoder(build_vqgan(vqgan), precision=recipe.precision, device=processes.device)
    shape = (recipe.batch_size * n_frames, height, width, 3)
    online.module.frames = torch.randint(0, 256, shape, dtype=torch.uint8, device=processes.device)
    return {"cached latents": cached, "encoding online": online}


def step_seconds(training: ModelTraining, index: int) -> float:
    started = time.perf_counter()
    losses: dict[str, Any] = training.step(index)
    float(losses["denoising"])  # waits for the device
    return time.perf_counter() - started


def report(title: str, given: Sequence[ModelTraining], names: Sequence[str], *, steps: int) -> None:
    seconds: list[list[float]] = [[] for _ in given]
    waited = given[0].waited_s
    for index in range(steps + 1):
        for row, training in zip(seconds, given, strict=True):
            row.append(step_seconds(training, index))
        if index == 0:
            waited = given[0].waited_s
    middle = [statistics.median(row[1:]) for row in seconds]
    share = (given[0].waited_s - waited) / sum(seconds[0][1:])
    print(f"\n{title}")
    for name, value in zip(names, middle, strict=True):
        print(f"  {name:<18}{value:7.3f} s a step   {value / middle[0]:5.2f}x")
    print(f"  waiting for data: {share:.2%} of a step from cached latents")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--steps", type=int, default=5)
    arguments.add_argument(
        "--batch", type=int, default=2, help="of the paper's planner; its own 64 needs an accelerator"
    )
    given = arguments.parse_args()
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads, {default_device()}")
    small = {
        **load_recipe(PlannerRecipe, "planner", {}, preset="cpu", where="bench").model_dump(),
        "condition": "concat",
    }
    tiny_vqgan = load_recipe(VqganRecipe, "vqgan", {}, preset="cpu", where="bench")
    for height, width, n_frames in ((96, 96, 12), (96, 160, 6)):
        with tempfile.TemporaryDirectory(prefix="vilp-bench-") as folder:
            root = Path(folder)
            write_dataset(root, n_episodes=10, n_steps=60, height=height, width=width)
            write_split(root, ratio=0.9)
            paper = PlannerRecipe(low_dim=False, batch_size=given.batch)
            cpu = PlannerRecipe.model_validate(small)
            for name, recipe, vqgan in (
                ("paper (planner 64, VQGAN 128)", paper, VqganRecipe()),
                ("cpu", cpu, tiny_vqgan),
            ):
                made = trainings(root, recipe, vqgan, height=height, width=width, n_frames=n_frames)
                title = f"{name}: {height}x{width}, {n_frames} frames, batch {recipe.batch_size}, {recipe.precision}"
                report(title, list(made.values()), list(made), steps=given.steps)
                for training in made.values():
                    training.close()


if __name__ == "__main__":
    main()
