"""Checkpoints: one safetensors file a run, replaced whole: all that resuming needs, and nothing that runs code.

A run's folder is `<run_dir>/<views joined by +>/`, since views may share one network:
    checkpoint.safetensors   model/…, what others load: averaged weights where training averages; and trainer/… (weights as
                             they are trained, optimiser, discriminator, counters). Its header: recipe and state
    recipe.json              the resolved recipe again, for people
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from vilp_data.episodes import EpisodeEntry
from vilp_data.errors import SplitError, StoreError, UsageError, nearest
from vilp_data.keys import ingest_key
from vilp_data.shards import open_shard, read_header, read_shard, verify_shard, write_atomic, write_shard
from vilp_models.contract import DataContract

FORMAT = "vilp-checkpoint-1"
FILE = "checkpoint.safetensors"
Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class RunState:
    """Where a run is and what it learns from.

    step            optimiser steps done
    steps           steps in all; the run is finished when they are equal
    views           views whose frames it sees
    split_hash      hash of the split that chose the episodes, to find the lock in a project's history. It decides nothing: a
                    split that only grew has another hash, so what is compared is train_episodes
    train_episodes  episode id -> episode key, of every training episode
    model           kind of model: "vqgan", "planner", "policy", "bc"
    contract        `DataContract.to_json` of the dataset it learns from; None for a VQGAN, which depends on frames alone
    built_by        what decides the network besides recipe and contract: {"n_action_steps": …} for "bc", else nothing
    action_set      {"name", "key"} of the action set whose episodes train_episodes are; None where it learns from all there are
    """

    step: int
    steps: int
    views: tuple[str, ...]
    split_hash: str
    train_episodes: Mapping[str, str]
    model: str = "vqgan"  # checkpoints of before there were others name none
    contract: Mapping[str, Any] | None = None
    built_by: Mapping[str, int] = field(default_factory=dict)
    action_set: Mapping[str, str] | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data. Without an action set it says nothing of one, as before there were any."""
        table = asdict(self)
        if self.action_set is None:
            del table["action_set"]
        return table

    @property
    def finished(self) -> bool:
        return self.step >= self.steps

    @property
    def training_set(self) -> str:
        """SHA-256 over views and training episodes: equal for runs that learn from the same frames."""
        return hashlib.sha256(json.dumps([self.views, sorted(self.train_episodes.items())]).encode()).hexdigest()


@dataclass(frozen=True)
class Checkpoint:
    """A run at one moment: `model` is what others load, `trainer` what resuming needs besides."""

    model: Arrays
    trainer: Arrays
    recipe: Mapping[str, Any]
    state: RunState


def run_folder(run_dir: Path, views: Sequence[str]) -> Path:
    """Folder of the run that these views share. View names hold no "+"."""
    return run_dir / "+".join(sorted(views))


def run_for_view(run_dir: Path, view: str) -> Path:
    """Folder of the run trained on `view`. Raises UsageError naming the views there are."""
    runs = [path.parent for path in sorted(run_dir.glob(f"*/{FILE}"))]
    for run in runs:
        if view in run.name.split("+"):
            return run
    known = [name for run in runs for name in run.name.split("+")]
    train = "train one with `vilp-models train vqgan`"
    remedy = f"{nearest(view, known)}; or {train}" if known else train
    raise UsageError(f"no trained network for view {view!r}", where=run_dir, remedy=remedy)


def save_checkpoint(run: Path, checkpoint: Checkpoint) -> None:
    """Replace the run's checkpoint. A crash leaves the one before. Raises StoreError (full disk, no permission)."""
    recipe = json.dumps(checkpoint.recipe, indent=2, sort_keys=True)
    write_atomic(run / "recipe.json", (recipe + "\n").encode())
    tensors = {f"model/{name}": array for name, array in checkpoint.model.items()}
    tensors |= {f"trainer/{name}": array for name, array in checkpoint.trainer.items()}
    header = {"format": FORMAT, "recipe": recipe, "state": json.dumps(checkpoint.state.to_json(), sort_keys=True)}
    write_shard(run / FILE, tensors, header)


