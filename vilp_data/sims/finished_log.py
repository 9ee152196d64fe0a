"""The log that an earlier run has finished already: kept where it was made from the same, refused where it was not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from vilp_data.errors import UsageError
from vilp_data.sources import open_log
from vilp_data.types import EPISODE_RECORD, MADE_FROM_RECORD


@dataclass(frozen=True)
class FinishedLog:
    """Its tags, and whether it says all that it was made from: older ones have no record `made_from`."""

    tags: dict[str, str]
    says_what_made_it: bool


def finished_log(
    path: Path, tagged: Mapping[str, str], made_from: Mapping[str, str] | None = None
) -> FinishedLog | None:
    """The log at `path`, every byte of it checked; None where there is none. What it is made from: `tagged`, tags of it, and
    `made_from`, its record of that name, if it has one.

    UsageError where that is something else; LogError where what is there is damaged, or no log."""
    if not path.exists():
        return None
    with open_log(path) as log:
        records = log.metadata()
        log.sha256()  # reads it all, and checks it against its CRC
    tags, told = dict(records.get(EPISODE_RECORD, {})), records.get(MADE_FROM_RECORD)
    _refuse_other(path, tags, tagged)
    if told is not None:
        _refuse_other(path, told, made_from or {})
    return FinishedLog(tags, told is not None)


def _refuse_other(path: Path, told: Mapping[str, str], wanted: Mapping[str, str]) -> None:
    for name, text in wanted.items():
        if told.get(name) != text:
            raise UsageError(
                "this log was made from something else",
                where=path,
                found=f"other {name}: {told.get(name)}, now {text}",
                remedy="write into another folder, or move that log away",
            )
