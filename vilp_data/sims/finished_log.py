"""The log that an earlier run has finished already: kept where it was made from the same, refused where it was not."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from vilp_data.errors import UsageError
from vilp_data.sources import open_log
from vilp_data.types import EPISODE_RECORD


def finished_tags(path: Path, wanted: Mapping[str, str]) -> dict[str, str] | None:
    """The tags of the log at `path`; None where there is none. `wanted`: the tags that say what it is made from.

    UsageError where they are others; LogError where what is there is damaged, or no log."""
    if not path.exists():
        return None
    with open_log(path) as log:
        tags = dict(log.metadata().get(EPISODE_RECORD, {}))
    if differing := [name for name, text in wanted.items() if tags.get(name) != text]:
        name = differing[0]
        raise UsageError(
            "this log was made from something else",
            where=path,
            found=f"other {name}: {tags.get(name)}, now {wanted[name]}",
            remedy="write into another folder, or move that log away",
        )
    return tags
