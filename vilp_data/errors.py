"""Errors a user can act on: what is wrong, where, what was found, what to do."""

from __future__ import annotations

import difflib
import os
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path


class VilpDataError(Exception):
    """Base of every error that vilp_data raises on purpose.

    The message is one to three lines: what and where, what was found, and after "->" what to do about it.
    `exit_code` is what the command line ends with: 1 for findings in the data, 2 for wrong use.
    """

    exit_code = 1

    def __init__(self, what: str, *, where: object = None, found: object = None, remedy: str | None = None) -> None:
        self.what = what
        self.where = where
        self.found = found
        self.remedy = remedy
        text = what if where is None else f"{where}: {what}"
        if found is not None:
            text += f"\n   found: {found}"
        if remedy is not None:
            text += f"\n   -> {remedy}"
        super().__init__(text)

    def __reduce__(self) -> tuple[object, ...]:  # keyword-only fields must survive the way back from a worker process
        return _rebuild, (type(self), self.what, self.where, self.found, self.remedy)


def _rebuild(cls: type[VilpDataError], what: str, where: object, found: object, remedy: str | None) -> VilpDataError:
    return cls(what, where=where, found=found, remedy=remedy)


class UsageError(VilpDataError):
    """The command or call was wrong: a path that does not exist, options that contradict each other."""

    exit_code = 2


class SpecError(UsageError):
    """A task TOML that cannot be used: unknown key, wrong type, contradictory values."""


class LogError(VilpDataError):
    """A log that cannot be read: not a log, empty, cut off, failing its CRC, missing a topic."""


class DecodeError(VilpDataError):
    """A message that cannot become a frame or a vector: unknown schema, wrong encoding, damaged image."""


class AlignError(VilpDataError):
    """Messages that cannot be put on one control clock."""


class StoreError(VilpDataError):
    """A stored file that is missing, damaged, of another format version, or cannot be written."""


class NoWindowError(StoreError):
    """Episodes that are all too short, or too much interrupted, for one window. Nothing is damaged."""


class BusyError(VilpDataError):
    """Another process is writing this dataset."""


class SplitError(VilpDataError):
    """A split that cannot be drawn, or that does not fit the episodes at hand."""


class ActionSetError(VilpDataError):
    """An action set that cannot be chosen, or that does not fit the dataset at hand."""


def salvage_command(log: Path) -> str:
    """The whole command that gets back what a damaged log still holds, in backticks: beside it, or where nobody may write there, in the
    folder at hand."""
    clean = Path(f"{Path(log.name.removesuffix('.active')).stem}-salvaged.mcap")
    if not log.parent.is_dir() or os.access(log.parent, os.W_OK):
        clean = log.with_name(clean.name)
    return f"`vilp-data salvage {shlex.quote(str(log))} -o {shlex.quote(str(clean))}`"


def mangled(what: str, log: Path, head: bytes) -> LogError:
    """Of a log whose line endings a transfer converted: `what` it is, and the first bytes that show it."""
    remedy = (
        f"copy it again in binary mode (git: mark *{log.suffix} as binary in .gitattributes); {salvage_command(log)} gets"
        " back what is there"
    )
    found = f"it begins with {head!r}"
    return LogError(f"{what} mangled in transfer, its line endings converted", where=log, found=found, remedy=remedy)


def copy_or_salvage(log: Path) -> str:
    """What to do about a damaged log; one that zstd packed is inflated first."""
    if log.suffix in (".zst", ".zstd"):
        whole = log.with_suffix("")
        unpack = f"`zstd -d {shlex.quote(str(log))} -o {shlex.quote(str(whole))}`"
        return f"copy it again from where it was recorded; {unpack} inflates what is there, and {salvage_command(whole)} takes that"
    return f"copy it again from where it was recorded; {salvage_command(log)} gets back what is there"


def reason(error: BaseException) -> str:
    """Another library's error in one line: its own words, `no 'length'` for a key that is not there, else its name."""
    if isinstance(error, KeyError):
        return f"no {error}"
    return str(error).partition("\n")[0].rstrip(":") or repr(error)


def copy_again(what: str, *, leave: str = "") -> str:
    """What to do about a file that no salvage reads; `leave`: what else can be left out, `this episode`."""
    return f"copy the {what} again from its source" + (f", or leave {leave} out" if leave else "")


MOST_KNOWN = 20
"""Names that a remedy lists at most: a few lines, and all topics of most logs."""


def nearest(name: str, known: Iterable[str]) -> str:
    """A remedy that names the nearest known name: `did you mean 'rate_hz'? known: ...`; of many only the first."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}known: {some_of(names, MOST_KNOWN) if names else '(none)'}"


def some_of(names: Sequence[str], most: int) -> str:
    """The first `most` of these names, and how many more there are: `a, b and 3 more`."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def number_of(count: int, what: str) -> str:
    """How many there are of what has a regular plural: `1 episode`, `24 files`."""
    return f"{count} {what}" + ("" if count == 1 else "s")
