"""Ingest findings that say the same of many episodes, told once: they differ in their numbers alone. Pure.

A number in a name is none of them. A finding names its part or view first (`view arm1: 3 of 30 steps …`), and counts after that."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

_COUNT = re.compile(r"(?<!\S)\d+(\.\d+)?(?!\.\d|[\w:])")


@dataclass(frozen=True)
class AlikeFindings:
    """A sentence about `episodes`, as it is said of the first of them; never empty."""

    sentence: str
    episodes: tuple[str, ...]


def alike_findings(found: Iterable[tuple[str, str]]) -> list[AlikeFindings]:
    """(episode, sentence) pairs put together, those that concern most episodes first."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for episode, sentence in found:
        subject, colon, said = sentence.partition(": ") if ": " in sentence else ("", "", sentence)
        groups.setdefault(subject + colon + _COUNT.sub("N", said), []).append((episode, sentence))
    inorder = sorted(groups.values(), key=lambda group: (-len(group), group[0]))
    return [AlikeFindings(group[0][1], tuple(episode for episode, _ in group)) for group in inorder]
