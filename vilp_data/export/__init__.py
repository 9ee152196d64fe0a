"""Hand a dataset on: to LeRobot v3, robomimic HDF5 or diffusion-policy zarr, each read back and compared before it takes its name."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, nearest, number_of
from vilp_data.export import diffusion_policy, lerobot, lerobot_check, robomimic
from vilp_data.export.folder import MANIFEST, out_folder, require_free
from vilp_data.export.job import ExportJob, Images, ViewWritten, Written
from vilp_data.export.segments import Choice, Segment, choose, common_rate_hz, common_shapes
from vilp_data.spec import TaskSpec
from vilp_data.vector_parts import names_that_differ

__all__ = ["FORMATS", "Choice", "ExportReport", "Format", "export_dataset"]

Format = Literal["lerobot", "robomimic", "diffusion-policy"]

MANIFEST_FORMAT = 1

Progress = Callable[[int, int], None]
"""Told (rows done, rows in all); every row is gone over twice, to write it and to compare it."""


class _Write(Protocol):
    def __call__(self, job: ExportJob, folder: Path) -> Written: ...


class _Check(Protocol):
    def __call__(self, job: ExportJob, folder: Path, written: Written) -> list[str]: ...


@dataclass(frozen=True)
class _Kind:
    """One format. `share` of the raw bytes is what it needs on disk at most, by how images are kept."""

    write: _Write
    check: _Check
    share: dict[str, float]


FORMATS: dict[str, _Kind] = {
    "lerobot": _Kind(lerobot.write, lerobot_check.check, {"h264": 0.25, "h264-420": 0.25, "lossless": 0.6, "png": 1.0}),
    "robomimic": _Kind(robomimic.write, robomimic.check, {"": 1.0}),
    "diffusion-policy": _Kind(diffusion_policy.write, diffusion_policy.check, {"": 1.0}),
}

SPARE_BYTES = 16 << 20


@dataclass
class ExportReport:
    """What was written, from what, and what was not.

    episodes     of the export; stored_episodes: of the dataset that they come from, fewer where some were cut at masked steps
    sides        "train", "val", "none" -> number of episodes
    left_out     reason -> ids of stored episodes of which nothing was written
    masked       stored episode -> masked steps; `masked_as` says what became of them
    cut_away     stored episode -> valid steps lost with them, in runs too short to be an episode
    carried      what -> where it lies; not_carried: what -> why
    verified     what was read back and compared, in words
    """

    format: str
    out: str
    episodes: int = 0
    stored_episodes: int = 0
    rows: int = 0
    sides: dict[str, int] = field(default_factory=dict)
    rate_hz: float = 0.0
    bytes: int = 0
    write_s: float = 0.0
    check_s: float = 0.0
    views: dict[str, ViewWritten] = field(default_factory=dict)
    left_out: dict[str, list[str]] = field(default_factory=dict)
    masked: dict[str, int] = field(default_factory=dict)
    masked_as: str = "cut"
    cut_away: dict[str, int] = field(default_factory=dict)
    carried: dict[str, str] = field(default_factory=dict)
    not_carried: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    verified: list[str] = field(default_factory=list)


def export_dataset(
    root: Path,
    out: Path,
    to: str,
    *,
    choice: Choice | None = None,
    images: Images | None = None,
    crf: int | None = None,
    licence: str | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> ExportReport:
    """Write the dataset at `root` as the folder `out`, compare it with the stored episodes, and only then give it its name.

    `images` and `crf` are LeRobot's: how frames are kept (default "h264"). The other two formats keep every pixel. Raises UsageError
    for options that do not fit or an `out` that is in the way, StoreError for damaged episodes, a full disk, or an export that did
    not come out as it should; nothing is left behind then."""
    kind = _kind(to, images, crf)
    require_free(out, force=force)  # before anything is read
    _require_outside(root, out)
    choice = choice or Choice()
    store = EpisodeStore(root)
    spec, chosen = store.spec(), choose(store, choice)
    rows_done = 0

    def step(count: int) -> None:
        nonlocal rows_done
        rows_done += count
        if progress is not None:
            progress(rows_done, 2 * chosen.n_rows)

    job = ExportJob(
        store, spec, chosen, common_shapes(store, chosen), common_rate_hz(chosen.segments), images or "h264", crf,
        marked=choice.masked == "mark" and bool(chosen.masked), step=step,
    )  # fmt: skip
    needed = int(kind.share.get(job.images if to == "lerobot" else "", 1.0) * job.raw_bytes) + SPARE_BYTES
    with out_folder(out, force=force, needed_bytes=needed) as folder:
        started = time.monotonic()
        written = kind.write(job, folder)
        between = time.monotonic()
        verified = kind.check(job, folder, written)
        report = _report(job, to, out, choice, written, verified)
        report.write_s, report.check_s = between - started, time.monotonic() - between
        _write_card(job, folder, to, report, licence)
        _write_manifest(job, folder, report, choice)
        report.bytes = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return report


def _kind(to: str, images: str | None, crf: int | None) -> _Kind:
    if to not in FORMATS:
        raise UsageError(f"no format called {to!r}", remedy=nearest(to, FORMATS))
    if to != "lerobot" and (images is not None or crf is not None):
        raise UsageError(f"--images and --crf are of lerobot's videos; {to} keeps every pixel", remedy="leave them out")
    if images is not None and images not in FORMATS["lerobot"].share:
        raise UsageError(f"no way to keep images called {images!r}", remedy=nearest(images, FORMATS["lerobot"].share))
    if crf is not None and (images in ("lossless", "png") or not 0 <= crf <= 51):
        raise UsageError(
            "--crf is for videos coded with loss, 0 (best) to 51", found=f"--crf {crf}, --images {images or 'h264'}"
        )
    return FORMATS[to]


def _require_outside(root: Path, out: Path) -> None:
    """An export inside the dataset's own store would be taken for a part of it."""
    inside = out.resolve()
    for name in ("episodes", "latents", "logs"):
        if (root / name).resolve() in (inside, *inside.parents):
            raise UsageError("inside the dataset's own files", where=out, remedy="name another folder with -o")


