"""Logs and datasets checked one by one, and then against each other: what only shows in company.

Actions are judged over all demonstrations of the same topics together, and demonstrations that look alike are named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from vilp_data.check.action import action_findings
from vilp_data.check.action_fit import fit_action
from vilp_data.check.copies import copies_finding, same_logs
from vilp_data.check.dataset import check_dataset
from vilp_data.check.findings import Finding, Place, worst_first
from vilp_data.check.log import check_log
from vilp_data.check.report import Checked, Fit, Steps
from vilp_data.duplicates import near_duplicates
from vilp_data.engine import map_unordered
from vilp_data.errors import VilpDataError
from vilp_data.locate import is_dataset
from vilp_data.log_files import find_logs
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec

BETWEEN = "\x1f"  # between a source and a demonstration in a name: in no path


SAME_DISTANCE = 0.1
"""Grey levels (of 255) between pictures of one recording under two names; runs of one script in one scene lie further apart."""


@dataclass(frozen=True)
class CheckReport:
    """Everything that was checked, in the order given; `together`: findings about several of them; `fits` of their actions."""

    checked: tuple[Checked, ...]
    together: tuple[Finding, ...]
    fits: tuple[Fit, ...]

    @property
    def folder(self) -> str:
        """What all sources begin with, for showing them shorter: `bags/`; empty where there is nothing in common, or one source."""
        parents = {str(Path(checked.source).parent) for checked in self.checked}
        return f"{parents.pop()}/" if len(parents) == 1 and len(self.checked) > 1 else ""

    @property
    def findings(self) -> list[Finding]:
        """All of them, worst first."""
        return worst_first([*self.together, *(finding for one in self.checked for finding in one.findings)])


def check_sources(
    paths: Sequence[Path],
    *,
    spec: TaskSpec | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> CheckReport:
    """Check logs, folders of logs and datasets. `spec` is for the logs; a dataset has its own. UsageError for a path without any.
    `progress(done, total)` counts logs and datasets."""
    todo = list(_todo(paths))
    results: dict[Path, Checked] = {}
    check = partial(_check_one, spec=spec)
    with closing(map_unordered(check, todo, workers=workers if len(todo) > 1 else 1)) as finished:
        for path, result in finished:
            results[path] = result
            if progress is not None:
                progress(len(results), len(todo))
    checked = tuple(results[path] for path in todo)
    fits, found = _actions(checked)
    same = same_logs(checked, _sha256)
    again = {source for sources in same for source in sources[1:]}
    alike = _look_alike([one for one in checked if one.source not in again])
    return CheckReport(checked, (*map(copies_finding, same), *found, *alike), tuple(fits))


def _todo(paths: Sequence[Path]) -> Iterator[Path]:
    logs = [path for path in paths if not is_dataset(path)]
    found = find_logs(logs) if logs else None
    yield from dict.fromkeys([path for path in paths if is_dataset(path)])
    if found is not None:
        yield from [*found.logs, *found.passed_over]


def _check_one(path: Path, spec: TaskSpec | None) -> Checked:
    """One of them looked at. What goes wrong with it is a finding: it must not cost the report on the others."""
    kind: Literal["dataset", "log"] = "dataset" if is_dataset(path) else "log"
    try:
        return check_dataset(path) if kind == "dataset" else check_log(path, spec=spec)
    except VilpDataError as error:
        found = {"found": str(error.found)} if error.found is not None else {}
        finding = Finding(
            severity="error", kind="unreadable", place=Place(source=str(path)), what=error.what, evidence=found, remedy=error.remedy
        )  # fmt: skip
        return Checked(str(path), kind, "unreadable", (finding,))


# --- against each other -------------------------------------------------------------------------------------------------


def _actions(checked: Sequence[Checked]) -> tuple[list[Fit], list[Finding]]:
    """Actions judged over every demonstration with the same topics and rate."""
    groups: list[list[tuple[str, Steps]]] = []
    for one in checked:
        if one.steps is not None:
            group = next((members for members in groups if members[0][1].fits(one.steps)), None)
            if group is None:
                groups.append(group := [])
            group.append((one.source, one.steps))
    fits: list[Fit] = []
    findings: list[Finding] = []
    for members in groups:
        fit = fit_action([
            replace(one, name=f"{source}{BETWEEN}{one.name}") for source, steps in members for one in steps.trajectories
        ])  # fmt: skip
        if fit is None:
            continue
        first = members[0][1]
        where = members[0][0] if len(members) == 1 else f"{len(members)} logs"
        fits.append(Fit(first.topic if len(members) == 1 else f"{first.topic} ({where})", fit, first.rate_hz))
        for finding in action_findings(fit, topic=first.topic, rate_hz=first.rate_hz, certain=first.certain):
            source, _, episode = (finding.place.episode or where).partition(BETWEEN)
            place = Place(source=source, topic=first.topic, episode=episode or None)
            findings.append(replace(finding, place=place))
    return fits, findings


def _sha256(checked: Checked) -> str:
    """Of a log's bytes; of one that is gone meanwhile its path, which is like no other's."""
    try:
        with open_log(Path(checked.source)) as log:
            return log.sha256()
    except (VilpDataError, OSError):
        return checked.source


def _look_alike(checked: Sequence[Checked]) -> Iterator[Finding]:
    """Pairs of demonstrations whose first, middle and last pictures are nearly the same."""
    thumbnails = {
        f"{one.source}{BETWEEN}{name}": small
        for one in checked
        if one.kind == "log"
        for name, small in one.thumbnails.items()
    }
    several = {one.source: len(one.thumbnails) > 1 for one in checked}
    for pair in near_duplicates(thumbnails):
        (source, _, episode), (other, _, twin) = pair.first.partition(BETWEEN), pair.second.partition(BETWEEN)
        named = twin if other == source else f"{other}, {twin}" if several[other] else other
        yield Finding(
            severity="warning" if pair.distance <= SAME_DISTANCE else "note", kind="near-duplicate",
            place=Place(source=source, episode=episode if several[source] else None),
            what=f"looks nearly like {named}",
            evidence={"distance_grey_levels": pair.distance},
            remedy="keep one of them: a copy in the validation set would be judged by what was trained on",
        )  # fmt: skip
