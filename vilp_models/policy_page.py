"""A report on the low-level policy as files: report.json and report.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vilp_models.plan_errors import RESAMPLES
from vilp_models.policy_report import GUESS_WORDS, GUESSES, POLICY, PartReport, PolicyReport
from vilp_models.report_files import estimate_table, estimate_words, markdown_table, page, write_report_files

NAMES = {
    "true": "policy, true frames",
    "reconstructed": "policy, second frame reconstructed",
    **GUESS_WORDS,
}


def write_policy_report(report: PolicyReport, folder: Path, inputs: Mapping[str, Any]) -> list[Path]:
    """Write both files into `folder`, report.json with its `inputs` last. Raises StoreError where they cannot be written."""
    table = {"inputs": inputs, **to_table(report)}
    return write_report_files(folder, table, to_markdown(report), {})


def to_table(report: PolicyReport) -> dict[str, Any]:
    """The report as plain data; what is not defined is null."""
    return {
        "episodes": list(report.episodes),
        "pairs": report.n_pairs,
        "warnings": report.warnings,
        "parts": {part.part: {"unit": part.unit, **_part_table(part)} for part in report.parts},
    }


def to_markdown(report: PolicyReport) -> str:
    """For people: errors of each part of the action, then what is gained over each guess."""
    parts = [
        ["# Low-level policy on held-out pairs"],
        [
            f"{report.n_pairs} pairs of {len(report.episodes)} validation episodes. Errors of a component, pooled over pairs; in "
            f"brackets 95 % intervals of a bootstrap over episodes ({RESAMPLES} draws), differences paired.",
            "*Staying*: no motion for deltas; for absolute targets the present low_dim that the task names, else the action before.",
        ],
    ]
    for part in report.parts:
        policies = [name for name in POLICY if name in part.absolute]
        unit = f" ({part.unit})" if part.unit else ""
        parts.append([f"## {part.part or 'action'}{unit}"])
        titles = " | ".join(
            ["what", "mean absolute error", "root mean square", *(f"{NAMES[n]}, less this" for n in policies)]
        )
        parts.append(markdown_table(titles, [_cells(part, name, policies) for name in part.absolute]))
    return page(report.warnings, parts)


def summary(table: Mapping[str, Any], folder: Path) -> list[str]:
    """A report.json for a terminal: a line for each part of the action, then the warnings."""
    lines = []
    for part, row in table["parts"].items():
        errors = "; ".join(f"{NAMES[name]} {errors['mae']['value']:.3g}" for name, errors in row["candidates"].items())
        lines.append(f"{part or 'action'}: mean absolute error in {row['unit'] or 'its unit'}: {errors}")
    warnings = [f"warning: {warning}" for warning in table["warnings"]]
    return [*lines, *warnings, f"{folder}/report.md shows it in full"]


def _cells(part: PartReport, name: str, policies: list[str]) -> list[str]:
    digits = _digits(part)
    gains = [
        estimate_words(part.gain(policy, name), digits, sign=True) if name in GUESSES else "" for policy in policies
    ]
    return [NAMES[name], estimate_words(part.mae(name), digits), estimate_words(part.rmse(name), digits), *gains]


def _digits(part: PartReport) -> int:
    """Decimals that show three digits of the smallest error, 3 to 6: metres are small, pixels are not."""
    errors = [part.mae(name).value for name in part.absolute]
    positive = [error for error in errors if error > 0]
    return min(max(3, 2 - math.floor(math.log10(min(positive)))), 6) if positive else 3


def _part_table(part: PartReport) -> dict[str, Any]:
    return {
        "candidates": {
            name: {"mae": estimate_table(part.mae(name)), "rmse": estimate_table(part.rmse(name))}
            for name in part.absolute
        },
        "mae_less_that_of": {
            policy: {guess: estimate_table(part.gain(policy, guess)) for guess in GUESSES}
            for policy in POLICY
            if policy in part.absolute
        },
    }