def _report(job: ExportJob, to: str, out: Path, choice: Choice, written: Written, verified: list[str]) -> ExportReport:
    chosen = job.chosen
    report = ExportReport(
        format=to, out=str(out), episodes=len(chosen.segments), stored_episodes=len({segment.entry.id for segment in chosen.segments}),
        rows=chosen.n_rows, rate_hz=job.rate_hz, views=written.views, left_out=chosen.left_out, masked=chosen.masked,
        masked_as=choice.masked, cut_away=chosen.cut_away, carried=written.carried, notes=written.notes, verified=verified,
    )  # fmt: skip
    counts = {"train": len(chosen.on("train")), "val": len(chosen.on("val")), "none": len(chosen.on(None))}
    report.sides = {side: count for side, count in counts.items() if count}
    report.not_carried = _not_carried(job, to) | written.not_carried
    report.notes += _notes(job)
    return report


def _not_carried(job: ExportJob, to: str) -> dict[str, str]:
    missing = {"age of each observation (age_s)": "no format has a place for it"}
    states = sum(segment.entry.has_state for segment in job.chosen.segments)
    if to != "robomimic" and states and not job.shapes.state:
        missing["simulator state"] = (
            f"{states} of {len(job.chosen.segments)} episodes have one, or of different lengths"
        )
    rates = sorted({segment.entry.rate_hz for segment in job.chosen.segments})
    if rates[-1] / rates[0] - 1 > 1e-6:
        missing["the rate of each episode"] = (
            f"{rates[0]:.5g} to {rates[-1]:.5g} Hz; rows are counted at {job.rate_hz:g} Hz, and log_time_ns has the true times"
        )
    n_rows, shown = job.chosen.n_rows, _n_stored_images(job)
    for view, count in shown.items():
        if count < n_rows:
            missing[f"which rows of view {view} share an image"] = (
                f"{count} stored images are written as {n_rows} frames"
            )
    if job.marked:
        missing["numbers stored at masked steps"] = "NaN instead: they may be nobody's measurement"
    return missing


def _n_stored_images(job: ExportJob) -> dict[str, int]:
    """How many different images the whole episodes hold, view by view; cut ones are not counted."""
    if any(not segment.is_whole for segment in job.chosen.segments):
        return {}
    return {view: sum(segment.entry.n_frames[view] for segment in job.chosen.segments) for view in job.shapes.views}


