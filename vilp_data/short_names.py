"""Names of numbers that can be stored and shown: on one line, of printable letters, and as short as keeps them apart. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache

LONGEST_NAME = 100
"""Characters of a name that are kept: whoever wrote the log chose it."""

LONGEST_READ = 10 * LONGEST_NAME

Token = str | int
"""A step on the way to a number: the name of a member or of an item, or an item's place in its list where nothing names it."""


def clean_name(name: str) -> str:
    """A name without what a terminal or a page could take for more than text, half characters, line breaks; as long as is read."""
    return _cleaned(name[:LONGEST_READ])


@lru_cache(maxsize=4096)
def _cleaned(name: str) -> str:
    letters = [letter if letter.isprintable() else " " * letter.isspace() for letter in name]
    return " ".join("".join(letters).split())[:LONGEST_NAME].strip()


def short_names(places: Sequence[Sequence[Token]]) -> tuple[str, ...]:
    """A name for each way to a number: as many of its last tokens as tell all of them apart, joined by dots. "" for one that ends in a
    place, holds a token without letters, or is told apart from another by nothing."""
    counts = Counter(tuple(place) for place in places)
    named = [bool(place) and isinstance(place[-1], str) and "" not in place and counts[tuple(place)] == 1 for place in places]  # fmt: skip
    names: list[str] = []
    for n_tokens in range(1, max([1, *map(len, places)]) + 1):
        names = [
            clean_name(".".join(map(str, place[-n_tokens:]))) if known else ""
            for place, known in zip(places, named, strict=True)
        ]
        times = Counter(names)
        if all(times[name] == 1 for name in names if name):
            return tuple(names)
    return tuple(name if times[name] == 1 else "" for name in names)
