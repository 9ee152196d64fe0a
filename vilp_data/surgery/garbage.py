"""What nothing refers to: found, measured, deleted. Never logs/ nor runs/, and never what the kept history still needs."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from vilp_data import history, journal, shards
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import StoreError, UsageError, VilpDataError, number_of
from vilp_data.locate import has_been_dataset
from vilp_data.staleness import run_encoder
from vilp_data.writer_lock import leftovers, writer_lock

KEEP = 20
"""Operations whose undo is kept, unless told otherwise."""

_BY_DEVICE = ("device", "compute")
"""Fields of an encoder's key in which latents of the same network differ, made on another machine."""


@dataclass(frozen=True)
class Garbage:
    """A file or folder that nothing refers to, and why. `size` in bytes; 0 for one that has another name (a hard link) elsewhere."""

    path: Path
    why: str
    size: int


@dataclass
class GarbageReport:
    """What was found, and deleted unless it was a dry run; `notes` on what was left alone since nobody could tell."""

    found: list[Garbage] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    deleted: bool = False

    @property
    def size(self) -> int:
        return sum(one.size for one in self.found)


def collect_garbage(root: Path, *, keep: int = KEEP, runs: Sequence[Path] = (), dry_run: bool = False) -> GarbageReport:
    """Delete what nothing refers to: files held for the undo of operations older than the last `keep`, latents whose encoder is in no
    run (of DATASET/runs or of `runs`), or whose episode is neither stored nor held, frames without an episode, temporary files.

    Where no run there can be read as an encoder, no latents are judged by their key. Raises UsageError for a `keep` below 0, and for one
    of `runs` that is no encoder's run."""
    if keep < 0:
        raise UsageError("a number of operations to keep is not negative", found=keep, remedy="0 keeps no undo at all")
    if not has_been_dataset(root):
        EpisodeStore(root).spec()  # says that it is none
    with writer_lock(root):
        store, report = EpisodeStore(root), GarbageReport()
        _refuse_unread_runs(root, runs)
        last = max(history.numbers(root), default=0)
        floor = max(last - keep, 0)  # operations up to here can no longer be taken back
        report.found += _held_too_long(root, floor)
        report.found += _lost_frames(root, store)
        report.found += _latents(root, store, floor, runs, report.notes)
        report.found += [_garbage(path, "a temporary file") for path in leftovers(root)]
        if not dry_run:
            _delete(root, report)
            _forget_states(root, floor)
            report.deleted = True
            if report.found:
                note = f"{number_of(len(report.found), 'file')} deleted, {size_text(report.size)}; undo back to {floor + 1}"
                history.begin(root).record("gc", note)
    return report


def size_text(size: int) -> str:
    """`3.2 MB`"""
    value = float(size)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} TB"


# --- finding -----------------------------------------------------------------------------------------------------------------


def _held_too_long(root: Path, floor: int) -> Iterator[Garbage]:
    for folder in sorted((root / "history" / "held").glob("[0-9]*/")):
        if folder.name.isdigit() and int(folder.name) <= floor:
            why = f"held for the undo of operation {int(folder.name)}"
            yield from (_garbage(path, why) for path in sorted(folder.rglob("*")) if path.is_file())


def _lost_frames(root: Path, store: EpisodeStore) -> Iterator[Garbage]:
    stored = {entry.id for entry in store.index()}
    for path in sorted((root / "episodes" / "frames").glob("*/[!.]*.safetensors")):
        if path.name.removesuffix(".safetensors") not in stored:
            yield _garbage(path, "frames without an episode")


def _latents(root: Path, store: EpisodeStore, floor: int, runs: Sequence[Path], notes: list[str]) -> Iterator[Garbage]:
    wanted = _frames_to_come_back(root, floor)
    for entry in store.index():
        for view, sha256 in entry.frames_sha256.items():
            wanted.setdefault((view, entry.id), set()).add(sha256)
    for folder in sorted((root / "latents").glob("[!.]*/")):
        encoders, unread = _key_fields(root, runs, folder.name)
        if unread or not encoders:
            notes.append(
                f"latents/{folder.name}: no run of its encoder can be read{unread}; none were judged by their encoder"
            )
        for key in sorted(folder.glob("[!.]*/")):
            known = not encoders or unread or _is_of(key, encoders)
            for path in sorted(key.glob("[!.]*")):
                if not known:
                    yield _garbage(path, "of an encoder that is in no run")
                elif path.suffix == ".safetensors":
                    frames = _source_frames(path)
                    if frames not in wanted.get((folder.name, path.name.removesuffix(".safetensors")), set()):
                        yield _garbage(path, "latents of frames that are gone")