def _notes(job: ExportJob) -> list[str]:
    notes = []
    if job.chosen.lock is None:
        notes.append("no split was drawn: every episode counts as training")
    elif without := len(job.chosen.on(None)):
        notes.append(f"episodes on neither side of the split: {without}")
    notes += names_that_differ(segment.entry.column_names for segment in job.chosen.segments)
    if job.chosen.unlabelled:
        notes.append(f"episodes without actions, theirs are NaN: {len(job.chosen.unlabelled)}")
    if job.shapes.action is None:
        alone = " and ".join(["video"] * bool(job.shapes.views) + ["low_dim"] * bool(job.shapes.low_dim))
        notes.append(f"no episode has actions: {alone} alone")
    for name, columns, parts in (("low_dim", job.low_dim, job.spec.low_dim), ("action", job.action, job.spec.action)):
        if len(columns) == 1 and len(parts) > 1:
            notes.append(f"{name} in one piece: the task does not say how wide each of {', '.join(parts)} is")
    return notes


def _write_card(job: ExportJob, folder: Path, to: str, report: ExportReport, licence: str | None) -> None:
    from vilp_data.dataset_card import write_card

    ids = {segment.entry.id for segment in job.chosen.segments}
    write_card(job.store, folder / "README.md", licence=licence, only=ids, exported=_card_lines(to, report))


def _card_lines(to: str, report: ExportReport) -> list[str]:
    lines = [
        f"Exported to {to}: {number_of(report.episodes, 'episode')}, {number_of(report.rows, 'row')} at {report.rate_hz:g} Hz."
    ]
    for view, one in report.views.items():
        error = (
            "every pixel equal"
            if one.psnr_db is None
            else f"PSNR {one.psnr_db:.1f} dB, worst frame {one.psnr_min_db:.1f} dB"
        )
        lines.append(f"View `{view}` is `{one.where}`: {one.coding}; {error}.")
    lines += [f"{what}: {where}." for what, where in report.carried.items()]
    lines += [f"Not carried: {what} ({why})." for what, why in report.not_carried.items()]
    lines += [f"Left out, {reason}: {len(ids)}." for reason, ids in report.left_out.items()]
    if report.masked:
        lines.append(
            f"Masked steps: {sum(report.masked.values())} in {number_of(len(report.masked), 'episode')}, {_masked_words(report)}."
        )
    return lines + [f"{note}." for note in report.notes]


def _masked_words(report: ExportReport) -> str:
    words = {"cut": "where the episode is cut in two", "mark": "kept and marked", "refuse": "refused"}[report.masked_as]
    return words + (f"; {sum(report.cut_away.values())} valid steps between them left out" if report.cut_away else "")


def _write_manifest(job: ExportJob, folder: Path, report: ExportReport, choice: Choice) -> None:
    """export.json, written last: what is here and where it came from. No dates: the same dataset gives the same bytes."""
    told = {key: value for key, value in asdict(report).items() if key not in ("out", "write_s", "check_s", "bytes")}
    files = {str(path.relative_to(folder)): _sha256(path) for path in sorted(folder.rglob("*")) if path.is_file()}
    lock = job.chosen.lock
    table: dict[str, Any] = {
        "vilp_export": MANIFEST_FORMAT,
        "task": job.spec.name,
        **told,
        "options": {**asdict(choice), "images": job.images if report.format == "lerobot" else None, "crf": job.crf},
        "split": None if lock is None else {"hash": lock.hash, "seed": lock.seed, "ratio": lock.ratio},
        "spec": _spec_table(job.spec),
        "episode_list": [_episode_table(segment) for segment in job.chosen.segments],
        "sha256": files,
    }
    text = json.dumps(table, indent=1, ensure_ascii=False) + "\n"
    (folder / MANIFEST).write_text(text, encoding="utf-8")


def _spec_table(spec: TaskSpec) -> dict[str, Any]:
    return spec.model_dump(mode="json", by_alias=True)


def _episode_table(segment: Segment) -> dict[str, Any]:
    entry = segment.entry
    told = {"edits": dict(entry.edits), "findings": list(entry.findings), "content_sha256": entry.content_sha256}
    return segment.provenance | told


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