def load_checkpoint(run: Path) -> Checkpoint:
    """The run's checkpoint, checksum verified. Raises StoreError where it is missing, damaged or of another format."""
    header = _header(run)
    arrays = read_shard(run / FILE).arrays
    return Checkpoint(
        _under("model/", arrays), _under("trainer/", arrays), json.loads(header["recipe"]), _state(header)
    )


def model_tensors(run: Path) -> Arrays:
    """The network's tensors alone, writable, checksum verified; what resuming needs besides is not kept in memory."""
    _header(run)
    verify_shard(run / FILE)
    return _under("model/", open_shard(run / FILE).arrays)


def read_recipe(run: Path) -> dict[str, Any]:
    """The resolved recipe that the run was trained with, from its checkpoint."""
    recipe: dict[str, Any] = json.loads(_header(run)["recipe"])
    return recipe


def read_state(run: Path) -> RunState | None:
    """Where the run is, without reading its tensors; None where it has not begun."""
    return _state(_header(run)) if (run / FILE).is_file() else None


class TrainedRun(NamedTuple):
    """What a run left for those who use its model: `recipe` and `contract` say how to build it, `arrays` are its tensors."""

    recipe: dict[str, Any]
    contract: DataContract
    state: RunState
    arrays: Arrays


def load_run(run: Path, kind: str, *, unfinished: bool = False) -> TrainedRun:
    """The model of this kind ("planner", "policy", "bc") trained in this folder; its tensors checked and writable.

    Raises UsageError where there is none, one of another kind, or one whose training is not finished (unless that is
    wanted), StoreError where the checkpoint is damaged."""
    state = read_state(run)
    train = f"`vilp-models train {kind}`"
    if state is None:
        raise UsageError(f"no trained {kind}", where=run, remedy=f"train one with {train}")
    if state.model != kind or state.contract is None:
        raise UsageError(f"not a {kind}", where=run, found=state.model, remedy=f"name the run of a {kind}")
    if not state.finished and not unfinished:
        found, remedy = f"step {state.step} of {state.steps}", f"run {train} again: it goes on there"
        raise UsageError("this network's training is not finished", where=run, found=found, remedy=remedy)
    return TrainedRun(read_recipe(run), DataContract.from_json(state.contract), state, model_tensors(run))


def refuse_trained_on_validation(state: RunState, val: Sequence[EpisodeEntry], *, where: Path) -> None:
    """Raise SplitError where the run in `where` was trained on one of these episodes, by whatever name: it knows what it would be
    judged on."""
    learnt = {ingest_key(key) for key in state.train_episodes.values()}
    leaked = sorted(entry.id for entry in val if entry.id in state.train_episodes or entry.ingest_key in learnt)
    if leaked:
        raise SplitError(
            f"this {state.model} was trained on {len(leaked)} of the episodes to validate it on",
            where=where,
            found=", ".join(leaked[:5]) + (", …" if len(leaked) > 5 else ""),
            remedy=f"train on today's split with `vilp-models train {state.model} --restart`, or restore the split that it was "
            "trained with",
        )


def checkpoint_digest(run: Path) -> str:
    """SHA-256 of the run's checkpoint as recorded in its header: changes with any weight, the recipe or the state."""
    return _header(run)["sha256"]


def _header(run: Path) -> dict[str, str]:
    metadata = read_header(run / FILE).metadata
    found = metadata.get("format", "no format")
    if found != FORMAT:
        raise StoreError(
            f"not a checkpoint of format {FORMAT}",
            where=run / FILE,
            found=found,
            remedy="train again into another folder",
        )
    return metadata


def _state(header: Mapping[str, str]) -> RunState:
    table = json.loads(header["state"])
    return RunState(**{**table, "views": tuple(table["views"])})


def _under(prefix: str, arrays: Arrays) -> Arrays:
    return {name.removeprefix(prefix): np.array(array) for name, array in arrays.items() if name.startswith(prefix)}
