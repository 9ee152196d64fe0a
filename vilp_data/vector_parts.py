"""The parts of a stored vector, and what their numbers are called: pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from vilp_data.decode.field_paths import range_of
from vilp_data.short_names import Token, short_names
from vilp_data.spec import ActionSpec, VectorSpec
from vilp_data.types import F32, ColumnNames

Parts = Mapping[str, ActionSpec | VectorSpec]
NO_NAMES: Mapping[str, Sequence[str]] = {}


def vector_parts(
    values: F32, parts: Parts, names: Mapping[str, Sequence[str]] = NO_NAMES
) -> dict[str, tuple[list[str], F32]]:
    """Part -> (a name for each column, its columns [F, n]) of a stored vector [F, sum of n], parts in the spec's order.

    `names`: part -> what the log calls its numbers, where it says more than the spec; a number that it has no name for ("") goes by what
    the spec says of it. One part called "" where neither tells the widths: a part without fields takes whatever its messages hold."""
    stated = {name: stated_names(part) for name, part in parts.items()}
    told = {name: _filled(names[name], labels) if name in names else labels for name, labels in stated.items()}
    for labels in (told, stated):
        if sum(map(len, labels.values())) == values.shape[1]:
            starts = np.cumsum([0, *map(len, labels.values())])
            spans = zip(labels.items(), starts, strict=False)  # one start more than parts: the end
            return {
                name: (columns, values[:, start : start + len(columns)]) for (name, columns), start in spans if columns
            }
    return {"": ([str(index) for index in range(values.shape[1])], values)} if values.shape[1] else {}


def stated_names(part: ActionSpec | VectorSpec) -> list[str]:
    """A name for each number of a part, as far as the spec tells: a joint, `x`, `y`, or the index within a slice; no two alike."""
    ways: list[tuple[Token, ...]] = []
    for path in part.fields or [""] * bool(part.names):
        found = range_of(path)
        members = [name for name in (found[0] if found else path).removeprefix("msg.").split(".") if name]
        ends = part.names or (map(str, found[1]) if found else ())
        ways += [(*members, end) for end in ends] or [tuple(members)] * (found is None)
    return _filled(short_names(ways), [])


def _filled(names: Sequence[str], stated: Sequence[str]) -> list[str]:
    """Names, "" among them replaced by what is stated, where that is of as many numbers and no name already, else by the place."""
    places = [str(place) for place in range(len(names))]
    for instead in (stated, places, [f"[{place}]" for place in places]):
        if len(instead) == len(names):
            labels = [name or other for name, other in zip(names, instead, strict=True)]
            if len(set(labels)) == len(labels):
                return labels
    return places


def shared_names(episodes: Iterable[ColumnNames], vector: str) -> dict[str, list[str]]:
    """Part -> what its numbers are called in all of the episodes that say it; "" for a number that they call differently."""
    found = {}
    for (of, part), columns in _told(episodes).items():
        if of == vector and columns is not None:
            names = [next(iter(column)) if len(column) == 1 else "" for column in columns]
            found[part] = [name if names.count(name) == 1 else "" for name in names]
    return found


def names_that_differ(episodes: Iterable[ColumnNames]) -> list[str]:
    """A sentence about the parts whose numbers two episodes call differently; none where there is no such part."""
    parts = []
    for (vector, part), columns in sorted(_told(episodes).items()):
        every = [name for column in columns or () for name in column]
        if columns is None or any(len(column) > 1 for column in columns) or len(set(every)) < len(every):
            parts.append(f"{vector}.{part}")
    said = f"logs name the numbers of {', '.join(parts)} differently, so columns of theirs may not mean the same"
    return [f"{said}; `names` in the task reads joints in one order"] * bool(parts)


def _told(episodes: Iterable[ColumnNames]) -> dict[tuple[str, str], list[set[str]] | None]:
    """(vector, part) -> all that each of its numbers is called; None where not even their count is the same."""
    told: dict[tuple[str, str], list[set[str]] | None] = {}
    for names in episodes:
        for vector, parts in names.items():
            for part, labels in parts.items():
                columns = told.setdefault((vector, part), [set() for _ in labels])
                if columns is None or len(columns) != len(labels):
                    told[vector, part] = None
                    continue
                for column, label in zip(columns, labels, strict=True):
                    column.update([label] if label else ())
    return told
