"""The transform between two frames over time, from the links that `/tf` and `/tf_static` published. Pure.

A static link holds at all times; one that is published again with another value holds from then on. Only links stamped at or before an
instant decide what holds at it. A long log has links by the ten million, most of them of frames that nobody asked for: what is kept is
packed, and once much of it is of no use, only the frames are kept that those asked for ever hung on.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vilp_data import align, rotations
from vilp_data.align import ALWAYS_NS, Latest
from vilp_data.errors import DecodeError, nearest, some_of
from vilp_data.transforms import Link, Transform, plain
from vilp_data.types import F64, I64, Bool

LINKS_BEFORE_SORTING_OUT = 200_000
"""Links that are kept whatever they are of: 15 MB, and by then a tree has shown itself."""

INSTANTS_AT_ONCE = 8192
SHOWN_FRAMES = 30

Chains = tuple[list[str], list[str]]
"""The children to climb through from each of two frames up to their nearest common ancestor."""


class TransformTree:
    """Give it links (`add`), those of one child in the order in which they came; then ask for the way `between` two frames.

    `wanted`: the frames that will be asked for. `needed`: frames to keep from the first link on. Where a frame turns out to matter whose
    links were passed over by then, `missed` names it: read the messages again into `again()`."""

    def __init__(self, wanted: Iterable[str], *, needed: Collection[str] = ()) -> None:
        self._wanted, self._needed = {plain(frame) for frame in wanted}, set(needed)
        self._static: dict[str, _Packed] = {}
        self._moving: dict[str, _Packed] = {}
        self._parents: dict[str, set[str]] = {}  # of every child, all that it ever had
        self._useless: set[str] = set()
        self._since_sorting_out = 0
        self.missed: set[str] = set()

    def add(self, links: Iterable[Link]) -> None:
        for link in links:
            parents = self._parents.setdefault(link.child, set())
            if link.parent not in parents:
                parents.add(link.parent)
                if self._useless:
                    self._notice_new()
            if link.child in self._useless:
                continue
            rows = self._static if link.static else self._moving
            rows.setdefault(link.child, _Packed()).add(link)
            self._since_sorting_out += 1
        if self._since_sorting_out >= LINKS_BEFORE_SORTING_OUT:
            self._sort_out()

    def again(self) -> TransformTree:
        """An empty tree for another reading, which will keep what this one missed."""
        return TransformTree(self._wanted, needed=self._needed | self.missed)

    def between(self, from_frame: str, to_frame: str, *, where: str) -> TransformTrack:
        """Where `to_frame` lies in `from_frame`. Raises DecodeError where nothing ever joins the two, naming the frames there are and
        the gap; AlignError where the clock of a frame between them jumps back."""
        from_frame, to_frame = plain(from_frame), plain(to_frame)
        above = self._above((from_frame, to_frame))
        children = {
            child: _history(self._static.get(child), self._moving.get(child), where=f"{where}, frame {child!r}")
            for child in above & {*self._static, *self._moving}
        }
        track = TransformTrack(children, from_frame, to_frame)
        if not track.ever_joined():
            raise self._not_joined(from_frame, to_frame, where)
        return track

    def _above(self, frames: Iterable[str]) -> set[str]:
        """Those frames, and every frame that ever was above them: no other can matter."""
        above, left = set(frames), list(frames)
        while left:
            new = self._parents.get(left.pop(), set()) - above
            above |= new
            left += new
        return above

    def _notice_new(self) -> None:
        found = self._useless & self._above(self._wanted)
        self.missed |= found
        self._useless -= found

    def _sort_out(self) -> None:
        self._since_sorting_out = 0
        self._useless = set(self._parents) - self._above(self._wanted) - self._needed
        for child in self._useless:
            self._static.pop(child, None)
            self._moving.pop(child, None)

    def _not_joined(self, from_frame: str, to_frame: str, where: str) -> DecodeError:
        frames = sorted({*self._parents, *(parent for parents in self._parents.values() for parent in parents)})
        shown = some_of(frames, SHOWN_FRAMES) or "none"
        for frame in (from_frame, to_frame):
            if frame not in frames:
                return DecodeError(f"no frame called {frame!r}", where=where, remedy=nearest(frame, frames))
        last = {child: packed.last_parent for rows in (self._static, self._moving) for child, packed in rows.items()}
        ends = [_climb(last, frame) for frame in (from_frame, to_frame)]
        if ends[0] is None or ends[1] is None:
            remedy = "correct who publishes them"
            return DecodeError("the frames run in a circle", where=where, found=shown, remedy=remedy)
        roots = [end[-1] for end in ends if end is not None]
        return DecodeError(
            f"nothing joins frames {from_frame!r} and {to_frame!r}: no transform between {roots[0]!r} and {roots[1]!r}",
            where=where, found=f"{' -> '.join(ends[0])} and {' -> '.join(ends[1])}; frames: {shown}",
            remedy="choose two frames of one tree, or record the topic that holds the missing transform",
        )  # fmt: skip


class TransformTrack:
    """Where one frame lies in another at any instant, translation x y z and unit quaternion x y z w."""

    def __init__(self, children: Mapping[str, _History], from_frame: str, to_frame: str) -> None:
        # Between two of these instants no frame changes its parent; few of the trees that follow each other are new.
        self._bounds = _union(history.new_parents_ns for history in children.values())
        parents = np.array([history.parents_at(self._bounds) for history in children.values()], np.int64)
        trees, self._tree_of = np.unique(parents.reshape(len(children), len(self._bounds)), axis=1, return_inverse=True)
        self._chains = [_chains(_named(tree, children), from_frame, to_frame) for tree in trees.T]
        used = {child for chains in self._chains if chains is not None for chain in chains for child in chain}
        self._children = {child: children[child] for child in used}

    @property
    def stamps_ns(self) -> I64:
        """Every instant at which a link on a way between the two was stamped, ascending; ALWAYS_NS for static ones."""
        return _union(history.stamps_ns for history in self._children.values())

    def known_ns(self) -> I64:
        """Those of `stamps_ns` at which the transform is known, and not by static links alone."""
        stamps_ns = self.stamps_ns
        stamps_ns = stamps_ns[stamps_ns > ALWAYS_NS]
        parts = (self.at(part).values for part in _split(stamps_ns))
        known = [np.isfinite(values).all(axis=1) for values in parts]
        return np.asarray(stamps_ns[np.concatenate([np.zeros(0, np.bool_), *known])])

    def at(self, instants_ns: I64) -> Latest:
        """What holds at each instant, int64 [F] ascending: values [F,7], their quaternions of continuous sign, the first with w >= 0;
        and the stamp of the oldest link that takes part and is not static, ALWAYS_NS where all are."""
        values, stamps_ns = np.full((len(instants_ns), 7), np.nan), np.full(len(instants_ns), align.NEVER_NS)
        segment = np.searchsorted(self._bounds, instants_ns, side="right") - 1
        for number in np.unique(segment[segment >= 0]):
            rows = np.flatnonzero(segment == number)
            if (chains := self._chains[self._tree_of[number]]) is not None:
                for part in _split(rows):
                    values[part], stamps_ns[part] = self._composed(chains, instants_ns[part])
        values[:, 3:] = rotations.continuous(values[:, 3:])
        first = np.flatnonzero(np.isfinite(values[:, 6]))[:1]
        if len(first) and values[first[0], 6] < 0:
            values[:, 3:] *= -1
        return Latest(values, stamps_ns)

    def ever_joined(self) -> bool:
        return any(chains is not None for chains in self._chains)

    def _composed(self, chains: Chains, instants_ns: I64) -> tuple[F64, I64]:
        oldest_ns = np.full(len(instants_ns), np.iinfo(np.int64).max)
        tops = []
        for chain in chains:
            shift, turn = np.zeros((len(instants_ns), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(instants_ns), 1))
            for child in chain:  # from the bottom up: where the frame at the bottom lies in this child's parent
                history = self._children[child]
                rows = history.rows_at(instants_ns)
                link = history.poses[history.pose_rows[rows]]
                shift = rotations.turned(link[:, 3:], shift) + link[:, :3]
                turn = rotations.product(link[:, 3:], turn)
                moving = ~history.static[rows]
                oldest_ns[moving] = np.minimum(oldest_ns[moving], history.stamps_ns[rows[moving]])
            tops.append((shift, turn))
        (from_shift, from_turn), (to_shift, to_turn) = tops
        back = rotations.conjugate(from_turn)
        values = np.concatenate(
            [rotations.turned(back, to_shift - from_shift), rotations.product(back, to_turn)], axis=1
        )
        return values, np.where(oldest_ns == np.iinfo(np.int64).max, ALWAYS_NS, oldest_ns)


# --- one child ----------------------------------------------------------------------------------------------------------


class _Packed:
    """The links of one child as they came: 12 bytes for one that says again what the one before it said, 72 for a new one."""

    def __init__(self) -> None:
        self.stamps, self.pose_rows = array("q"), array("i")
        self.poses, self.parents = (
            array("d"),
            array("i"),
        )  # a row for each pose: seven numbers, and which of `names` it is in
        self.names: list[str] = []
        self._last: tuple[str, Transform] | None = None

    @property
    def last_parent(self) -> str:
        return self.names[self.parents[-1]]

    def add(self, link: Link) -> None:
        pose = link.parent, link.transform
        if pose != self._last:
            self._last = pose
            if link.parent not in self.names:
                self.names.append(link.parent)
            self.parents.append(self.names.index(link.parent))
            self.poses.extend(link.transform)
        elif link.static:
            return  # it says again what holds already
        self.stamps.append(ALWAYS_NS if link.static and not self.stamps else link.stamp_ns)
        self.pose_rows.append(len(self.parents) - 1)


@dataclass(frozen=True)
class _History:
    """A child's links in order of time: stamps int64 [M], bool [M] of the static ones, the pose of each int64 [M], into the poses
    float64 [P,7] and their parents int64 [P], into `names`."""

    stamps_ns: I64
    static: Bool
    pose_rows: I64
    poses: F64
    parents: I64
    names: Sequence[str]

    @property
    def new_parents_ns(self) -> I64:
        """When the child first has a parent, and when it gets another."""
        parents = self.parents[self.pose_rows]
        return np.asarray(self.stamps_ns[np.append(True, parents[1:] != parents[:-1])])

    def rows_at(self, instants_ns: I64) -> I64:
        """The link that holds at each instant; -1 where none has come."""
        return np.asarray(np.searchsorted(self.stamps_ns, instants_ns, side="right") - 1, np.int64)

    def parents_at(self, instants_ns: I64) -> I64:
        """Which of `names` the child lies in at each instant; -1 where in none yet."""
        rows = self.rows_at(instants_ns)
        return np.where(rows < 0, -1, self.parents[self.pose_rows[np.maximum(rows, 0)]])


def _history(static: _Packed | None, moving: _Packed | None, *, where: str) -> _History:
    """AlignError where the stamps of the moving links tell no time, or were reset."""
    parts = [packed for packed in (static, moving) if packed is not None]
    stamps_ns = np.concatenate([np.frombuffer(packed.stamps, np.int64) for packed in parts])
    is_static = np.repeat([packed is static for packed in parts], [len(packed.stamps) for packed in parts])
    order = np.argsort(stamps_ns, kind="stable")
    if moving is not None:
        align.in_time(moving.stamps, topic=where, may_repeat=2)  # who republishes a link says it twice
    n_poses, n_names = len(parts[0].parents), len(parts[0].names)  # what the second part's numbers count on from
    rows = [np.frombuffer(packed.pose_rows, np.int32) + number * n_poses for number, packed in enumerate(parts)]
    parents = [np.frombuffer(packed.parents, np.int32) + number * n_names for number, packed in enumerate(parts)]
    poses = [np.frombuffer(packed.poses, np.float64).reshape(-1, 7) for packed in parts]
    return _History(
        stamps_ns[order], is_static[order], np.concatenate(rows)[order].astype(np.int64),
        poses[0] if len(poses) == 1 else np.concatenate(poses), np.concatenate(parents).astype(np.int64),
        [name for packed in parts for name in packed.names],
    )  # fmt: skip


# --- the tree at an instant ---------------------------------------------------------------------------------------------


def _named(tree: I64, children: Mapping[str, _History]) -> dict[str, str]:
    """Child -> parent, of a row of numbers into each child's own names."""
    return {child: children[child].names[number] for child, number in zip(children, tree, strict=True) if number >= 0}


def _chains(parents: Mapping[str, str], from_frame: str, to_frame: str) -> Chains | None:
    """None where the two have no ancestor in common, or hang in a circle."""
    up_from, up_to = _climb(parents, from_frame), _climb(parents, to_frame)
    if up_from is None or up_to is None:
        return None
    place = {frame: number for number, frame in enumerate(up_from)}
    for number, frame in enumerate(up_to):
        if frame in place:
            return up_from[: place[frame]], up_to[:number]
    return None


def _climb(parents: Mapping[str, str], frame: str) -> list[str] | None:
    """A frame and those above it, up to its root; None where they run in a circle."""
    frames = [frame]
    while (parent := parents.get(frames[-1])) is not None:
        if parent in frames:
            return None
        frames.append(parent)
    return frames


def _union(stamps_ns: Iterable[I64]) -> I64:
    return np.unique(np.concatenate([np.zeros(0, np.int64), *stamps_ns]))


def _split(values: I64) -> Iterator[I64]:
    return (values[first : first + INSTANTS_AT_ONCE] for first in range(0, len(values), INSTANTS_AT_ONCE))
