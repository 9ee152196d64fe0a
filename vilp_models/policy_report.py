"""Does the low-level policy know what happened between two frames? Held-out pairs, true and reconstructed, beside guesses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from vilp_data.episode_files import open_steps
from vilp_data.episodes import EpisodeStore
from vilp_data.pairs import PairDataset, PairTensors
from vilp_data.spec import ActionSpec, TaskSpec
from vilp_data.types import F32
from vilp_data.vector_parts import vector_parts
from vilp_models.imagined import Decoder, decode_frames
from vilp_models.intervals import Estimate
from vilp_models.plan_errors import Sums, score

REPORT_FORMAT = 3
"""Raised when the same inputs give other numbers."""

POLICY = ("true", "reconstructed")
GUESSES = ("mean", "last", "hold")
"""true, reconstructed  the policy on true frames; on the VQGAN's reconstruction of the second one, as imagined frames will be
mean                 the mean training action
last                 the action before, repeated
hold                 staying: no motion for deltas; for absolute targets the low_dim part that `holds` or `from` names, or that reads the
                     same fields of the same topic; else the action before"""

GUESS_WORDS = {"mean": "the mean training action", "last": "the action before", "hold": "staying"}

BATCH = 64

Progress = Callable[[int, int], None]
"""Told (pairs done, pairs in all)."""


class PairPolicy(Protocol):
    """What is used of `low_level.LowLevelPolicy`."""

    def act(
        self, first: Mapping[str, Tensor], second: Mapping[str, Tensor], low_dim: Tensor | None = None
    ) -> Tensor: ...


@dataclass(frozen=True)
class PartReport:
    """One part of the action, in its `unit`: absolute and squared errors, candidate -> sums [E,1] over its components."""

    part: str
    unit: str
    absolute: Mapping[str, Sums]
    squared: Mapping[str, Sums]

    def mae(self, candidate: str) -> Estimate:
        """Mean absolute error of a component."""
        return score(self.absolute[candidate], "latent").mean

    def rmse(self, candidate: str) -> Estimate:
        """Root of the mean squared error of a component; the root of an interval's ends is the interval of the root."""
        mean = score(self.squared[candidate], "latent").mean
        return Estimate(*(math.sqrt(x) for x in (mean.value, mean.low, mean.high)))

    def gain(self, candidate: str, guess: str) -> Estimate:
        """Mean absolute error less that of a guess, paired: below zero is better."""
        return score(self.absolute[candidate], "latent", minus=self.absolute[guess]).mean

    @property
    def warnings(self) -> list[str]:
        lost = [
            f"{name} frames than {GUESS_WORDS[guess]} ({self.gain(name, guess).value:+.3g} {self.unit})".rstrip()
            for name in POLICY
            if name in self.absolute
            for guess in GUESSES
            if not self.gain(name, guess).value < 0
        ]
        if not lost:
            return []
        return [
            f"do not act with this policy: {self.part or 'the action'} is told no better from {'; from '.join(lost)}. "
            "Train it longer, or with more episodes"
        ]


@dataclass(frozen=True)
class PolicyReport:
    """Every part of the action over the pairs of held-out `episodes` (the axis E)."""

    parts: tuple[PartReport, ...]
    episodes: tuple[str, ...]
    n_pairs: int

    @property
    def warnings(self) -> list[str]:
        return [warning for part in self.parts for warning in part.warnings]


