"""What is where in an HDF5 file of demonstrations: groups, arrays, attributes, masks. Nothing outside the file is ever followed.

HDF5 can point to other files (external links and storage, virtual arrays) and leave chunks unwritten, which then read as zeros.
All of that is refused: a log must hold its own rows.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vilp_data import limits
from vilp_data.errors import LogError, copy_again, reason
from vilp_data.sources.hdf5_heaps import refuse_damaged_heaps

MAGIC = b"\x89HDF\r\n\x1a\n"
LAYOUT = "expected the robomimic layout: data/demo_0/actions, data/demo_0/obs/…, data/demo_1/…"
RECOPY = copy_again("file")
LEFT_OUT = frozenset({"next_obs"})
ACTIONS = ("actions", "action")
MASKS = "mask"
MODEL = "model_file"
MAX_ARRAYS = 4096  # of one demonstration
MAX_TAG_LENGTH = 200

# What h5py raises for damaged bytes, besides what it finds at once.
BROKEN = (OSError, KeyError, ValueError, RuntimeError, TypeError, AttributeError)


def open_file(path: Path) -> h5py.File:
    """The file, for reading. LogError where HDF5 finds it cut off or damaged."""
    try:
        file = h5py.File(path, "r", locking="best-effort")
    except BROKEN as error:
        cut = "truncated" in str(error)
        what = "the HDF5 file is cut off" if cut else "the HDF5 file cannot be opened"
        raise LogError(what, where=path, found=reason(error), remedy=RECOPY) from error
    try:
        refuse_damaged_heaps(path)
    except LogError:
        file.close()
        raise
    return file


def find_demonstrations(file: h5py.File, path: Path) -> Demonstrations:
    """The demonstrations of a file; LogError where it holds none."""
    try:
        data = _member(file, "data")
        if isinstance(data, h5py.Group):
            names = sorted((name for name in data if isinstance(_member(data, name), h5py.Group)), key=_by_number)
            if names:
                return Demonstrations(path, data, names, _masks(file))
        if any(isinstance(_member(file, name), h5py.Dataset) for name in ACTIONS):
            return Demonstrations(path, file, [""], {})
        inside = ", ".join(list(file)[:8]) or "nothing"
    except BROKEN as error:
        raise LogError("the HDF5 file is damaged", where=path, found=reason(error), remedy=RECOPY) from error
    raise LogError("no demonstrations in this HDF5 file", where=path, found=f"at its root: {inside}", remedy=LAYOUT)


class Demonstrations:
    """The demonstrations below one group. `names` in order of their numbers; `attributes` of the group, as text."""

    def __init__(self, path: Path, group: h5py.Group, groups: list[str], masks: dict[str, list[str]]) -> None:
        self._path, self._group, self._masks = path, group, masks
        self._groups = {name or "episode": name for name in groups}
        self._opened: dict[str, h5py.Group] = {}
        self._lengths: dict[str, tuple[int, str]] = {}
        self.names = list(self._groups)
        self.attributes = attributes(group)

    def arrays(self) -> dict[str, list[str]]:
        """Name of each array of numbers -> the demonstrations that have it. Whether one holds numbers is asked of the first."""
        holders: dict[str, list[str]] = {}
        numeric: dict[str, bool] = {}
        for name in self.names:
            for topic in self._below(name):
                if topic not in numeric:
                    numeric[topic] = self._is_numeric(name, topic)
                if numeric[topic]:
                    holders.setdefault(topic, []).append(name)
        if not holders:
            raise LogError("the demonstrations hold no array of numbers", where=self._path, remedy=LAYOUT)
        return holders

    def names_of(self, name: str) -> list[str]:
        """The arrays of one demonstration."""
        return sorted(self._below(name))

    def array(self, name: str, topic: str) -> h5py.Dataset | None:
        """One array, or None where the demonstration has none of that name. Raises what BROKEN names for a damaged one."""
        node: Any = self._demonstration(name)
        for part in topic.split("/"):
            node = _member(node, part) if isinstance(node, h5py.Group) else None
        return node if isinstance(node, h5py.Dataset) and node.shape and node.dtype.kind in "biuf" else None

    def n_rows(self, name: str) -> int:
        return self._length(name)[0]

    def length_source(self, name: str) -> str:
        """What says how long a demonstration is: its actions, else what most of its arrays say."""
        return self._length(name)[1]

    def tags(self, name: str) -> dict[str, str]:
        """The demonstration's own short attributes; `masks`: those that name it, with commas between."""
        try:
            own = attributes(self._demonstration(name)) if self._groups[name] else {}
        except BROKEN as error:
            own = {"damaged": f"its attributes cannot be read: {error}"[:MAX_TAG_LENGTH]}
        tags = {
            key: text for key, text in own.items() if len(text) <= MAX_TAG_LENGTH and "\n" not in text and key != MODEL
        }
        masks = [mask for mask, members in self._masks.items() if name in members]
        return tags | ({"masks": ",".join(masks)} if masks else {})

    def model_text(self, name: str) -> str | None:
        """The attribute `model_file`, or the text of the file in models/ that it names. LogError for a name that leads elsewhere."""
        try:
            text = attributes(self._demonstration(name)).get(MODEL)
        except BROKEN as error:
            where = f"{self._path}, {name}"
            raise LogError("its attributes cannot be read", where=where, found=str(error), remedy=RECOPY) from error
        if text is None or text.lstrip().startswith("<"):
            return text
        file = limits.inside(self._path.parent, f"models/{text}", where=f"{self._path}, {name}")
        if not file.is_file():
            return None
        limits.check("the stored model", "DEFINITION_BYTES", file.stat().st_size, where=file)
        return file.read_text(encoding="utf-8", errors="replace")

    def _demonstration(self, name: str) -> h5py.Group:
        if name not in self._opened:
            self._opened[name] = self._group[self._groups[name]] if self._groups[name] else self._group
        return self._opened[name]

    def _below(self, name: str) -> list[str]:
        """Paths of what may be arrays below a demonstration. A damaged group has none: reading it says so."""
        try:
            found = _hard_links(self._demonstration(name))
        except BROKEN:
            return []
        if len(found) > MAX_ARRAYS:
            where = f"{self._path}, {name}"
            raise LogError("a demonstration of too many arrays", where=where, found=f"over {MAX_ARRAYS}", remedy=LAYOUT)
        groups = {path.rpartition("/")[0] for path in found}
        return [path for path in found if path not in groups and path.partition("/")[0] not in LEFT_OUT]

    def _is_numeric(self, name: str, topic: str) -> bool:
        try:
            return self.array(name, topic) is not None
        except BROKEN:
            return False

    def _length(self, name: str) -> tuple[int, str]:
        if name not in self._lengths:
            try:
                self._lengths[name] = self._find_length(name)
            except BROKEN as error:
                where, found = f"{self._path}, {name}", reason(error)
                raise LogError("the demonstration is damaged", where=where, found=found, remedy=RECOPY) from error
        return self._lengths[name]

    def _find_length(self, name: str) -> tuple[int, str]:
        for topic in ACTIONS:
            if (array := self.array(name, topic)) is not None:
                return int(array.shape[0]), topic
        arrays = {topic: self.array(name, topic) for topic in self._below(name)}
        lengths = Counter({topic: array.shape[0] for topic, array in arrays.items() if array is not None})
        if not lengths:
            return 0, "no array"
        topic, length = lengths.most_common(1)[0]
        return int(length), topic


