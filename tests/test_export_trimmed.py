"""Trimmed, relabelled and cut episodes through every export, against the arrays that they were made from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
import zarr

from tests.export_datasets import SPEC, demonstration, shown, write
from tests.test_export import ALL, ingested_again
from vilp_data.episodes import EpisodeStore
from vilp_data.export import export_dataset
from vilp_data.export.lerobot import EPISODES_PATH
from vilp_data.surgery.operations import plan_trim, relabel_episodes, trim_episodes
from vilp_data.types import Episode

FIRST, END = 3, 11
LOSSLESS: dict[str, Any] = {"lerobot": "lossless"}


@pytest.fixture
def whole(tmp_path: Path) -> Episode:
    """An episode of 19 steps, two of them masked, trimmed in tmp_path/data to the steps 3 to 10 of the ingest."""
    one = demonstration("pick", 19, invalid=(6, 15), state=3, tags={"operator": "ann"})
    write(tmp_path / "data", one, demonstration("place", 9, state=3))
    trim_episodes(tmp_path / "data", plan_trim(tmp_path / "data", ["pick"], steps=(FIRST, END)))
    relabel_episodes(tmp_path / "data", ["pick"], labels={"operator": "ben"})
    return one


@pytest.mark.parametrize("to", ALL)
def test_a_trimmed_episode_is_exported_as_it_was_trimmed(tmp_path: Path, whole: Episode, to: str) -> None:
    report = export_dataset(tmp_path / "data", tmp_path / "out", to, images=LOSSLESS.get(to))
    assert (report.episodes, report.rows, report.masked) == (3, 7 + 9, {"pick": 1})
    again = ingested_again(tmp_path / "out", to, tmp_path / "again")
    for rows, after in zip((slice(3, 6), slice(7, 11)), again, strict=False):
        assert whole.action is not None
        for view in SPEC["views"]:
            assert np.array_equal(shown(after, view), shown(whole, view)[rows])
        assert np.array_equal(after.low_dim, whole.low_dim[rows])
        assert np.array_equal(after.action, whole.action[rows])


def provenance(folder: Path, to: str) -> list[dict[str, Any]]:
    """What an export says of where its episodes come from, by the format's own means."""
    if to == "lerobot":
        rows = pq.read_table(folder / EPISODES_PATH).to_pylist()
        return [{name.removeprefix("vilp/"): value for name, value in row.items()} for row in rows]
    if to == "robomimic":
        with h5py.File(folder / "demos.hdf5") as file:
            demos = [dict(file[f"data/demo_{i}"].attrs) for i in range(len(file["data"]))]
        return [{name.removeprefix("vilp_"): value for name, value in demo.items()} for demo in demos]
    return list(zarr.open_group(folder / "replay.zarr", mode="r").attrs["vilp"]["episodes"])  # type: ignore[index,call-overload,arg-type]


@pytest.mark.parametrize("to", ALL)
def test_steps_are_counted_as_ingest_did(tmp_path: Path, whole: Episode, to: str) -> None:
    export_dataset(tmp_path / "data", tmp_path / "out", to)
    told = provenance(tmp_path / "out", to)
    listed = json.loads((tmp_path / "out" / "export.json").read_text())["episode_list"]
    for rows in (told, listed):
        steps = [(row["episode"], row["first_step"], row["end_step"]) for row in rows]
        assert steps == [("pick", 3, 6), ("pick", 7, 11), ("place", 0, 9)]
    tags = told[0]["tags"]
    assert (json.loads(tags) if isinstance(tags, str) else tags) == {"operator": "ben"}
    assert listed[0]["edits"]["trim"]["first_step"] == FIRST


@pytest.mark.parametrize("to", ALL)
def test_ticks_and_the_simulators_state_are_those_of_the_steps_left(tmp_path: Path, whole: Episode, to: str) -> None:
    export_dataset(tmp_path / "data", tmp_path / "out", to)
    assert whole.state is not None
    rows = [3, 4, 5, 7, 8, 9, 10]
    times, state = _ticks_and_state(tmp_path / "out", to)
    assert times[:7].tolist() == whole.log_time_ns[rows].tolist()
    assert np.array_equal(state[:7], whole.state[rows])
    assert EpisodeStore(tmp_path / "data").entry("pick").n_steps == END - FIRST


def _ticks_and_state(folder: Path, to: str) -> tuple[Any, Any]:
    if to == "lerobot":
        table = pq.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()
        return np.array(table["log_time_ns"]), np.array(table["sim_state"])
    if to == "robomimic":
        with h5py.File(folder / "demos.hdf5") as file:
            demos = [file[f"data/demo_{i}"] for i in range(2)]
            return tuple(np.concatenate([demo[name][:] for demo in demos]) for name in ("log_time_ns", "states"))  # type: ignore[return-value]
    data: Any = zarr.open_group(folder / "replay.zarr", mode="r")["data"]
    return data["log_time_ns"][:], data["sim_state"][:]
