"""Reports as files: report.json for programs, report.md for people, pictures to look at. What all reports share."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vilp_data.shards import write_atomic
from vilp_models.intervals import Estimate


def write_report_files(
    folder: Path, table: Mapping[str, Any], markdown: str, pictures: Mapping[str, bytes]
) -> list[Path]:
    """Write pictures, report.md, and last report.json, into `folder`; their paths. Raises StoreError where they cannot be
    written."""
    data = json.dumps(table, indent=2, allow_nan=False).encode() + b"\n"
    files = {**pictures, "report.md": markdown.encode(), "report.json": data}
    for name, content in files.items():
        write_atomic(folder / name, content)
    return [folder / name for name in files]


def read_fresh_report(folder: Path, inputs: Mapping[str, Any]) -> dict[str, Any] | None:
    """The report.json in `folder` if it was made from equal `inputs`, which it holds under that name; else None."""
    try:
        table: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return table if table.get("inputs") == inputs else None


def page(warnings: Iterable[str], parts: Sequence[Sequence[str]]) -> str:
    """Markdown from paragraphs of lines, the first the title, with the warnings after it."""
    shown = [f"> **Warning:** {warning}" for warning in warnings]
    return "\n\n".join("\n".join(part) for part in (parts[0], shown, *parts[1:]) if part) + "\n"


def markdown_table(titles: str, rows: Iterable[Sequence[str]]) -> list[str]:
    """A table from titles joined by " | " and rows of cells."""
    rule = "|" + " --- |" * len(titles.split(" | "))
    return [f"| {titles} |", rule, *(f"| {' | '.join(cells)} |" for cells in rows)]


def number(value: float) -> float | None:
    """For JSON, to 4 decimals, or as many digits of what is small; what is not defined is null."""
    return None if math.isnan(value) else float(f"{value:.4{'f' if abs(value) >= 1 else 'g'}}")


def estimate_table(estimate: Estimate) -> dict[str, float | None]:
    """For JSON: the value and its 95 % interval."""
    return {"value": number(estimate.value), "low": number(estimate.low), "high": number(estimate.high)}


def shown(value: float, digits: int = 2, *, sign: bool = False) -> str:
    """For people: what is not defined is a dash."""
    return "–" if math.isnan(value) else f"{value:{'+' if sign else ''}.{digits}f}"


def counted(count: int, noun: str) -> str:
    """For people: `1 start`, `50 starts`."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def estimate_words(estimate: Estimate, digits: int = 2, *, sign: bool = False) -> str:
    """For people: `1.23 (1.10 to 1.35)`."""
    value, low, high = (shown(x, digits, sign=sign) for x in (estimate.value, estimate.low, estimate.high))
    return value if math.isnan(estimate.low) else f"{value} ({low} to {high})"
