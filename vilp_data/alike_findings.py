"""Ingest findings that say the same of many episodes, told once: they differ in their numbers alone. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True)
class AlikeFindings:
    """A sentence about `episodes`, as it is said of the first of them; never empty."""

    sentence: str
    episodes: tuple[str, ...]


def alike_findings(found: Iterable[tuple[str, str]]) -> list[AlikeFindings]:
    """(episode, sentence) pairs put together, those that concern most episodes first."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for episode, sentence in found:
        groups.setdefault(_NUMBER.sub("N", sentence), []).append((episode, sentence))
    inorder = sorted(groups.values(), key=lambda group: (-len(group), group[0]))
    return [AlikeFindings(group[0][1], tuple(episode for episode, _ in group)) for group in inorder]
