"""Two states of a dataset, or of two datasets, compared: what is only here or there, other labels, content, sides. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from vilp_data.dataset_state import DatasetState, EpisodeState

Change = tuple[str | None, str | None]
"""A value in the first state and in the second; None where it is not there."""


@dataclass(frozen=True)
class StateDiff:
    """How the second state differs from the first.

    only_first, only_second  ids; an episode that has another name on either side is in `renamed` (its two names) instead
    labels   id -> tag (or "outcome") -> its two values
    content  id -> in words: steps, frames
    sides    id -> the two sides of the split
    files    names of dataset.json and the like that differ, are new or gone
    """

    only_first: tuple[str, ...] = ()
    only_second: tuple[str, ...] = ()
    renamed: tuple[tuple[str, str], ...] = ()
    labels: Mapping[str, Mapping[str, Change]] = field(default_factory=dict)
    content: Mapping[str, str] = field(default_factory=dict)
    sides: Mapping[str, Change] = field(default_factory=dict)
    files: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        """Nothing differs of the episodes and of the split."""
        return not (self.only_first or self.only_second or self.renamed or self.labels or self.content or self.sides)


def compare_states(first: DatasetState, second: DatasetState) -> StateDiff:
    """Episodes are matched by id, those left over by content."""
    both = sorted(first.episodes.keys() & second.episodes.keys())
    pairs = {id: (first.episodes[id], second.episodes[id]) for id in both}
    renamed = _renamed(first, second)
    known_by_other_name = {id for pair in renamed for id in pair}
    labels = {id: changed for id, (one, other) in pairs.items() if (changed := _labels(one, other))}
    content = {id: words for id, (one, other) in pairs.items() if (words := _content(one, other))}
    names = first.files.keys() | second.files.keys()
    return StateDiff(
        only_first=tuple(sorted(first.episodes.keys() - second.episodes.keys() - known_by_other_name)),
        only_second=tuple(sorted(second.episodes.keys() - first.episodes.keys() - known_by_other_name)),
        renamed=renamed,
        labels=labels,
        content=content,
        sides={id: (one.side, other.side) for id, (one, other) in pairs.items() if one.side != other.side},
        files=tuple(sorted(name for name in names if first.files.get(name) != second.files.get(name))),
    )


def _renamed(first: DatasetState, second: DatasetState) -> tuple[tuple[str, str], ...]:
    left = {first.episodes[id].content: id for id in sorted(first.episodes.keys() - second.episodes.keys())}
    pairs = []
    for id in sorted(second.episodes.keys() - first.episodes.keys()):
        other = left.pop(second.episodes[id].content, None)
        if other is not None:
            pairs.append((other, id))
    return tuple(sorted(pairs))


def _labels(one: EpisodeState, other: EpisodeState) -> dict[str, Change]:
    names = sorted(one.tags.keys() | other.tags.keys())
    changed: dict[str, Change] = {
        name: (one.tags.get(name), other.tags.get(name)) for name in names if one.tags.get(name) != other.tags.get(name)
    }
    if one.outcome != other.outcome:
        changed["outcome"] = (one.outcome, other.outcome)
    return changed


def _content(one: EpisodeState, other: EpisodeState) -> str:
    words = []
    if one.n_steps != other.n_steps:
        words.append(f"{one.n_steps} -> {other.n_steps} steps")
    elif one.content != other.content:
        words.append("other values")
    frames = [
        view
        for view in sorted(one.frames.keys() | other.frames.keys())
        if one.frames.get(view) != other.frames.get(view)
    ]
    if frames and one.content != other.content:
        words.append(f"other frames of {', '.join(frames)}")
    return "; ".join(words)
