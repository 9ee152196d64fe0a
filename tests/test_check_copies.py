"""Logs that are the same byte for byte are named in one finding, and no others are said to be."""

from __future__ import annotations

import shutil
from collections.abc import Callable
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


def test_a_log_that_looks_nearly_like_one_with_copies_is_told_so_once(tmp_path: Path) -> None:
    write_json_log(tmp_path / "a.mcap", robot())
    for name in ("b.mcap", "c.mcap"):
        shutil.copy(tmp_path / "a.mcap", tmp_path / name)
    write_json_log(tmp_path / "d.mcap", robot(), chunk_size=1000)
    found = of_copies(tmp_path)
    assert [(f.kind, Path(str(f.place.source)).name) for f in found] == [
        ("copies", "a.mcap"),
        ("near-duplicate", "a.mcap"),
    ]
    assert "d.mcap" in found[1].what


def table(path: Path, **datasets: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        for name, rows in datasets.items():
            file.create_dataset(f"data/demo_0/{name}", data=rows)


def write_wide_rows(path: Path, rng: np.random.Generator) -> None:
    table(path, actions=rng.standard_normal((50, 70)), dones=np.arange(50) == 49)


def write_matrices(path: Path, rng: np.random.Generator) -> None:
    table(path, pose=rng.standard_normal((50, 4, 4)), rewards=np.zeros(50))


def write_pictures(path: Path, rng: np.random.Generator) -> None:
    """Alike but between the ones that a check looks at."""
    pictures = np.full((4, 48, 64, 3), 90, np.uint8)
    pictures[2] = rng.integers(0, 255, (48, 64, 3))
    table(path, agentview_image=pictures, rewards=np.zeros(4))


def write_scans(path: Path, rng: np.random.Generator) -> None:
    said = [Said(k / 10, "/scan", "custom/Scan", {"ranges": rng.standard_normal(200).tolist()}) for k in range(40)]
    write_json_log(path, [*said, *(number(k / 10, 12.0, "/battery") for k in range(40))])


def write_words(path: Path, rng: np.random.Generator) -> None:
    write_json_log(path, [*robot(), number(0.0, f"pick {rng.integers(1 << 30)}", "/task")])


@pytest.mark.parametrize(
    ("ending", "write"),
    [
        ("hdf5", write_wide_rows),
        ("hdf5", write_matrices),
        ("hdf5", write_pictures),
        ("mcap", write_scans),
        ("mcap", write_words),
    ],
)
def test_logs_of_which_only_what_a_check_keeps_is_the_same_are_not_said_to_be(
    tmp_path: Path, ending: str, write: Callable[[Path, np.random.Generator], None]
) -> None:
    """Each is of the other's size and length, and has a topic whose numbers are the same."""
    for seed, name in enumerate(("a", "b")):
        write(tmp_path / f"{name}.{ending}", np.random.default_rng(seed))
    assert "copies" not in [f.kind for f in of_copies(tmp_path)]
