"""The training loop, one for every model: steps, a bar, curves, checkpoints, and an end that loses nothing."""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor
from tqdm import tqdm

from vilp_models.checkpoint import Arrays, Checkpoint, RunState, load_checkpoint, read_state, save_checkpoint
from vilp_models.curves import Curves
from vilp_models.model_training import Clips
from vilp_models.optimisation import DivergedError
from vilp_models.processes import Processes

CHECKPOINT_EVERY_S = 240.0

READ_EVERY = 20
"""Steps between two looks at the losses, each of which waits for the device: for the bar, the curves and divergence."""

CLIPS = 4
"""How often in a run clips are drawn, the last time at its end."""


class Trainee(Protocol):
    """What the loop trains. Step i must depend on i and the saved state alone."""

    @property
    def waited_s(self) -> float:
        """Seconds that steps have waited for data so far."""
        ...

    def step(self, index: int) -> dict[str, Tensor]:
        """One optimiser step; losses and gradient norms by name, as scalars that stay on the device."""
        ...

    def save(self) -> tuple[Arrays, Arrays]:
        """(the model's tensors, the rest of the state)."""
        ...

    def restore(self, model: Arrays, trainer: Arrays) -> None: ...

    def clips(self) -> Clips:
        """What the model makes of a few examples now, to look at."""
        ...

    def close(self) -> None:
        """Let go of threads and files."""
        ...


def fit(
    trainee: Trainee,
    run: Path,
    state: RunState,
    recipe: Mapping[str, Any],
    processes: Processes,
    *,
    unit: str = "samples",
    per_step: int = 1,
    resume: bool = True,
    show: bool = True,
    checkpoint_every_s: float = CHECKPOINT_EVERY_S,
) -> RunState:
    """Train to `state.steps`, from the checkpoint in `run` where there is one; save on the way, at the end, on Ctrl-C.

    Without `resume` training begins at the first step, and the first checkpoint replaces the one that is there.

    `per_step` of `unit` is what the bar counts besides steps. An error leaves the last checkpoint as it is, and
    DivergedError comes before one that would hold what is not finite. Of several processes the main one writes and
    prints; all stop together, Ctrl-C within READ_EVERY steps.
    """
    first = 0
    if resume and read_state(run) is not None:
        checkpoint = load_checkpoint(run)
        trainee.restore(checkpoint.model, checkpoint.trainer)
        first = checkpoint.state.step
    loop = _Loop(trainee, run, state, recipe, processes, first=first, checkpoint_every_s=checkpoint_every_s)
    label = f"{state.model} {run.name}"
    with (
        contextlib.closing(trainee),
        _stop_on_interrupt() as stop,
        _bar(label, first, state.steps, show=show and processes.is_main) as bar,
        loop.writing(),
    ):
        rate = _Rate(trainee, unit, per_step)
        for index in range(first, state.steps):
            losses = trainee.step(index)
            loop.watch(losses)
            rate.steps += 1
            if index % READ_EVERY == 0 or index + 1 == state.steps:
                values = loop.read(index, losses)
                bar.set_postfix({"loss": f"{_total(values):.4f}", **rate.shown()}, refresh=False)
                loop.draw(index, {**_curves(values), **rate.curves()})
            bar.update()
            if loop.stops(index, stop):
                loop.save(index + 1)
                raise KeyboardInterrupt
            loop.after(index)
    loop.save(state.steps)
    return loop.wanted(state.steps)