def checked_array(array: h5py.Dataset, where: str) -> None:
    """LogError where the rows of an array are not all in this file, or cannot be read a few at a time."""
    try:
        _check_array(array, where)
    except BROKEN as error:
        raise LogError("the array is damaged", where=where, found=reason(error), remedy=RECOPY) from error


def _check_array(array: h5py.Dataset, where: str) -> None:
    if array.external or array.is_virtual:
        remedy = "write the arrays into the file itself (h5repack, or h5py's copy)"
        raise LogError(
            "its rows are kept in another file", where=where, found="external or virtual storage", remedy=remedy
        )
    if array.size == 0:
        return
    shape = array.chunks or array.shape[1:]
    what = f"{'a chunk' if array.chunks else 'a row'} of {shape} {array.dtype}"
    limits.check(what, "ARRAY_CHUNK_BYTES", int(np.prod(shape, dtype=object)) * array.dtype.itemsize, where=where)
    if array.chunks:
        expected = int(np.prod([-(-n // c) for n, c in zip(array.shape, array.chunks, strict=True)], dtype=object))
        written = array.id.get_num_chunks()
        missing = f"{expected - written} of {expected} chunks" if written < expected else ""
    else:
        missing = "" if array.id.get_storage_size() else "all rows"
    if missing:
        found = f"{missing} never written; HDF5 would read them as its fill value"
        raise LogError(
            "rows are missing", where=where, found=found, remedy="write the demonstration again, or leave it out"
        )


def attributes(group: h5py.Group) -> dict[str, str]:
    """Attributes that are one text or one number, as text; others are left out. Raises what BROKEN names for damaged ones."""
    texts: dict[str, str] = {}
    for name in sorted(group.attrs):
        try:
            value = group.attrs[name]
        except TypeError:  # of a type that NumPy does not have
            continue
        if isinstance(value, bytes):
            value = value.decode(errors="replace")
        if isinstance(value, str | bool | int | float | np.bool_ | np.number):
            texts[name] = str(value)
    return texts


def _hard_links(group: h5py.Group) -> list[str]:
    """Paths of everything below a group that is kept in this very file; groups that hold each other are walked once. At most
    MAX_ARRAYS + 1."""
    found: list[str] = []

    def note(path: bytes, link: Any) -> bool | None:
        if link.type == h5py.h5l.TYPE_HARD:
            found.append(path.decode(errors="replace"))
        return True if len(found) > MAX_ARRAYS else None

    group.id.links.visit(note, info=True)
    return found


def _member(group: h5py.Group, name: str) -> Any:
    """What a group holds under a name in this very file; None for nothing, and for links that lead elsewhere."""
    links, key = group.id.links, name.encode(errors="replace")
    if not links.exists(key) or links.get_info(key).type != h5py.h5l.TYPE_HARD:
        return None
    return group[name]


def _masks(file: h5py.File) -> dict[str, list[str]]:
    """Name of each mask -> the demonstrations in it."""
    group = _member(file, MASKS)
    masks = {}
    for name in sorted(group) if isinstance(group, h5py.Group) else []:
        array = _member(group, name)
        if isinstance(array, h5py.Dataset) and array.ndim == 1 and array.size < 1_000_000 and array.dtype.kind in "SO":
            masks[name] = [text.decode(errors="replace") if isinstance(text, bytes) else str(text) for text in array[:]]
    return masks


def _by_number(name: str) -> list[tuple[int, str]]:
    """demo_9 before demo_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
