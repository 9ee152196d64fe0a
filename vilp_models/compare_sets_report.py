"""What a comparison of action sets shows: each policy on each set, and the differences, start by start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data.action_set_lock import DIGITS, ActionSetLock
from vilp_data.types import F64
from vilp_models.intervals import Estimate, crossed_estimate, mean_estimate, rate_estimate
from vilp_models.report_files import counted, estimate_table, estimate_words, markdown_table, page, write_report_files

COMPARED = ("vilp", "oracle", "bc")
"""Policies that learn from labels, in the order they are shown."""

MEASURES = {"max_reward": "mean of max reward", "success": "success rate"}

SAME = 1e-9
"""An interval narrower than this says that starts and seeds did not differ: values are rounded."""

NO_INTERVAL = (
    "A value without an interval: nothing differed, or there are too few starts, so nothing says how much others would."
)


@dataclass(frozen=True)
class SetsReport:
    """Several action sets, the first of which the others are measured against.

    errors    (set, seed) -> the low-level policy's report.json on held-out pairs; empty if none was trained
    rollouts  (policy, set, seed) -> a rollout's report.json; those of a policy begin at the same starts
    locks     set -> its lock: what was learnt from
    stays     report.json of the policy that does nothing, one for each choice of starts that a policy began at
    """

    task: str
    sets: tuple[str, ...]
    n_seeds: int
    errors: Mapping[tuple[str, int], Mapping[str, Any]]
    rollouts: Mapping[tuple[str, str, int], Mapping[str, Any]]
    dataset: str = ""
    preset: str | None = None
    locks: Mapping[str, ActionSetLock] = field(default_factory=dict)
    stays: Sequence[Mapping[str, Any]] = ()

    @property
    def policies(self) -> list[str]:
        return [name for name in COMPARED if any(policy == name for policy, _, _ in self.rollouts)]

    def values(self, policy: str, action_set: str, measure: str) -> F64:
        """float64 [seeds,starts]"""
        return np.array([_values(self.rollouts[policy, action_set, seed], measure) for seed in range(self.n_seeds)])

    def value(self, policy: str, action_set: str, measure: str) -> Estimate:
        """The mean over training seeds and starts. A start counts once in the interval of a rate, by the share of seeds that
        succeeded there: seeds that meet the same start are no trials of their own."""
        values = self.values(policy, action_set, measure)
        if measure == "success":
            return rate_estimate(float(values.mean(axis=0).sum()), values.shape[1])
        return _with_width(crossed_estimate(values))

    def gain(self, policy: str, action_set: str, measure: str) -> Estimate:
        """This set less the first, from the same starts."""
        first = self.values(policy, self.sets[0], measure)
        return _with_width(crossed_estimate(self.values(policy, action_set, measure), first))

    @property
    def some_lack_intervals(self) -> bool:
        shown = [self.value(p, s, m) for p in self.policies for s in self.sets for m in MEASURES]
        shown += [self.gain(p, s, m) for p in self.policies for s in self.sets[1:] for m in MEASURES]
        return any(np.isnan(estimate.low) for estimate in shown)

    def to_json(self) -> dict[str, Any]:
        policies: dict[str, Any] = {}
        for policy in self.policies:
            table = next(table for (name, _, _), table in self.rollouts.items() if name == policy)
            policies[policy] = {
                "starts": table["starts"],
                "n_starts": len(table["episodes"]),
                "hardware": table["hardware"],
                "sets": {action_set: self._measured(policy, action_set) for action_set in self.sets},
            }
        return {
            "task": self.task,
            "dataset": self.dataset,
            "preset": self.preset,
            "sets": list(self.sets),
            "labels": {name: {**_labels(lock), "key": lock.key} for name, lock in self.locks.items()},
            "training_seeds": self.n_seeds,
            "low_level_mae": self._errors(),
            "policies": policies,
            "stay": {stay["starts"]: {m: estimate_table(_of_one(stay, m)) for m in MEASURES} for stay in self.stays},
        }

    def _measured(self, policy: str, action_set: str) -> dict[str, Any]:
        shown: dict[str, Any] = {}
        for measure in MEASURES:
            shown[measure] = estimate_table(self.value(policy, action_set, measure))
            if action_set != self.sets[0]:
                shown[f"{measure}_less_{self.sets[0]}"] = estimate_table(self.gain(policy, action_set, measure))
        seeds = [self.rollouts[policy, action_set, seed] for seed in range(self.n_seeds)]
        shown["by_seed"] = [
            {measure: table[measure]["value"] for measure in MEASURES} | {"tags": table["tags"]} for table in seeds
        ]
        return shown

    def _errors(self) -> dict[str, dict[str, dict[str, list[float]]]]:
        """Part of the action -> "true" and "reconstructed" second frames -> set -> mean absolute error by seed, in the part's unit."""
        parts = next(iter(self.errors.values()))["parts"] if self.errors else {}
        return {
            part: {
                frames: {
                    action_set: [
                        self.errors[action_set, seed]["parts"][part]["candidates"][frames]["mae"]["value"]
                        for seed in range(self.n_seeds)
                    ]
                    for action_set in self.sets
                }
                for frames in ("true", "reconstructed")
                if frames in table["candidates"]
            }
            for part, table in parts.items()
        }

    def lines(self) -> list[str]:
        """For a terminal."""
        shown = []
        for part, frames in self._errors().items():
            for name, sets in frames.items():
                means = ", ".join(f"{action_set} {np.mean(values):.4g}" for action_set, values in sets.items())
                shown.append(f"low-level error of {part or 'the action'}, {name} frames: {means}")
        for policy in self.policies:
            for measure, words in MEASURES.items():
                values = [
                    f"{action_set} {estimate_words(self.value(policy, action_set, measure), 3)}"
                    for action_set in self.sets
                ]
                gains = [
                    f"{action_set} - {self.sets[0]} {estimate_words(self.gain(policy, action_set, measure), 3, sign=True)}"
                    for action_set in self.sets[1:]
                ]
                shown.append(f"{policy}, {words}: {'; '.join([*values, *gains])}")
        shown += [
            f"staying ({stay['starts']}), {words}: {estimate_words(_of_one(stay, measure), 3)}"
            for stay in self.stays
            for measure, words in MEASURES.items()
        ]
        return [*shown, *([NO_INTERVAL] if self.some_lack_intervals else [])]

    def to_markdown(self) -> str:
        """The page for people."""
        first, *others = self.sets
        rows, by_seed = [], []
        for policy in self.policies:
            for measure, words in MEASURES.items():
                cells = [estimate_words(self.value(policy, name, measure), 3) for name in self.sets]
                gains = [estimate_words(self.gain(policy, name, measure), 3, sign=True) for name in others]
                rows.append([f"{policy}, {words}", *cells, *gains])
                seeds = (self.values(policy, name, measure).mean(axis=1) for name in self.sets)
                by_seed.append([f"{policy}, {words}", *(", ".join(f"{value:.3f}" for value in each) for each in seeds)])
        for stay in self.stays:  # it learns from nothing, so it is the same whatever the set
            for measure, words in MEASURES.items():
                cell = estimate_words(_of_one(stay, measure), 3)
                rows.append([f"staying ({stay['starts']}), {words}", *[cell] * len(self.sets), *["–"] * len(others)])
        errors = [
            [f"{part or 'action'}, {name} frames", *(", ".join(f"{value:.4g}" for value in sets[s]) for s in self.sets)]
            for part, frames in self._errors().items()
            for name, sets in frames.items()
        ]
        table = self.to_json()["policies"]
        starts = [f"{name}: {counted(entry['n_starts'], 'start')} ({entry['starts']})" for name, entry in table.items()]
        apart = len({entry["starts"] for entry in table.values()}) > 1
        hardware = sorted({entry["hardware"] for entry in table.values()})
        parts = [
            [f"# Action sets on {self.task}: {', '.join(self.sets)}"],
            [f"Dataset `{self.dataset}`, {f'preset {self.preset}' if self.preset else 'no preset'}."],
            [f"- {name}: {_labels_words(lock)}" for name, lock in self.locks.items()],
            [f"{counted(self.n_seeds, 'training seed')} each, one and the same planner. {'; '.join(starts)}."],
            markdown_table(" | ".join(["", *self.sets, *(f"{name} - {first}" for name in others)]), rows),
            [
                "95 % intervals of means and differences: a bootstrap over training seeds and starts; both sets of a difference see the",
                "same starts. Few seeds tell little of others: below is what each came to. Rates have Wilson's, a start counting once.",
                *([NO_INTERVAL] if self.some_lack_intervals else []),
                *(
                    ["Policies that begin elsewhere are to be compared with staying there, not with each other."]
                    if apart
                    else []
                ),
            ],
            ["## By training seed"],
            markdown_table(" | ".join(["", *self.sets]), by_seed),
        ]
        if errors:
            parts += [
                ["## Low-level policy, mean absolute error on held-out pairs, by training seed"],
                markdown_table(" | ".join(["", *self.sets]), errors),
            ]
        return page([], [*parts, [f"Rolled out on {'; '.join(hardware)}."]])

    def write(self, folder: Path) -> dict[str, Any]:
        """report.json and report.md into `folder`; the former as plain data."""
        table = self.to_json()
        write_report_files(folder, table, self.to_markdown(), {})
        return table


def _values(table: Mapping[str, Any], measure: str) -> list[float]:
    return [float(episode[measure]) for episode in table["episodes"]]


def _with_width(estimate: Estimate) -> Estimate:
    """Without its interval where nothing differed: resampling the same would say that it is known for sure."""
    return Estimate(estimate.value, np.nan, np.nan) if estimate.high - estimate.low < SAME else estimate


def _of_one(table: Mapping[str, Any], measure: str) -> Estimate:
    """Of one rollout."""
    values = _values(table, measure)
    return rate_estimate(sum(values), len(values)) if measure == "success" else _with_width(mean_estimate(values))


def _labels(lock: ActionSetLock) -> dict[str, int]:
    return {"episodes": len(lock.episodes), "steps": sum(source.n_steps for source in lock.sources)}


def _labels_words(lock: ActionSetLock) -> str:
    n = _labels(lock)
    return f"{counted(n['episodes'], 'labelled episode')}, {counted(n['steps'], 'step')}, `{lock.key[:DIGITS]}`"