class _Loop:
    """What the loop writes: checkpoints, curves, clips; and what it must know first: that all is finite."""

    def __init__(
        self,
        trainee: Trainee,
        run: Path,
        state: RunState,
        recipe: Mapping[str, Any],
        processes: Processes,
        *,
        first: int,
        checkpoint_every_s: float,
    ) -> None:
        self._trainee, self._run, self._state, self._recipe = trainee, run, state, recipe
        self._processes, self._first, self._every_s = processes, first, checkpoint_every_s
        self._finite = torch.ones((), dtype=torch.bool, device=processes.device)
        self._curves: Curves | None = None
        self._saved_s = time.monotonic()
        self._drawn = {state.steps * turn // CLIPS for turn in range(1, CLIPS + 1)}

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Curves are open inside, in the main process."""
        if self._processes.is_main:
            self._curves = Curves(self._run, first=self._first)
        try:
            yield
        finally:
            if self._curves is not None:
                self._curves.close()

    def watch(self, losses: Mapping[str, Tensor]) -> None:
        """Remember, on the device, whether every value so far was finite."""
        values = torch.stack([loss.float().reshape(()) for loss in losses.values()])
        self._finite = self._finite & torch.isfinite(values).all()

    def read(self, index: int, losses: Mapping[str, Tensor]) -> dict[str, float]:
        """The losses of step `index` as numbers. Raises DivergedError where they, or an earlier step's, are not finite."""
        values = {name: loss.item() for name, loss in losses.items()}
        if not self._finite:
            broken = [f"{name} {value:g}" for name, value in values.items() if not math.isfinite(value)]
            raise DivergedError(
                f"training diverged: not all is finite at step {index}",
                where=self._run,
                found=", ".join(broken) or "a value of an earlier step",
                remedy=f"lower models.{self._state.model}.learning_rate or set clip_norm; the last checkpoint is kept",
            )
        return values

    def stops(self, index: int, stop: threading.Event) -> bool:
        """Whether Ctrl-C was pressed; several processes ask each other, when they look at the losses."""
        if self._processes.count == 1:
            return stop.is_set()
        if index % READ_EVERY:
            return False
        pressed = torch.tensor(int(stop.is_set()), device=self._processes.device)
        return bool(self._processes.total(pressed))

    def after(self, index: int) -> None:
        """Draw clips and save where it is time to."""
        if not self._processes.is_main:
            return
        if self._curves is not None and index + 1 in self._drawn:
            self._curves.clips(index + 1, self._trainee.clips())
        if time.monotonic() - self._saved_s > self._every_s:
            self.save(index + 1)
            self._saved_s = time.monotonic()

    def draw(self, index: int, values: Mapping[str, float]) -> None:
        if self._curves is not None:
            self._curves.scalars(index + 1, values)

    def save(self, step: int) -> None:
        """Write the checkpoint, in the main process. Raises DivergedError where a value since the last look was not finite."""
        if self._processes.is_main:
            self.read(step - 1, {})
            save_checkpoint(self._run, Checkpoint(*self._trainee.save(), self._recipe, self.wanted(step)))
        if self._processes.count > 1 and step == self._state.steps:
            self._processes.wait()

    def wanted(self, step: int) -> RunState:
        return replace(self._state, step=step)


class _Rate:
    """How fast the loop goes, and which share of the time it waited for data."""

    def __init__(self, trainee: Trainee, unit: str, per_step: int) -> None:
        self._trainee, self._unit, self._per_step = trainee, unit, per_step
        self._start_s, self._waited_s = time.perf_counter(), trainee.waited_s
        self.steps = 0

    def _now(self) -> tuple[float, float]:
        took_s = max(1e-9, time.perf_counter() - self._start_s)
        return self.steps * self._per_step / took_s, (self._trainee.waited_s - self._waited_s) / took_s

    def shown(self) -> dict[str, str]:
        per_second, waiting = self._now()
        return {f"{self._unit}/s": f"{per_second:.0f}", "waiting": f"{waiting:.1%}"}

    def curves(self) -> dict[str, float]:
        per_second, waiting = self._now()
        return {f"speed/{self._unit} per second": per_second, "speed/share waiting for data": waiting}


def _curves(values: Mapping[str, float]) -> dict[str, float]:
    return {
        f"{'gradient' if name.endswith('gradient_norm') else 'loss'}/{name}": value for name, value in values.items()
    }


def _total(values: Mapping[str, float]) -> float:
    return sum(value for name, value in values.items() if not name.endswith("gradient_norm"))


def _bar(label: str, first: int, steps: int, *, show: bool) -> tqdm[None]:
    """A bar that moves on a terminal, and twice a minute where its output is kept, as in CI's log."""
    every_s = 0.1 if sys.stderr.isatty() else 30.0
    return tqdm(
        total=steps, initial=first, desc=label, unit="step", disable=not show, mininterval=every_s, maxinterval=every_s
    )


@contextlib.contextmanager
def _stop_on_interrupt() -> Iterator[threading.Event]:
    """The first Ctrl-C sets the event, so that a step is never cut in half; a second one interrupts as usual."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.getsignal(signal.SIGINT)

    def on_interrupt(_number: int, _frame: object) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)
