"""Datasets whose files are damaged: every one is found, none stops the report on the others."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.stored_episodes import KEYS, VIEWS, episode, write_dataset
from tests.test_check_dataset import episode as robot_episode
from tests.test_check_dataset import write
from vilp_data.check.findings import Finding
from vilp_data.check.sources import check_sources
from vilp_data.dataset_split import lock_path
from vilp_data.episodes import EpisodeStore
from vilp_data.latents import latents_path
from vilp_data.surgery.operations import remove_episodes


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "data", *(episode(name, 20 + i) for i, name in enumerate("abcd")))
    return tmp_path / "data"


def found_in(*roots: Path, severity: str | None = None) -> list[Finding]:
    found = check_sources(list(roots)).findings
    return [finding for finding in found if severity is None or finding.severity == severity]


def flip(path: Path) -> None:
    """Flip one bit near the end: in the data, of a file of arrays."""
    data = bytearray(path.read_bytes())
    data[-10] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("view", VIEWS)
def test_a_flipped_bit_in_latents_is_an_error(root: Path, view: str) -> None:
    assert found_in(root, severity="error") == []
    flip(latents_path(root, view, KEYS[view], "b"))
    (found,) = found_in(root, severity="error")
    assert (found.kind, found.place.episode) == ("damaged", "b")
    assert str(found.evidence["file"]).endswith("b.safetensors")
    assert "vilp-data latents" in str(found.remedy)


def test_latents_of_other_frames_are_a_warning(root: Path) -> None:
    front = latents_path(root, "front", KEYS["front"], "a")
    front.write_bytes(latents_path(root, "front", KEYS["front"], "b").read_bytes())
    (found,) = (finding for finding in found_in(root) if finding.kind == "stale-latents")
    assert (found.severity, found.place.episode, found.place.topic) == ("warning", "a", "view front")


def test_statistics_that_cannot_be_read_are_an_error(root: Path) -> None:
    path = latents_path(root, "front", KEYS["front"], "a").with_name("stats-train.json")
    path.write_text('{"mean": [0.1')
    (found,) = found_in(root, severity="error")
    assert found.evidence["file"] == str(path)


def test_a_damaged_file_that_waits_for_an_undo_is_a_warning(root: Path) -> None:
    remove_episodes(root, ["c"])
    assert not [finding for finding in found_in(root) if finding.kind == "damaged-held"]
    (held, *_) = sorted((root / "history" / "held").rglob("*c.safetensors"))
    flip(held)
    (found,) = (finding for finding in found_in(root) if finding.kind == "damaged-held")
    assert found.severity == "warning"
    assert f"operation {int(held.relative_to(root).parts[2])} " in found.what


DAMAGE = {
    "cut off": b'{"assignment": {"a": "tr',
    "no JSON": b"\x00\xff\x00",
    "another JSON": b"[1, 2]",
    "empty": b"",
    "no format": b'{"assignment": 3}',
    "no table": b'{"format": 1, "assignment": [], "spec": 5}',
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", ["split.lock.json", "dataset.json"])
def test_damage_in_one_dataset_is_a_finding_and_costs_no_other_its_report(
    tmp_path: Path, root: Path, name: str, damage: str
) -> None:
    good = write(tmp_path / "good", *map(robot_episode, range(3)))
    (root / name).write_bytes(DAMAGE[damage])
    report = check_sources([good, root])
    assert [checked.source for checked in report.checked] == [str(good), str(root)]
    assert report.checked[0].findings == ()
    (found,) = (finding for finding in report.findings if finding.severity == "error")
    assert (found.place.source, found.kind) == (str(root), "damaged")
    assert name in str(found.evidence["file"])
    assert found.remedy


def test_a_split_changed_by_hand_is_a_warning(root: Path) -> None:
    path = lock_path(root)
    path.write_text(path.read_text().replace('"val"', '"train"'))
    assert any("changed by hand" in finding.what for finding in found_in(root) if finding.kind == "split")


def test_what_an_error_in_reading_costs_is_that_episode_alone(root: Path) -> None:
    flip(EpisodeStore(root).steps_path("a"))
    flip(EpisodeStore(root).frames_path("side", "d"))
    assert {finding.place.episode for finding in found_in(root, severity="error")} == {"a", "d"}
