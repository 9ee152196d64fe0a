"""Training: one loop for every model here, and what each model needs to enter it."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from tqdm import tqdm

from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import BusyError, UsageError, nearest
from vilp_data.shards import writer_lock
from vilp_data.spec import TaskSpec
from vilp_models.checkpoint import (
    FILE,
    Arrays,
    Checkpoint,
    RunState,
    load_checkpoint,
    read_recipe,
    read_state,
    run_folder,
    save_checkpoint,
)
from vilp_models.frames import TrainingFrames, open_clips
from vilp_models.recipe import VqganRecipe
from vilp_models.vqgan_training import VqganTraining

CHECKPOINT_EVERY_S = 240.0


class Trainee(Protocol):
    """What the loop trains. Step i must depend on i and the saved state alone."""

    def step(self, index: int) -> dict[str, float]:
        """One optimiser step; its losses by name."""
        ...

    def save(self) -> tuple[Arrays, Arrays]:
        """(the model's tensors, the rest of the state)."""
        ...

    def restore(self, model: Arrays, trainer: Arrays) -> None: ...


def train_vqgan(
    dataset_dir: Path,
    spec: TaskSpec,
    recipe: VqganRecipe,
    run_dir: Path,
    *,
    train_episodes: Sequence[str],
    split_hash: str,
    restart: bool = False,
    device: str | None = None,
    show: bool = True,
) -> list[RunState]:
    """Train one VQGAN a view, or one for all views where the recipe shares it, on frames of `train_episodes` alone.

    A finished run with this recipe is left alone; an unfinished one goes on exactly where it stopped. Returns where each
    run ended. Raises UsageError where a run in `run_dir` has another recipe, or an unfinished one other episodes
    (`restart` begins those anew), BusyError where another process trains into it, DivergedError where a loss stops being
    finite, KeyboardInterrupt on Ctrl-C, saved.
    """
    store = EpisodeStore(dataset_dir)
    entries = {entry.id: entry for entry in store.index()}
    for episode in train_episodes:
        if episode not in entries:
            raise UsageError(f"no episode called {episode!r}", where=dataset_dir, remedy=nearest(episode, entries))
    episodes = [entries[episode] for episode in sorted(train_episodes)]
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    groups = [tuple(sorted(spec.views))] if recipe.share_views else [(view,) for view in sorted(spec.views)]
    states = []
    for views in groups:
        run = run_folder(run_dir, views)
        wanted = RunState(0, recipe.steps, views, split_hash, {entry.id: entry.key for entry in episodes})
        with _only_trainer(run):
            if restart:
                (run / FILE).unlink(missing_ok=True)
            states.append(_train_run(store, episodes, recipe, run, wanted, device=device, show=show))
    return states


def _train_run(
    store: EpisodeStore,
    episodes: Sequence[EpisodeEntry],
    recipe: VqganRecipe,
    run: Path,
    wanted: RunState,
    *,
    device: str,
    show: bool,
) -> RunState:
    """Bring one run to its end, or leave it alone where it is there."""
    label, table = f"VQGAN {'+'.join(wanted.views)}", recipe.model_dump(mode="json")
    earlier = read_state(run)
    if earlier is not None and not _must_train(run, table, wanted, earlier):
        if show:
            print(f"{label}: trained already, {earlier.steps} steps{_unseen(earlier, wanted)}")
        return earlier
    clips = open_clips(store, episodes, wanted.views)
    trainee = VqganTraining(
        recipe, TrainingFrames(clips, crop=recipe.crop, crop_moving=recipe.crop_moving), device=device
    )
    return fit(trainee, run, wanted, table, label=label, rate=Rate("images", recipe.batch_size), show=show)


@contextlib.contextmanager
def _only_trainer(run: Path) -> Iterator[None]:
    """Be the only process that trains into this run. Raises BusyError at once where another does."""
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(writer_lock(run))
        except BusyError as error:
            raise BusyError(
                "another process is training this run", where=run, remedy="wait until it is done, or stop it"
            ) from error
        yield


class Rate:
    """What the bar counts beside steps: `per_step` of `unit`."""

    def __init__(self, unit: str, per_step: int) -> None:
        self.unit, self.per_step = unit, per_step
        self.start_s, self.steps = time.monotonic(), 0

    def per_second(self) -> float:
        self.steps += 1
        return self.steps * self.per_step / max(1e-9, time.monotonic() - self.start_s)


def _bar(label: str, first: int, steps: int, *, show: bool) -> tqdm[None]:
    """A bar that moves on a terminal, and twice a minute where its output is kept, as in CI's log."""
    every_s = 0.1 if sys.stderr.isatty() else 30.0
    return tqdm(
        total=steps, initial=first, desc=label, unit="step", disable=not show, mininterval=every_s, maxinterval=every_s
    )


def fit(
    trainee: Trainee,
    run: Path,
    state: RunState,
    recipe: Mapping[str, Any],
    *,
    label: str,
    rate: Rate,
    show: bool = True,
    checkpoint_every_s: float = CHECKPOINT_EVERY_S,
) -> RunState:
    """Train to `state.steps`, from the checkpoint in `run` where there is one; save on the way, at the end, on Ctrl-C.

    An error leaves the last checkpoint as it is.
    """
    first = 0
    if read_state(run) is not None:
        checkpoint = load_checkpoint(run)
        trainee.restore(checkpoint.model, checkpoint.trainer)
        first = checkpoint.state.step

    def save(step: int) -> RunState:
        now = RunState(step, state.steps, state.views, state.split_hash, state.train_episodes)
        save_checkpoint(run, Checkpoint(*trainee.save(), recipe, now))
        return now

    saved_s = time.monotonic()
    with (
        _stop_on_interrupt() as stop,
        _bar(label, first, state.steps, show=show) as bar,
    ):
        for index in range(first, state.steps):
            losses = trainee.step(index)
            shown = {name: f"{loss:.4f}" for name, loss in losses.items()}
            bar.set_postfix({**shown, f"{rate.unit}/s": f"{rate.per_second():.0f}"}, refresh=False)
            bar.update()
            if stop.is_set():
                save(index + 1)
                raise KeyboardInterrupt
            if time.monotonic() - saved_s > checkpoint_every_s:
                save(index + 1)
                saved_s = time.monotonic()
    return save(state.steps)


def _must_train(run: Path, recipe: Mapping[str, Any], wanted: RunState, earlier: RunState) -> bool:
    """Whether the run in this folder is to go on (True) or is fresh (False); UsageError where it is another run."""
    old = read_recipe(run)
    changed = sorted(key for key in {*recipe, *old} if recipe.get(key) != old.get(key))
    remedy = "train again with --restart, or into another folder"
    if changed:
        found = ", ".join(f"{key} = {old.get(key)!r} there, {recipe.get(key)!r} now" for key in changed)
        raise UsageError("this run was trained with another recipe", where=run, found=found, remedy=remedy)
    gone = sorted(
        episode for episode, key in earlier.train_episodes.items() if wanted.train_episodes.get(episode) != key
    )
    if gone:
        raise UsageError(
            f"{len(gone)} episodes this run was trained on changed, or are no training episodes today",
            where=run,
            found=", ".join(gone[:5]) + (", …" if len(gone) > 5 else ""),
            remedy=remedy,
        )
    if not earlier.finished and earlier.training_set != wanted.training_set:
        raise UsageError("this run is unfinished, and training episodes were added since", where=run, remedy=remedy)
    return not earlier.finished


def _unseen(earlier: RunState, wanted: RunState) -> str:
    count = len(wanted.train_episodes.keys() - earlier.train_episodes.keys())
    return f"; {count} training episodes came later and were not seen" if count else ""


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
