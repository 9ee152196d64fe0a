"""How well a run's encoder reconstructs each episode, as `vilp-models evaluate vqgan` wrote it: runs/RUN/fidelity/report.json.

Read with patience: a report that is missing, damaged or of another shape just tells nothing.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vilp_data import shards
from vilp_data.episodes import EpisodeEntry
from vilp_data.errors import StoreError

REPORT = Path("fidelity") / "report.json"
CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True)
class Fidelity:
    """One view of one episode: PSNR (dB) over all pixels, and over the moving ones; LPIPS. None where it is not defined."""

    psnr_db: float
    moving_psnr_db: float | None
    lpips: float | None


@dataclass(frozen=True)
class MeasuredFidelity:
    """What a run's report says of the episodes as they are today.

    run        the folder
    episodes   id -> view -> numbers; the report's episodes (validation ones, usually) whose frames are still those it measured
    outdated   the run's checkpoints are others than those that were measured
    """

    run: Path
    episodes: Mapping[str, Mapping[str, Fidelity]] = field(default_factory=dict)
    outdated: bool = False

    @property
    def views(self) -> list[str]:
        return sorted({view for views in self.episodes.values() for view in views})


def measured_runs(root: Path) -> list[Path]:
    """The runs of a dataset that have a report, the one measured last first."""
    reports = sorted((root / "runs").glob(f"*/{REPORT}"))
    return [path.parents[1] for path in sorted(reports, key=lambda path: -path.stat().st_mtime)]


def read_fidelity(run: Path, entries: Mapping[str, EpisodeEntry]) -> MeasuredFidelity:
    """The run's numbers for `entries`, by id. Never raises: no report, or one that cannot be read, has none."""
    try:
        table = json.loads((run / REPORT).read_bytes())
    except (OSError, ValueError):
        return MeasuredFidelity(run)
    measured = _table(table, "inputs", "frames")
    episodes: dict[str, dict[str, Fidelity]] = {}
    for view, told in _table(table, "views").items():
        for id, numbers in _table(told, "episodes").items():
            entry = entries.get(id)
            if entry is None or view not in entry.frames_sha256:
                continue
            fidelity = _fidelity(numbers)
            if fidelity is not None and _table(measured, id).get(view) == entry.frames_id(view):
                episodes.setdefault(id, {})[view] = fidelity
    today = set(_checkpoints(run))
    outdated = bool(today) and any(
        value not in today for value in map(str, _table(table, "inputs", "checkpoints").values())
    )
    return MeasuredFidelity(run, episodes, outdated=outdated)


def _fidelity(numbers: Any) -> Fidelity | None:
    of = _table(numbers, "vqgan")
    psnr_db = _number(of.get("psnr"))
    if psnr_db is None:
        return None
    return Fidelity(psnr_db, _number(of.get("moving_psnr")), _number(numbers.get("lpips")))


def _checkpoints(run: Path) -> Iterator[str]:
    """The checksums in the headers of the run's checkpoints."""
    for path in run.rglob(CHECKPOINT):
        try:
            yield shards.read_header(path).metadata.get("sha256", "")
        except StoreError:
            continue


def _table(value: Any, *names: str) -> Mapping[str, Any]:
    """The table at the end of this path of names; an empty one where there is none."""
    for name in names:
        value = value.get(name) if isinstance(value, dict) else None
    return value if isinstance(value, dict) else {}


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None
