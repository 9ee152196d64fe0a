"""Logs that are the same, and demonstrations that say the same in other bytes, are named in one finding."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.faulty_logs import write_faulty
from tests.json_log import Said, image, joints, number, write_json_log
from vilp_data.check.findings import Finding
from vilp_data.check.sources import check_sources
from vilp_data.check.text import format_report


def of_copies(*paths: Path) -> list[Finding]:
    return [f for f in check_sources(paths).findings if f.kind in ("copies", "near-duplicate")]


def robot(*, at: float = 0.0, pose: float = 0.0) -> list[Said]:
    said = [joints(at + k / 10, ["hip"], [pose + k * k]) for k in range(20)]
    return [*said, *(image(at + k / 10, index=k) for k in range(20))]


def test_logs_that_are_the_same_byte_for_byte_are_one_finding(tmp_path: Path) -> None:
    first = write_faulty(tmp_path / "a.mcap", seed=1, duration_s=4)
    write_faulty(tmp_path / "b.mcap", seed=2, duration_s=4)
    for name in ("c.mcap", "d.mcap", "e.mcap"):
        shutil.copy(first, tmp_path / name)
    (found,) = of_copies(tmp_path)
    assert Path(str(found.place.source)).name == "a.mcap"
    assert (found.severity, found.evidence["n_copies"]) == ("warning", 4)
    assert "byte for byte" in found.what
    assert [name in found.what for name in ("a.mcap", "b.mcap", "c.mcap", "d.mcap", "e.mcap")] == [
        True,
        False,
        *[True] * 3,
    ]
    assert "keep one" in str(found.remedy)
    assert "byte for byte: a.mcap, c.mcap, d.mcap, e.mcap" in format_report(check_sources([tmp_path]))


def test_copies_of_a_log_without_cameras_or_numbers_are_seen_by_their_bytes(tmp_path: Path) -> None:
    said = [number(k / 10, f"word {k}", "/said") for k in range(10)]
    shutil.copy(write_json_log(tmp_path / "a.mcap", said), tmp_path / "b.mcap")
    (found,) = of_copies(tmp_path)
    assert "byte for byte" in found.what
    other = [number(k / 10, f"wort {k}", "/said") for k in range(10)]
    write_json_log(tmp_path / "b.mcap", other)
    assert of_copies(tmp_path) == []


@pytest.mark.parametrize("cameras", [True, False])
def test_a_recording_written_again_in_other_bytes_holds_the_same_episode(tmp_path: Path, *, cameras: bool) -> None:
    said = [one for one in robot() if cameras or one.topic == "/joint_states"]
    first = write_json_log(tmp_path / "a.mcap", said)
    write_json_log(tmp_path / "b.mcap", said, chunk_size=1000)
    assert first.read_bytes() != (tmp_path / "b.mcap").read_bytes()
    (found,) = of_copies(tmp_path)
    assert "hold the same episode, in other bytes" in found.what
    assert "a.mcap" in found.what
    assert "b.mcap" in found.what


@pytest.mark.parametrize("other", [{"at": 0.00004}, {"pose": 0.5}])
def test_another_time_or_another_number_is_another_episode(tmp_path: Path, other: dict[str, float]) -> None:
    write_json_log(tmp_path / "a.mcap", robot())
    late = [*robot(**other)[1:], robot()[0]]  # one message is where it was, so that the others are not
    write_json_log(tmp_path / "b.mcap", late)
    assert [f.kind for f in of_copies(tmp_path)] == ["near-duplicate"]


def test_episodes_that_two_tables_share_are_one_finding(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((4, 30, 3))
    for name, chosen in (("a.hdf5", [0, 1, 2]), ("b.hdf5", [3, 0, 1])):
        with h5py.File(tmp_path / name, "w") as file:
            for place, number in enumerate(chosen):
                file.create_dataset(f"data/demo_{place}/actions", data=rows[number])
    (found,) = of_copies(tmp_path)
    assert "hold the same 2 episodes" in found.what


def test_a_table_that_holds_an_episode_twice_says_which(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).standard_normal((30, 3))
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for place in range(2):
            file.create_dataset(f"data/demo_{place}/actions", data=rows)
    (found,) = of_copies(tmp_path)
    assert "demo_0, demo_1 say the same" in found.what
