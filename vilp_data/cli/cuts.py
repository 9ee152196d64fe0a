"""What `ingest --preview` and `inspect --task` print: the demonstrations in logs, before anything is written."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from vilp_data.cli.options import print_json
from vilp_data.cut_log import CutPreview, preview
from vilp_data.demonstrations import LOG_TAG
from vilp_data.errors import VilpDataError
from vilp_data.log_files import find_logs
from vilp_data.spec import TaskSpec

SHOWN_TAG = 40


def cuts_of(logs: Sequence[Path], spec: TaskSpec) -> tuple[list[CutPreview], list[str], list[str]]:
    """Every demonstration in the logs, sentences about what is left out, and why logs could not be read."""
    cuts: list[CutPreview] = []
    notes: list[str] = []
    failed: list[str] = []
    for path in find_logs(logs).logs:
        try:
            found, said = preview(path, spec)
        except VilpDataError as error:
            failed.append(str(error))
            continue
        cuts += found
        notes += said
    return cuts, notes, failed


def cuts_as_data(logs: Sequence[Path], spec: TaskSpec) -> dict[str, list[Any]]:
    """The same as plain data, ready for JSON."""
    cuts, notes, failed = cuts_of(logs, spec)
    return {"demonstrations": [dataclasses.asdict(cut) for cut in cuts], "notes": notes, "failed": failed}


def print_cuts(logs: Sequence[Path], spec: TaskSpec, *, as_json: bool) -> bool:
    """Print every demonstration in the logs; False where a log could not be read."""
    if as_json:
        told = cuts_as_data(logs, spec)
        print_json(told)
        return not told["failed"]
    cuts, notes, failed = cuts_of(logs, spec)
    lines: list[str] = []
    for log, group in groupby(cuts, key=lambda cut: cut.log):
        members = list(group)
        width = max(len(cut.name) for cut in members)
        lines += [log, *(_line(cut, width) for cut in members)]
    print("\n".join([*lines, *notes, _sum(cuts)]))
    for message in failed:
        print(message, file=sys.stderr)
    return not failed


def _line(cut: CutPreview, width: int) -> str:
    messages = "?" if cut.messages is None else str(cut.messages)
    tags = "  ".join(f"{name}={value[:SHOWN_TAG]}" for name, value in sorted(cut.tags.items()) if name != LOG_TAG)
    return f"  {cut.name:<{width}}  from {cut.start_s:9.3f} s  for {cut.duration_s:8.3f} s  {messages:>7} messages  {tags}".rstrip()


def _sum(cuts: Sequence[CutPreview]) -> str:
    many = "1 demonstration" if len(cuts) == 1 else f"{len(cuts)} demonstrations"
    return f"{many}, {sum(cut.duration_s for cut in cuts):.1f} s in all; nothing was written"
