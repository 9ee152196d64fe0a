"""The lock of a split, a plain value and its JSON: which side every episode is on, and what keeps it there."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from vilp_data.duplicates import NearDuplicate
from vilp_data.errors import SplitError

Side = Literal["train", "val"]
RatioOrigin = Literal["task", "command line"]

LOCK_FORMAT = 1


@dataclass(frozen=True)
class SplitLock:
    """The split of a dataset.

    assignment       episode id -> "train" or "val", vanished episodes included
    hash             SHA-256 of the assignment, as recorded; `is_intact` says whether it still fits
    ratio            share of training episodes aimed at; `ratio_from` says whether the task or the command line set it
    groups           episode id -> its group (its own id where the task groups by nothing)
    contents         episode id -> content hash, so that a renamed copy of a vanished episode is known again
    twins            the same for what was done and measured without the pictures (`twins.twin_hash`), of episodes that have actions
    duplicates       ids with identical content, each list sorted
    near_duplicates  closest first, pairs across the two sides before the others; reported, never moved
    """

    assignment: Mapping[str, Side]
    hash: str
    seed: int
    ratio: float
    ratio_from: RatioOrigin
    group_by: str | None
    strata: tuple[str, ...]
    groups: Mapping[str, str]
    contents: Mapping[str, str]
    twins: Mapping[str, str] = field(default_factory=dict)
    duplicates: tuple[tuple[str, ...], ...] = ()
    near_duplicates: tuple[NearDuplicate, ...] = ()

    def ids(self, side: Side) -> list[str]:
        """Episodes on one side, sorted."""
        return sorted(id for id, assigned in self.assignment.items() if assigned == side)

    @property
    def twin_groups(self) -> list[list[str]]:
        """Episodes of the same actions and low_dim whose contents differ all the same, group by group, sorted."""
        same: dict[str, list[str]] = defaultdict(list)
        for id, twin in sorted(self.twins.items()):
            same[twin].append(id)
        return [ids for ids in same.values() if len({self.contents.get(id, id) for id in ids}) > 1]

    @property
    def is_intact(self) -> bool:
        return self.hash == assignment_hash(self.assignment)

    def to_json(self) -> bytes:
        """The lock file: the same bytes for the same split."""
        table = {
            "format": LOCK_FORMAT,
            "hash": self.hash,
            "seed": self.seed,
            "ratio": self.ratio,
            "ratio_from": self.ratio_from,
            "group_by": self.group_by,
            "strata": list(self.strata),
            "assignment": dict(self.assignment),
            "groups": dict(self.groups),
            "contents": dict(self.contents),
            **({"twins": dict(self.twins)} if self.twins else {}),
            "duplicates": [list(ids) for ids in self.duplicates],
            "near_duplicates": [[pair.first, pair.second, pair.distance] for pair in self.near_duplicates],
        }
        return (json.dumps(table, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()

    @classmethod
    def from_json(cls, data: bytes, *, where: object = "split.lock.json") -> SplitLock:
        """Read a lock back. SplitError when it is no lock, of another format version, or lacks a key.

        An assignment that was changed by hand is read as it stands: `is_intact` tells."""
        remedy = "restore the file from a backup, or draw a new split with `vilp-data split --redraw`"
        try:
            table = json.loads(data)
            if table["format"] != LOCK_FORMAT:
                raise ValueError(f"format {table['format']!r}, this is {LOCK_FORMAT}")
            lock = cls(
                assignment={str(id): _one_of(Side, side) for id, side in table["assignment"].items()},
                hash=str(table["hash"]),
                seed=int(table["seed"]),
                ratio=float(table["ratio"]),
                ratio_from=_one_of(RatioOrigin, table["ratio_from"]),
                group_by=table["group_by"],
                strata=tuple(table["strata"]),
                groups=_texts(table["groups"]),
                contents=_texts(table["contents"]),
                twins=_texts(table.get("twins", {})),  # locks of before there were any hold none
                duplicates=tuple(tuple(ids) for ids in table["duplicates"]),
                near_duplicates=tuple(NearDuplicate(*pair) for pair in table["near_duplicates"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise SplitError(
                "not a split lock that can be read", where=where, found=repr(error), remedy=remedy
            ) from error
        return lock


def assignment_hash(assignment: Mapping[str, Side]) -> str:
    """SHA-256 of an assignment, independent of its order: what checkpoints carry."""
    return hashlib.sha256(json.dumps(dict(assignment), sort_keys=True).encode()).hexdigest()


def _texts(table: Mapping[str, object]) -> dict[str, str]:
    return {id: str(value) for id, value in table.items()}


def _one_of(choices: Any, value: object) -> Any:
    if value not in get_args(choices):
        raise ValueError(f"{value!r} is none of {', '.join(get_args(choices))}")
    return value
