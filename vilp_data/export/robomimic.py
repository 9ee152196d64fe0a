"""A robomimic HDF5 file: data/demo_N with obs/…, actions, rewards, dones, and masks for the two sides of the split."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from vilp_data.export.compare import came_out_wrong
from vilp_data.export.folder import require_space
from vilp_data.export.job import Column, ExportJob, ViewWritten, Written
from vilp_data.export.segments import Rows, Segment

FILE = "demos.hdf5"
MASKS = {"train": "train", "val": "valid"}
GYM, NO_ENVIRONMENT = 2, -1
"""Kinds of environment in robomimic's numbers; the last is ours."""

SPARE_BYTES = 1 << 20
"""Kept free beside each demonstration: HDF5 does not survive a full disk, and takes the process with it."""

SUCCESS = {"success": "true", "failure": "false"}
_OURS = frozenset({"num_samples", "model_file", "success"})


def write(job: ExportJob, folder: Path) -> Written:
    """Write the file into an empty folder."""
    with h5py.File(folder / FILE, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = job.chosen.n_rows
        data.attrs["env_args"] = json.dumps(_env_args(job), indent=1)
        data.attrs["vilp"] = json.dumps(_vectors(job), indent=1)
        furthest = 0.0
        for number, (segment, rows) in enumerate(job.read()):
            if rows.action is not None:
                furthest = max(furthest, float(np.nan_to_num(np.abs(rows.action)).max(initial=0)))
            require_space(folder, job.segment_bytes(segment) + SPARE_BYTES)
            group = data.create_group(f"demo_{number}")
            _write_attributes(group, segment)
            for name, values in _arrays(job, segment, rows).items():
                group.create_dataset(name, data=values)
            for view in rows.frames:
                _write_images(group, view, rows)
            file.flush()
        if job.chosen.lock is not None:
            _write_masks(file, job)
    written = _told(job, folder)
    if furthest > 1:
        written.notes.append(
            f"actions are as recorded, up to {furthest:g}; robomimic expects them within -1 to 1: normalise them"
        )
    return written


def _env_args(job: ExportJob) -> dict[str, Any]:
    """What robomimic makes an environment of: the task's simulator where it has one."""
    sim = job.spec.sim
    kwargs = {**(sim.options if sim else {}), "control_freq": job.rate_hz}
    return {"env_name": sim.env if sim else job.spec.name, "type": GYM if sim else NO_ENVIRONMENT, "env_kwargs": kwargs}


def _vectors(job: ExportJob) -> dict[str, Any]:
    """Which columns of the actions are what, with units and frames."""
    parts: dict[str, dict[str, Any]] = {
        column.name: {"columns": [column.span.start, column.span.stop], "labels": list(column.labels)}
        for column in job.action
    }
    for name, part in job.spec.action.items():
        parts.get(name, {}).update(kind=part.kind, unit=part.unit, frame=part.frame)
    return {"task": job.spec.name, "rate_hz": job.rate_hz, "action": parts}


def _write_attributes(group: h5py.Group, segment: Segment) -> None:
    """The demonstration's length, its tags under their own names, and where it comes from."""
    entry = segment.entry
    for name, text in entry.tags.items():
        if name not in _OURS and not name.startswith("vilp_"):
            group.attrs[name] = text
    if entry.outcome in SUCCESS:
        group.attrs["success"] = SUCCESS[entry.outcome]
    group.attrs["num_samples"] = segment.n_rows
    for name, value in segment.flat_provenance.items():
        group.attrs[f"vilp_{name}"] = value


def part_name(job: ExportJob, column: Column) -> str:
    """Below obs/: the part's name, made unlike any view's."""
    name = column.name.replace("/", "_")
    return f"low_dim_{name}" if name in {f"{view}_image" for view in job.shapes.views} else name


def _arrays(job: ExportJob, segment: Segment, rows: Rows) -> dict[str, npt.NDArray[Any]]:
    """Everything of a demonstration but its images, by path."""
    count = len(rows)
    done, reward = np.zeros(count, np.int64), np.zeros(count, np.float32)
    done[-1] = segment.ends_episode
    reward[-1] = segment.ends_episode and segment.entry.outcome == "success"
    arrays: dict[str, npt.NDArray[Any]] = {
        f"obs/{part_name(job, part)}": rows.low_dim[:, part.span] for part in job.low_dim
    }
    arrays |= {"actions": rows.action} if rows.action is not None else {}
    arrays |= {"states": rows.state} if rows.state is not None else {}
    arrays |= {"valid": rows.valid.astype(np.uint8)} if job.marked else {}
    return arrays | {"rewards": reward, "dones": done, "log_time_ns": rows.log_time_ns}


def _write_images(group: h5py.Group, view: str, rows: Rows) -> None:
    """One chunk an image: whoever shuffles reads single ones. Written one by one, so that rows that share an image need no copy."""
    shape = rows.frames[view].shape[1:]
    images = group.create_dataset(
        f"obs/{view}_image", (len(rows), *shape), np.uint8, chunks=(1, *shape), compression="gzip", compression_opts=4
    )
    for row, image in enumerate(rows.images(view)):
        images[row] = image


def _write_masks(file: h5py.File, job: ExportJob) -> None:
    for side, mask in MASKS.items():
        names = [f"demo_{number}" for number, segment in enumerate(job.chosen.segments) if segment.side == side]
        if names:
            file.create_dataset(f"mask/{mask}", data=np.array(names, "S"))


def check(job: ExportJob, folder: Path, written: Written) -> list[str]:
    """What was compared, in words. Raises StoreError at the first difference."""
    with h5py.File(folder / FILE, "r") as file:
        if len(file["data"]) != len(job.chosen.segments):
            raise came_out_wrong("demonstrations are missing", folder / FILE)
        for number, (segment, rows) in enumerate(job.read()):
            group = file[f"data/demo_{number}"]
            for name, values in _arrays(job, segment, rows).items():
                if not np.array_equal(group[name][:], values, equal_nan=values.dtype.kind == "f"):
                    raise came_out_wrong(f"{name} came out different", segment)
            for view in rows.frames:
                _compare_images(group[f"obs/{view}_image"], segment, rows, view)
    n_frames = len(job.shapes.views) * job.chosen.n_rows
    pictures = [f"{n_frames} frames equal to the stored ones, bit for bit"] if n_frames else []
    return [f"{job.chosen.n_rows} rows equal to the stored steps", *pictures]


def _compare_images(found: h5py.Dataset, segment: Segment, rows: Rows, view: str) -> None:
    if len(found) != len(rows):
        raise came_out_wrong("frames and rows differ in number", f"{segment}, view {view}")
    for row, image in enumerate(rows.images(view)):
        if not np.array_equal(found[row], image):
            raise came_out_wrong("a frame came out different", f"{segment}, view {view}, row {row}")


def _told(job: ExportJob, folder: Path) -> Written:
    written, size = Written(), (folder / FILE).stat().st_size
    for view in job.shapes.views:
        written.views[view] = ViewWritten(f"obs/{view}_image", "uint8, gzip", job.chosen.n_rows, size)
    written.carried = {
        "low_dim": ", ".join(f"obs/{part_name(job, part)}" for part in job.low_dim) or "(none stored)",
        "action": "actions; parts, units and frames in the attribute `vilp` of data/",
        "split": "mask/train, mask/valid" if job.chosen.lock else "(none drawn)",
        "control ticks": "log_time_ns",
        "end of an episode": "dones, 1 at its last step; rewards, 1 there where the outcome is a success",
        "tags, outcome, source, SHA-256": "attributes of each demonstration: tags by name, the rest as vilp_…",
    }
    if any(segment.entry.has_state for segment in job.chosen.segments):
        written.carried["simulator state"] = "states"
    written.carried |= {"masked steps": "valid; their numbers are NaN"} if job.marked else {}
    unknown = sum(segment.entry.outcome == "unknown" for segment in job.chosen.segments)
    if unknown:
        written.notes.append(
            f"rewards say nothing of {unknown} demonstrations: whether they succeeded is not known, and all are 0"
        )
    written.not_carried["next_obs"] = "not written: row k + 1 of obs/; load with load_next_obs=False"
    return written