def _frames_to_come_back(root: Path, floor: int) -> dict[tuple[str, str], set[str]]:
    """(view, episode) -> hashes of the frames files that an undo may bring back: their latents are kept."""
    found: dict[tuple[str, str], set[str]] = {}
    for folder in (root / "history" / "held").glob("[0-9]*/"):
        if folder.name.isdigit() and int(folder.name) > floor:
            for path in folder.glob("episodes/frames/*/[!.]*.safetensors"):
                with contextlib.suppress(StoreError):
                    sha256 = shards.read_header(path).metadata.get("frames_sha256", "")
                    found.setdefault((path.parent.name, path.name.removesuffix(".safetensors")), set()).add(sha256)
    return found


def _source_frames(path: Path) -> str:
    with contextlib.suppress(StoreError):
        return shards.read_header(path).metadata.get("source_frames_sha256", "")
    return "damaged"


def _refuse_unread_runs(root: Path, runs: Sequence[Path]) -> None:
    """UsageError for a run, named by its user, that holds no encoder for any view with latents."""
    views = sorted(path.name for path in (root / "latents").glob("[!.]*/"))
    for run in runs:
        found = [] if run.is_dir() else ["no such folder"]
        for view in views if run.is_dir() else ():
            try:
                if run_encoder(run, view) is not None:
                    break
            except VilpDataError as error:
                found.append(error.what)
        else:
            if found or views:
                remedy = "name the folder of a trained frame encoder, such as DATASET/runs/vqgan"
                raise UsageError(
                    "not the run of a frame encoder", where=run, found=found[0] if found else None, remedy=remedy
                )


def _key_fields(root: Path, runs: Sequence[Path], view: str) -> tuple[list[dict[str, str]], str]:
    """What the keys of the view's encoders are made of, one for each run; and which runs could not be read, in words."""
    found, unread = [], []
    for run in [*sorted(path for path in (root / "runs").glob("[!.]*") if path.is_dir()), *runs]:
        try:
            encoder = run_encoder(run, view)
        except VilpDataError:
            unread.append(run.name)
            continue
        if encoder is not None:
            found.append(_without_device(encoder.key_fields))
    return found, f" ({', '.join(unread)} could not be read)" if unread else ""


def _is_of(folder: Path, encoders: list[dict[str, str]]) -> bool:
    """Whether the latents in a folder are of one of these encoders, on whatever device. Folders of nothing readable are of none."""
    for path in sorted(folder.glob("[!.]*.safetensors")):
        with contextlib.suppress(StoreError, ValueError, KeyError, TypeError):
            return _without_device(json.loads(shards.read_header(path).metadata["encoder"])) in encoders
    return False


def _without_device(fields: dict[str, str]) -> dict[str, str]:
    return {name: value for name, value in fields.items() if name not in _BY_DEVICE}


def _garbage(path: Path, why: str) -> Garbage:
    stat = path.stat()
    return Garbage(path, why, stat.st_size if stat.st_nlink == 1 else 0)


# --- deleting ----------------------------------------------------------------------------------------------------------------


def _delete(root: Path, report: GarbageReport) -> None:
    folders = set()
    for one in report.found:
        one.path.unlink(missing_ok=True)
        folders.add(one.path.parent)
    for folder in sorted(folders, key=lambda path: -len(path.parts)):
        _remove_empty(folder, root)
    shutil.rmtree(journal.staged_folder(root), ignore_errors=True)


def _remove_empty(folder: Path, root: Path) -> None:
    while folder != root and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent


def _forget_states(root: Path, floor: int) -> None:
    """States that no undo needs any more make way; the log keeps its lines."""
    for number in history.numbers(root):
        if number < floor:
            entry = history.read_entry(root, number)
            if entry.state is not None:
                shards.write_atomic(history.entry_path(root, number), replace(entry, state=None).to_json())
