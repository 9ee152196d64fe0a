"""A zarr v2 store in the diffusion-policy layout: arrays under data/, one row a step, and meta/episode_ends."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import numpy.typing as npt
import zarr

from vilp_data.export.compare import came_out_wrong
from vilp_data.export.job import ExportJob, ViewWritten, Written
from vilp_data.export.segments import Rows

STORE = "replay.zarr"
CHUNK_BYTES = 4 << 20


def write(job: ExportJob, folder: Path) -> Written:
    """Write the store into an empty folder."""
    root = zarr.create_group(folder / STORE, zarr_format=2)
    root.attrs.update(_attributes(job))
    data = root.create_group("data")
    ends = np.cumsum([segment.n_rows for segment in job.chosen.segments])
    root.create_group("meta").create_array("episode_ends", data=ends.astype(np.int64))
    arrays: dict[str, _Rows] = {}
    for _, rows in job.read():
        for name, values in columns(job, rows).items():
            if name not in arrays:
                arrays[name] = _Rows(data, name, job.chosen.n_rows, values)
            arrays[name].append(values)
        for view in rows.frames:
            _append_images(arrays, data, job, view, rows)
    for array in arrays.values():
        array.flush()
    return _told(job, folder)


def image_name(job: ExportJob, view: str) -> str:
    """`img`, as the original has it, where there is one view."""
    return "img" if len(job.shapes.views) == 1 else f"img_{view}"


def columns(job: ExportJob, rows: Rows) -> dict[str, npt.NDArray[Any]]:
    """Every array but the images, [R,D] or [R]."""
    arrays: dict[str, npt.NDArray[Any]] = {"state": rows.low_dim} if job.shapes.low_dim else {}
    arrays |= {"action": rows.action} if rows.action is not None else {}
    arrays |= {"sim_state": rows.state} if job.shapes.state and rows.state is not None else {}
    arrays |= {"valid": rows.valid.astype(np.uint8)} if job.marked else {}
    return arrays | {"log_time_ns": rows.log_time_ns}


class _Rows:
    """One array, written a whole chunk at a time."""

    def __init__(self, data: Any, name: str, n_rows: int, like: npt.NDArray[Any]) -> None:
        row_bytes = max(like.dtype.itemsize * int(np.prod(like.shape[1:])), 1)
        self._chunk = max(min(CHUNK_BYTES // row_bytes, n_rows), 1)
        self._array = data.create_array(
            name, shape=(n_rows, *like.shape[1:]), dtype=like.dtype, chunks=(self._chunk, *like.shape[1:]),
            compressors=numcodecs.Blosc(cname="zstd", clevel=5, shuffle=numcodecs.Blosc.SHUFFLE),
            config={"write_empty_chunks": True},
        )  # fmt: skip
        self._waiting: list[npt.NDArray[Any]] = []
        self._n_waiting, self._n_written = 0, 0

    def append(self, values: npt.NDArray[Any]) -> None:
        self._waiting.append(values)
        self._n_waiting += len(values)
        if self._n_waiting >= self._chunk:
            self._write(self._n_waiting - self._n_waiting % self._chunk)

    def flush(self) -> None:
        if self._n_waiting:
            self._write(self._n_waiting)

    def _write(self, count: int) -> None:
        rows = np.concatenate(self._waiting)
        self._array[self._n_written : self._n_written + count] = rows[:count]
        self._waiting, self._n_waiting = [rows[count:]], len(rows) - count
        self._n_written += count


def _append_images(arrays: dict[str, _Rows], data: Any, job: ExportJob, view: str, rows: Rows) -> None:
    name, frames, shown = image_name(job, view), rows.frames[view], rows.shown[view]
    if name not in arrays:
        arrays[name] = _Rows(data, name, job.chosen.n_rows, frames[:0])
    step = max(CHUNK_BYTES // frames[0].nbytes, 1)
    for first in range(0, len(shown), step):
        arrays[name].append(frames[shown[first : first + step]])


def _attributes(job: ExportJob) -> dict[str, Any]:
    """What the layout has no place for, as attributes of the root: parts of the vectors, and each episode's origin."""

    def parts(columns: Any, tables: Any) -> dict[str, Any]:
        named = {
            part.name: {"columns": [part.span.start, part.span.stop], "labels": list(part.labels)} for part in columns
        }
        for name, table in tables.items():
            if name in named and hasattr(table, "unit"):
                named[name] |= {"kind": table.kind, "unit": table.unit, "frame": table.frame}
        return named

    vectors = {"state": parts(job.low_dim, job.spec.low_dim), "action": parts(job.action, job.spec.action)}
    episodes = [segment.provenance for segment in job.chosen.segments]
    table = {"task": job.spec.name, "rate_hz": job.rate_hz, "vectors": vectors, "episodes": episodes}
    return {"vilp": json.loads(json.dumps(table))}


def check(job: ExportJob, folder: Path, written: Written) -> list[str]:
    """What was compared, in words. Raises StoreError at the first difference."""
    root = zarr.open_group(folder / STORE, mode="r")
    data, ends, first = root["data"], root["meta/episode_ends"][:].tolist(), 0
    for (segment, rows), end in zip(job.read(), ends, strict=True):
        for name, values in columns(job, rows).items():
            if not np.array_equal(data[name][first:end], values, equal_nan=values.dtype.kind == "f"):
                raise came_out_wrong(f"{name} came out different", segment)
        for view, frames in rows.frames.items():
            shown = rows.shown[view]
            step = max(CHUNK_BYTES // frames[0].nbytes, 1)
            for row in range(0, len(shown), step):
                part = shown[row : row + step]
                if not np.array_equal(data[image_name(job, view)][first + row : first + row + len(part)], frames[part]):
                    raise came_out_wrong("a frame came out different", f"{segment}, view {view}, from row {row}")
        first = end
    n_frames = len(job.shapes.views) * job.chosen.n_rows
    pictures = [f"{n_frames} frames equal to the stored ones, bit for bit"] if n_frames else []
    return [f"{job.chosen.n_rows} rows equal to the stored steps", *pictures]


def _told(job: ExportJob, folder: Path) -> Written:
    written = Written()
    for view in job.shapes.views:
        name = image_name(job, view)
        size = sum(path.stat().st_size for path in (folder / STORE / "data" / name).iterdir())
        written.views[view] = ViewWritten(f"data/{name}", "uint8, Blosc zstd", job.chosen.n_rows, size)
    written.carried = {
        "low_dim": "data/state" if job.shapes.low_dim else "(none stored)",
        "action": "data/action" if job.shapes.action is not None else "(none stored)",
        "split": "attribute `vilp` of the root: the side of each episode, training episodes first"
        if job.chosen.lock
        else "(none drawn)",
        "control ticks": "data/log_time_ns",
        "end of an episode": "meta/episode_ends",
        "tags, outcome, source, SHA-256": "attribute `vilp` of the root, an entry an episode",
    }
    written.carried |= {"simulator state": "data/sim_state"} if job.shapes.state else {}
    written.carried |= {"masked steps": "data/valid; their numbers are NaN"} if job.marked else {}
    return written
