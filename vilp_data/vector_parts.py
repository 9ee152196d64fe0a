"""The parts of a stored vector, and what their numbers are called: pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from vilp_data.spec import ActionSpec, VectorSpec
from vilp_data.types import F32, ColumnNames

Parts = Mapping[str, ActionSpec | VectorSpec]
NO_NAMES: Mapping[str, Sequence[str]] = {}


def vector_parts(
    values: F32, parts: Parts, names: Mapping[str, Sequence[str]] = NO_NAMES
) -> dict[str, tuple[list[str], F32]]:
    """Part -> (a name for each column, its columns [F, n]) of a stored vector [F, sum of n], parts in the spec's order.

    `names`: part -> what the log calls its numbers, where it says more than the spec. One part called "" where neither tells the
    widths: a part without fields takes whatever its messages hold."""
    stated = {name: stated_names(part) for name, part in parts.items()}
    for labels in ({name: list(names.get(name, stated[name])) for name in parts}, stated):
        if sum(map(len, labels.values())) == values.shape[1]:
            starts = np.cumsum([0, *map(len, labels.values())])
            spans = zip(labels.items(), starts, strict=False)  # one start more than parts: the end
            return {
                name: (columns, values[:, start : start + len(columns)]) for (name, columns), start in spans if columns
            }
    return {"": ([str(index) for index in range(values.shape[1])], values)} if values.shape[1] else {}


def stated_names(part: ActionSpec | VectorSpec) -> list[str]:
    """A name for each number of a part, as far as the spec tells: `x`, `y`, or the index within a slice."""
    labels: list[str] = []
    for path in part.fields:
        start, colon, stop = path.rpartition("[")[2].rstrip("]").partition(":")
        if colon:
            labels += [str(index) for index in range(int(start), int(stop))]
        else:
            labels.append(path.rpartition(".")[2])
    return list(part.names) if part.names and len(labels) <= 1 else labels


def shared_names(episodes: Iterable[ColumnNames], vector: str) -> dict[str, list[str]]:
    """Part -> what its numbers are called in all of the episodes that say it; a number that they call differently goes by its place."""
    told: dict[str, list[Sequence[str]]] = {}
    for names in episodes:
        for part, labels in names.get(vector, {}).items():
            if labels not in told.setdefault(part, []):
                told[part].append(labels)
    return {
        part: [
            column[0] if len(set(column)) == 1 else str(place) for place, column in enumerate(zip(*found, strict=True))
        ]
        for part, found in told.items()
        if len(set(map(len, found))) == 1
    }


def differing_parts(episodes: Iterable[ColumnNames]) -> list[str]:
    """The parts ("low_dim.arm") whose numbers two episodes call differently: their columns may not mean the same."""
    told: dict[str, set[tuple[str, ...]]] = {}
    for names in episodes:
        for vector, parts in names.items():
            for part, labels in parts.items():
                told.setdefault(f"{vector}.{part}", set()).add(tuple(labels))
    return sorted(part for part, found in told.items() if len(found) > 1)
