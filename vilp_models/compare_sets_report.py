"""What a comparison of action sets shows: each policy on each set, and the differences, start by start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data.types import F64
from vilp_models.intervals import Estimate, mean_estimate
from vilp_models.report_files import counted, estimate_table, estimate_words, markdown_table, page, write_report_files

COMPARED = ("vilp", "oracle", "bc")
"""Policies that learn from labels, in the order they are shown."""

MEASURES = {"max_reward": "mean of max reward", "success": "success rate"}


@dataclass(frozen=True)
class SetsReport:
    """Several action sets, the first of which the others are measured against.

    errors    (set, seed) -> the low-level policy's report.json on held-out pairs; empty if none was trained
    rollouts  (policy, set, seed) -> a rollout's report.json; those of a policy begin at the same starts
    """

    task: str
    sets: tuple[str, ...]
    n_seeds: int
    errors: Mapping[tuple[str, int], Mapping[str, Any]]
    rollouts: Mapping[tuple[str, str, int], Mapping[str, Any]]

    @property
    def policies(self) -> list[str]:
        return [name for name in COMPARED if any(policy == name for policy, _, _ in self.rollouts)]

    def by_start(self, policy: str, action_set: str, measure: str) -> F64:
        """float64 [starts]: the mean over training seeds. Starts, not seeds, are what the intervals are drawn over: they are the
        larger cause of chance, and three seeds are too few to draw from."""
        tables = [self.rollouts[policy, action_set, seed] for seed in range(self.n_seeds)]
        values = [[float(episode[measure]) for episode in table["episodes"]] for table in tables]
        return np.asarray(np.mean(values, axis=0), np.float64)

    def value(self, policy: str, action_set: str, measure: str) -> Estimate:
        return mean_estimate(self.by_start(policy, action_set, measure))

    def gain(self, policy: str, action_set: str, measure: str) -> Estimate:
        """This set less the first, paired by start."""
        first = self.by_start(policy, self.sets[0], measure)
        return mean_estimate(self.by_start(policy, action_set, measure) - first)

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
            "sets": list(self.sets),
            "training_seeds": self.n_seeds,
            "low_level_mae": self._errors(),
            "policies": policies,
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
        return shown

    def to_markdown(self) -> str:
        """The page for people."""
        first, *others = self.sets
        rows = []
        for policy in self.policies:
            for measure, words in MEASURES.items():
                cells = [estimate_words(self.value(policy, name, measure), 3) for name in self.sets]
                gains = [estimate_words(self.gain(policy, name, measure), 3, sign=True) for name in others]
                rows.append([f"{policy}, {words}", *cells, *gains])
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
            [f"{counted(self.n_seeds, 'training seed')} each, one and the same planner. {'; '.join(starts)}."],
            markdown_table(" | ".join(["", *self.sets, *(f"{name} - {first}" for name in others)]), rows),
            [
                "95 % intervals: bootstrap over starts, of the mean over training seeds; differences are paired by start."
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