def policy_report(
    store: EpisodeStore,
    spec: TaskSpec,
    policy: PairPolicy,
    pairs: PairDataset,
    mean_action: Sequence[float],
    *,
    sees: str = "frames",
    decoders: Mapping[str, Decoder] | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> PolicyReport:
    """Compare on every pair that has an action before it. `spec` says what staying is; `sees` is the recipe's: a policy that sees
    latents is judged on those of both frames alone. With `decoders` also on reconstructed second frames, whose latents `pairs` must
    hold."""
    candidates = [n for n in (*POLICY, *GUESSES) if n != "reconstructed" or (decoders and sees == "frames")]
    ids = pairs.episode_ids
    units = _units(spec, len(mean_action))
    absolute = {part: {name: Sums.zeros(len(ids), 1) for name in candidates} for part in units}
    squared = {part: {name: Sums.zeros(len(ids), 1) for name in candidates} for part in units}
    n_pairs = 0
    for first in range(0, len(pairs), BATCH):
        numbers = range(first, min(first + BATCH, len(pairs)))
        batch, last = _with_last_actions(store, pairs, pairs.read(numbers))
        if len(batch):
            guesses = _guesses(spec, batch, last, mean_action)
            predicted = guesses | _predictions(policy, batch, sees, decoders, device)
            for name in candidates:
                error = predicted[name] - batch.action.numpy()
                for part, columns in _columns(spec, error).items():
                    for row, episode in enumerate(batch.episode.tolist()):
                        count = np.full((1, 1), columns[row].size, np.float64)
                        absolute[part][name].add(
                            episode, np.abs(columns[row]).sum(dtype=np.float64).reshape(1, 1), count
                        )
                        squared[part][name].add(
                            episode, np.square(columns[row]).sum(dtype=np.float64).reshape(1, 1), count
                        )
            n_pairs += len(batch)
        if progress is not None:
            progress(numbers.stop, len(pairs))
    parts = tuple(PartReport(part, unit, absolute[part], squared[part]) for part, unit in units.items())
    return PolicyReport(parts, tuple(ids), n_pairs)


def hold_actions(spec: TaskSpec, low_dim: F32, last: F32) -> F32:
    """The actions that stay, float32 [B,A], by the rule in GUESSES: `low_dim` [B,L] is the present, `last` [B,A] the actions
    before."""
    known = vector_parts(low_dim, spec.low_dim)
    out = []
    for name, (_, values) in vector_parts(last, spec.action).items():
        action = spec.action.get(name)  # None where the spec does not tell the widths of the parts
        if action is not None and action.kind != "absolute":
            out.append(np.zeros_like(values))
            continue
        place = None if action is None else _place(spec, action)
        held = known[place][1] if place in known else values
        out.append(held if held.shape == values.shape else values)
    return np.concatenate(out, axis=1)


def _place(spec: TaskSpec, action: ActionSpec) -> str | None:
    """The low_dim part that an absolute command is a target for; None where the spec does not tell."""
    if named := action.holds or action.from_:
        return named
    read = (action.topic, action.fields, action.names)
    same = (name for name, part in spec.low_dim.items() if (part.topic, part.fields, part.names) == read)
    return next(same, None)


def _guesses(spec: TaskSpec, batch: PairTensors, last: F32, mean_action: Sequence[float]) -> dict[str, F32]:
    """Guess -> actions float32 [B,Δt,A]."""
    hold = hold_actions(spec, batch.low_dim.numpy(), last)
    each = {"mean": np.broadcast_to(np.asarray(mean_action, np.float32), last.shape), "last": last, "hold": hold}
    return {name: np.repeat(values[:, None], batch.action.shape[1], axis=1) for name, values in each.items()}


def _predictions(
    policy: PairPolicy,
    batch: PairTensors,
    sees: str,
    decoders: Mapping[str, Decoder] | None,
    device: torch.device | str,
) -> dict[str, F32]:
    """ "true" and, with decoders, "reconstructed" -> actions float32 [B,Δt,A]."""
    seen = batch.to(device)
    images = seen.latents if sees == "latents" else seen.frames
    first = {view: both[:, 0] for view, both in images.items()}
    second = {view: both[:, 1] for view, both in images.items()}
    out = {"true": policy.act(first, second, seen.low_dim).float().cpu().numpy()}
    if decoders and sees == "frames":
        rebuilt = {
            view: torch.from_numpy(decode_frames(decoders[view], both[:, 1].numpy())).to(device)
            for view, both in batch.latents.items()
        }
        out["reconstructed"] = policy.act(first, rebuilt, seen.low_dim).float().cpu().numpy()
    return out


def _with_last_actions(store: EpisodeStore, pairs: PairDataset, batch: PairTensors) -> tuple[PairTensors, F32]:
    """Those pairs that have a valid step before them, and the actions of that step, float32 [B,A]."""
    kept, last = [], []
    opened = {n: open_steps(store, store.entry(pairs.episode_ids[n])) for n in sorted(set(batch.episode.tolist()))}
    for row, (episode, step) in enumerate(zip(batch.episode.tolist(), batch.step.tolist(), strict=True)):
        if step and opened[episode]["valid"][step - 1]:
            kept.append(row)
            last.append(opened[episode]["action"][step - 1])
    rows = torch.tensor(kept, dtype=torch.int64)
    return batch.map(lambda tensor: tensor[rows]), np.array(last, np.float32).reshape(len(kept), -1)


def _columns(spec: TaskSpec, values: F32) -> dict[str, F32]:
    """Part -> its columns [B,Δt,n] of [B,Δt,A]; one part "" where the spec does not tell the widths."""
    flat = values.reshape(-1, values.shape[-1])
    split = vector_parts(flat, spec.action)
    return {part: columns.reshape(*values.shape[:-1], -1) for part, (_, columns) in split.items()}


def _units(spec: TaskSpec, action_size: int) -> dict[str, str]:
    parts = vector_parts(np.empty((0, action_size), np.float32), spec.action)
    return {part: spec.action[part].unit if part in spec.action else "" for part in parts}
