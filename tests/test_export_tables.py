"""robomimic and diffusion-policy exports, read by hand as their formats say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numcodecs
import numpy as np

from tests.export_datasets import demonstration, plain_dataset, shown, write
from vilp_data.export import Choice, export_dataset


def test_a_robomimic_demonstration_holds_what_was_recorded(tmp_path: Path) -> None:
    one, unknown = (
        demonstration("pick", 14, state=4, tags={"operator": "ann"}),
        demonstration("place", 9, outcome="unknown"),
    )
    write(tmp_path / "data", one, unknown, val=("place",))
    report = export_dataset(tmp_path / "data", tmp_path / "out", "robomimic")
    with h5py.File(tmp_path / "out/demos.hdf5") as file:
        demo, attributes = file["data/demo_0"], dict(file["data/demo_0"].attrs)
        assert np.array_equal(demo["obs/front_image"][:], shown(one, "front"))
        assert np.array_equal(demo["obs/side_image"][:], shown(one, "side"))
        assert np.array_equal(demo["obs/arm"][:], one.low_dim[:, :3])
        assert np.array_equal(demo["obs/gripper"][:], one.low_dim[:, 3:])
        assert np.array_equal(demo["actions"][:], one.action)
        assert np.array_equal(demo["states"][:], one.state)
        assert demo["dones"][:].tolist() == [0] * 13 + [1]
        assert demo["rewards"][:].tolist() == [0] * 13 + [1]
        assert file["data/demo_1/rewards"][:].sum() == 0
        assert "states" not in file["data/demo_1"]
        assert (attributes["num_samples"], attributes["operator"], attributes["success"]) == (14, "ann", "true")
        assert attributes["vilp_source_sha256"] == "ab" * 32
        assert file["data"].attrs["total"] == 23
        assert json.loads(file["data"].attrs["env_args"])["env_kwargs"]["control_freq"] == 10.0
        assert json.loads(file["data"].attrs["vilp"])["action"]["target"]["unit"] == "m"
        assert file["mask/train"][:].tolist() == [b"demo_0"]
        assert file["mask/valid"][:].tolist() == [b"demo_1"]
    assert any(note.startswith("rewards say nothing of 1 demonstrations") for note in report.notes)


def test_actions_outside_what_robomimic_expects_are_said(tmp_path: Path) -> None:
    write(tmp_path / "data", demonstration("far", 40))
    report = export_dataset(tmp_path / "data", tmp_path / "out", "robomimic")
    assert any("robomimic expects them within -1 to 1" in note for note in report.notes)


def test_a_cut_episode_is_done_at_its_real_end_alone(tmp_path: Path) -> None:
    write(tmp_path / "data", demonstration("gap", 12, invalid=(5,)))
    export_dataset(tmp_path / "data", tmp_path / "out", "robomimic")
    with h5py.File(tmp_path / "out/demos.hdf5") as file:
        assert [file[f"data/demo_{n}/dones"][-1] for n in range(2)] == [0, 1]
        assert [file[f"data/demo_{n}/rewards"][-1] for n in range(2)] == [0, 1]
        assert [file[f"data/demo_{n}"].attrs["vilp_first_step"] for n in range(2)] == [0, 6]


def test_marked_steps_are_nan_in_every_number(tmp_path: Path) -> None:
    write(tmp_path / "data", demonstration("gap", 6, invalid=(2,)))
    export_dataset(tmp_path / "data", tmp_path / "out", "robomimic", choice=Choice(masked="mark"))
    with h5py.File(tmp_path / "out/demos.hdf5") as file:
        demo = file["data/demo_0"]
        assert demo["valid"][:].tolist() == [1, 1, 0, 1, 1, 1]
        assert np.isnan(demo["actions"][2]).all()
        assert np.isnan(demo["obs/arm"][2]).all()
        assert np.isfinite(np.delete(demo["actions"][:], 2, axis=0)).all()


def zarr_array(store: Path, name: str) -> Any:
    """A zarr v2 array from its files alone: .zarray and one compressed file a chunk of leading rows."""
    meta = json.loads((store / name / ".zarray").read_text())
    assert meta["zarr_format"] == 2
    assert meta["chunks"][1:] == meta["shape"][1:]
    codec = numcodecs.get_codec(meta["compressor"]) if meta["compressor"] else None
    parts = []
    for number in range(-(-meta["shape"][0] // meta["chunks"][0])):
        data = (store / name / ".".join([str(number), *["0"] * (len(meta["shape"]) - 1)])).read_bytes()
        data = codec.decode(data) if codec else data
        parts.append(np.frombuffer(data, meta["dtype"]).reshape(meta["chunks"]))
    return np.concatenate(parts)[: meta["shape"][0]]


def test_a_diffusion_policy_store_read_from_its_bytes(tmp_path: Path) -> None:
    episodes = plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "out", "diffusion-policy")
    store = tmp_path / "out" / "replay.zarr"
    assert zarr_array(store, "meta/episode_ends").tolist() == [14, 23, 34]
    assert np.array_equal(
        zarr_array(store, "data/img_front"), np.concatenate([shown(one, "front") for one in episodes])
    )
    assert np.array_equal(zarr_array(store, "data/state"), np.concatenate([one.low_dim for one in episodes]))
    assert np.array_equal(zarr_array(store, "data/action"), np.concatenate([one.action for one in episodes]))  # type: ignore[arg-type]
    told = json.loads((store / ".zattrs").read_text())["vilp"]
    assert [one["side"] for one in told["episodes"]] == ["train", "train", "val"]
    assert told["vectors"]["action"]["target"] == {
        "columns": [0, 2], "labels": ["x", "y"], "kind": "absolute", "unit": "m", "frame": "base",
    }  # fmt: skip


def test_one_view_is_called_img_and_chunks_end_anywhere(tmp_path: Path, monkeypatch: Any) -> None:
    from vilp_data.export import diffusion_policy

    monkeypatch.setattr(
        diffusion_policy, "CHUNK_BYTES", 5000
    )  # two images, and numbers of several episodes, to a chunk
    from dataclasses import replace

    from tests.export_datasets import SPEC

    one = demonstration("alone", 13)
    front = {"front": one.frames["front"]}
    only = replace(one, frames=front, source_index={"front": one.source_index["front"]})
    write(tmp_path / "data", only, spec={**SPEC, "views": {"front": SPEC["views"]["front"]}})
    export_dataset(tmp_path / "data", tmp_path / "out", "diffusion-policy")
    assert np.array_equal(zarr_array(tmp_path / "out/replay.zarr", "data/img"), shown(one, "front"))
