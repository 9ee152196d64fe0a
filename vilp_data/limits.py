"""How much a log may ask for before it is believed to be broken or hostile: one named number each, with its reason.

A header of a few bytes can claim terabytes. What allocates, recurses or opens a path on a log's word asks here first. Each limit
is far above anything a recorder writes; a log that truly needs more is read with the environment variable that the error names
(`VILP_MAX_CHUNK_BYTES=4GiB vilp-data inspect run.mcap`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from vilp_data.errors import LogError, UsageError, salvage_command

_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "ki": 1 << 10, "mi": 1 << 20, "gi": 1 << 30}


def _limit(name: str, default: int, environment: Mapping[str, str] = os.environ) -> int:
    """The limit `name`: its default, or what VILP_MAX_<name> says (`500000`, `4GiB`). UsageError where that is no number."""
    said = environment.get(f"VILP_MAX_{name}", "")
    match = re.fullmatch(r"\s*(\d{1,18})\s*(k|m|g|ki|mi|gi)?b?\s*", said.lower())
    if said and (match is None or int(match[1]) == 0):
        raise UsageError("not a limit", where=f"VILP_MAX_{name}", found=repr(said), remedy="a number above 0, as 4GiB")
    return int(match[1]) * _UNITS[match[2] or ""] if match else default


CHUNK_BYTES = _limit("CHUNK_BYTES", 1 << 30)
"""A chunk when inflated. Recorders write 0.5 to 16 MB; single-chunk files of a few hundred MB exist."""

ARRAY_CHUNK_BYTES = _limit("ARRAY_CHUNK_BYTES", 256 << 20)
"""Rows of an array that can only be read together: a chunk of HDF5, a row of chunks of zarr, one row of a table. A whole camera's
episode in one chunk, as some writers leave it, is 80 MB."""

RECORD_BYTES = _limit("RECORD_BYTES", 1 << 30)
"""One record (a message, a schema, a summary) that is held in memory whole. The largest messages, dense point clouds and raw
images of 60 megapixels, stay below 200 MB."""

IMAGE_PIXELS = _limit("IMAGE_PIXELS", 1 << 26)
"""Pixels of one image, 67 million: 201 MB as RGB. A PNG of a few kB can claim 4 billion."""

DEFINITION_BYTES = _limit("DEFINITION_BYTES", 8 << 20)
"""The text or descriptors of one schema, everything it refers to included. The longest in ROS 2 has 30 kB."""

DEFINITION_DEPTH = _limit("DEFINITION_DEPTH", 40)
"""How deep message types may nest. The deepest in ROS 2 has 8 levels; recursion ends Python at some hundred."""

JSON_DEPTH = _limit("JSON_DEPTH", 100)
"""How deep the lists and objects of a JSON message may nest: what walks a message's members is recursive."""

NAME_BYTES = 200
"""Of a file name made from a log's name, in UTF-8. File systems allow 255, and a suffix must fit."""


def exceeded(what: str, name: str, found: int, *, where: object) -> LogError:
    """The error for a log that asks for more than the limit `name`, with the way to raise it."""
    rest = ""
    if isinstance(where, Path) and where.suffix in (".mcap", ".bag", ".db3", ".active"):
        rest = f" ({salvage_command(where)} reads the rest)"
    return LogError(
        f"{what} claims more than any recorder writes",
        where=where,
        found=f"{found:,} where {globals()[name]:,} are allowed",
        remedy=f"the log is probably damaged{rest}; if not, set VILP_MAX_{name}={found}",
    )


def check(what: str, name: str, found: int, *, where: object) -> None:
    """LogError where `found` is above the limit `name` (`CHUNK_BYTES`)."""
    if found > globals()[name]:
        raise exceeded(what, name, found, where=where)


# --- names that become file names ---------------------------------------------------------------------------------------------


def file_name(name: str, *, default: str = "unnamed") -> str:
    """A log's own name (a topic, an episode, a view) as the name of one visible file: letters, digits and `-_.` stay, everything
    else (slashes and NUL too) becomes `_`; no leading dot, at most NAME_BYTES. Two names may give one: make it unique."""
    plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in name).lstrip(".")
    return plain.encode()[:NAME_BYTES].decode(errors="ignore") or default


def inside(folder: Path, relative: str, *, where: object) -> Path:
    """The path of a file that a log names, relative to its own folder; LogError where the name leads out of that folder.

    Absolute paths, `..`, NUL and a symbolic link out of it are refused; the file need not exist."""
    parts = PurePosixPath(relative.replace("\\", "/"))
    if (
        "\0" in relative
        or not parts.parts
        or parts.is_absolute()
        or ".." in parts.parts
        or re.match(r"[A-Za-z]:", relative)
        or any(len(part.encode(errors="surrogatepass")) > 255 for part in parts.parts)
    ):
        raise _leads_out(folder, relative, where)
    path = folder / parts
    if not path.resolve().is_relative_to(folder.resolve()):
        raise _leads_out(folder, relative, where)
    return path


def _leads_out(folder: Path, relative: str, where: object) -> LogError:
    return LogError(
        "it names a file outside its own folder",
        where=where,
        found=f"{relative!r}, in {folder}",
        remedy="a log may only name files beside it: put the file there and correct the name",
    )
