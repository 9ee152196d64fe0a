"""What a comparison of action sets shows: each policy on each set, and the differences, start by start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data.action_set_lock import DIGITS, ActionSetLock
from vilp_data.types import F64
from vilp_models.intervals import Estimate, mean_estimate, rate_estimate
from vilp_models.report_files import counted, estimate_table, estimate_words, markdown_table, page, write_report_files

COMPARED = ("vilp", "oracle", "bc")
"""Policies that learn from labels, in the order they are shown."""

MEASURES = {"max_reward": "mean of max reward", "success": "success rate"}

SAME = 1e-9
"""Values of starts that are closer than this do not differ: means over seeds and differences are rounded."""

NO_INTERVAL = (
    "A value without an interval: starts did not differ (or there is one alone), so nothing says how much others would."
)


@dataclass(frozen=True)
class SetsReport:
    """Several action sets, the first of which the others are measured against.

    errors    (set, seed) -> the low-level policy's report.json on held-out pairs; empty if none was trained
    rollouts  (policy, set, seed) -> a rollout's report.json; those of a policy begin at the same starts
    locks     set -> its lock: what was learnt from
    stay      report.json of the policy that does nothing, from the simulator's starts; None where nobody began there
    """

    task: str
    sets: tuple[str, ...]
    n_seeds: int
    errors: Mapping[tuple[str, int], Mapping[str, Any]]
    rollouts: Mapping[tuple[str, str, int], Mapping[str, Any]]
    dataset: str = ""
    preset: str | None = None
    locks: Mapping[str, ActionSetLock] = field(default_factory=dict)
    stay: Mapping[str, Any] | None = None

    @property
    def policies(self) -> list[str]:
        return [name for name in COMPARED if any(policy == name for policy, _, _ in self.rollouts)]

    def by_start(self, policy: str, action_set: str, measure: str) -> F64:
        """float64 [starts]: the mean over training seeds. Starts, not seeds, are what the intervals are drawn over: they are the
        larger cause of chance, and three seeds are too few to draw from."""
        tables = [self.rollouts[policy, action_set, seed] for seed in range(self.n_seeds)]
        return np.asarray(np.mean([_values(table, measure) for table in tables], axis=0), np.float64)

    def value(self, policy: str, action_set: str, measure: str) -> Estimate:
        """Of one training seed, success is a rate of yes and no, whose interval has a width at 0 and 1 too."""
        if self.n_seeds == 1:
            return _of_one(self.rollouts[policy, action_set, 0], measure)
        return _over_starts(self.by_start(policy, action_set, measure))

    def gain(self, policy: str, action_set: str, measure: str) -> Estimate:
        """This set less the first, paired by start."""
        first = self.by_start(policy, self.sets[0], measure)
        return _over_starts(self.by_start(policy, action_set, measure) - first)

    @property
    def all_alike(self) -> bool:
        """Whether a value or a difference has no interval, since starts did not differ."""
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
            "stay": None if self.stay is None else {m: estimate_table(_of_one(self.stay, m)) for m in MEASURES},
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
        if self.stay is not None:
            shown += [f"stay, {words}: {estimate_words(_of_one(self.stay, m), 3)}" for m, words in MEASURES.items()]
        return [*shown, *([NO_INTERVAL] if self.all_alike else [])]

    def to_markdown(self) -> str:
        """The page for people."""
        first, *others = self.sets
        rows = []
        for policy in self.policies:
            for measure, words in MEASURES.items():
                cells = [estimate_words(self.value(policy, name, measure), 3) for name in self.sets]
                gains = [estimate_words(self.gain(policy, name, measure), 3, sign=True) for name in others]
                rows.append([f"{policy}, {words}", *cells, *gains])
        if self.stay is not None:  # it learns from nothing, so it is the same whatever the set
            for measure, words in MEASURES.items():
                cell = estimate_words(_of_one(self.stay, measure), 3)
                rows.append([f"stay, {words}", *[cell] * len(self.sets), *["–"] * len(others)])
        errors = [
            [f"{part or 'action'}, {name} frames", *(", ".join(f"{value:.4g}" for value in sets[s]) for s in self.sets)]
            for part, frames in self._errors().items()
            for name, sets in frames.items()
        ]
        table = self.to_json()["policies"]
        starts = [f"{name}: {counted(entry['n_starts'], 'start')} ({entry['starts']})" for name, entry in table.items()]
        hardware = sorted({entry["hardware"] for entry in table.values()})
        parts = [
            [f"# Action sets on {self.task}: {', '.join(self.sets)}"],
            [f"Dataset `{self.dataset}`, {f'preset {self.preset}' if self.preset else 'no preset'}."],
            [f"- {name}: {_labels_words(lock)}" for name, lock in self.locks.items()],
            [f"{counted(self.n_seeds, 'training seed')} each, one and the same planner. {'; '.join(starts)}."],
            markdown_table(" | ".join(["", *self.sets, *(f"{name} - {first}" for name in others)]), rows),
            [
                "95 % intervals: bootstrap over starts, of the mean over training seeds; differences are paired by start.",
                "The success rate of one training seed, and of stay, has Wilson's.",
                *([NO_INTERVAL] if self.all_alike else []),
            ],
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


def _of_one(table: Mapping[str, Any], measure: str) -> Estimate:
    """Of one rollout."""
    values = _values(table, measure)
    return rate_estimate(int(sum(values)), len(values)) if measure == "success" else _over_starts(np.array(values))


def _over_starts(values: F64) -> Estimate:
    """The mean [starts] with its bootstrap interval; without one where starts did not differ, since resampling the same would say that
    it is known for sure."""
    estimate = mean_estimate(values)
    return Estimate(estimate.value, np.nan, np.nan) if np.ptp(values) < SAME else estimate


def _labels(lock: ActionSetLock) -> dict[str, int]:
    return {"episodes": len(lock.episodes), "steps": sum(source.n_steps for source in lock.sources)}


def _labels_words(lock: ActionSetLock) -> str:
    n = _labels(lock)
    return f"{counted(n['episodes'], 'labelled episode')}, {counted(n['steps'], 'step')}, `{lock.key[:DIGITS]}`"
