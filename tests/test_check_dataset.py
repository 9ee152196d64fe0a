"""Datasets checked: good ones are left alone; damage, copies, columns that stop, masked steps and shifted actions are found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.faulty_logs import robot
from tests.stored_episodes import add_episodes
from vilp_data.check.findings import Finding
from vilp_data.check.sources import check_sources
from vilp_data.dataset_split import update_split
from vilp_data.episodes import EpisodeStore
from vilp_data.surgery.operations import plan_trim
from vilp_data.task_toml import task_from_dict
from vilp_data.types import Episode

SPEC = {
    "name": "test",
    "views": {"front": {"topic": "/front", "height": 16, "width": 16}},
    "low_dim": {"joints": {"topic": "/joints", "fields": ["position[0:3]"]}},
    "action": {"target": {"topic": "/target", "fields": ["position[0:2]"]}},
}


def episode(number: int, *, n: int = 120, late: int = 0, still: int | None = None) -> Episode:
    """A robot that follows its targets, before a camera with noise."""
    state, action = robot(n, number)
    rng = np.random.default_rng(number)
    frames = rng.integers(40, 200, (1, 2, 2, 3)).repeat(8, 1).repeat(8, 2) + rng.integers(0, 40, (n, 16, 16, 3))
    if still is not None:
        state[:, still] = 0.25
    return Episode(
        id=f"run{number}", frames={"front": frames.astype(np.uint8)}, source_index={"front": np.arange(n, dtype=np.int32)},
        log_time_ns=(np.arange(n) * 10**8).astype(np.int64), low_dim=state.astype(np.float32),
        action=np.roll(action, late, axis=0).astype(np.float32), state=None, valid=np.ones(n, np.bool_), age_s={}, rate_hz=10.0,
        tags={}, outcome="success",
    )  # fmt: skip


def write(root: Path, *episodes: Episode) -> Path:
    EpisodeStore(root).write_spec(task_from_dict(SPEC, where="test"))
    add_episodes(root, *episodes)
    if len(episodes) > 1:
        update_split(root, ratio=0.5, ratio_from="task", seed=0, group_by=None, strata=(), redraw=False)
    return root


def findings_of(root: Path) -> list[Finding]:
    return check_sources([root]).findings


def test_a_good_dataset_has_nothing_to_complain_about(tmp_path: Path) -> None:
    report = check_sources([write(tmp_path, *map(episode, range(6)))])
    assert report.findings == []
    assert report.fits[0].fit.best == 0
    assert report.checked[0].n_episodes == 6


def test_a_flipped_byte_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    root = write(tmp_path, *map(episode, range(3)))
    path = EpisodeStore(root).frames_path("front", "run1")
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    (found,) = (f for f in findings_of(root) if f.severity == "error")
    assert (found.kind, found.place.episode) == ("damaged", "run1")
    assert str(path) in str(found.evidence["file"])


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    root = write(tmp_path, *map(episode, range(3)))
    EpisodeStore(root).frames_path("front", "run2").unlink()
    assert [(f.kind, f.place.episode) for f in findings_of(root) if f.severity == "error"] == [("damaged", "run2")]


def test_actions_a_step_late_are_an_error(tmp_path: Path) -> None:
    found = findings_of(write(tmp_path, *(episode(number, late=1) for number in range(4))))
    assert [(f.kind, f.severity) for f in found] == [("action-late", "error")]


def test_one_episode_with_late_actions_is_named(tmp_path: Path) -> None:
    found = findings_of(write(tmp_path, *(episode(number, late=int(number == 3)) for number in range(8))))
    assert [(f.kind, f.place.episode) for f in found] == [("action-odd-episode", "run3")]


def test_a_column_that_stands_still_in_one_episode_only_is_a_stuck_joint(tmp_path: Path) -> None:
    found = findings_of(write(tmp_path, *(episode(number, still=2 if number == 4 else None) for number in range(12))))
    assert [(f.kind, f.place.episode) for f in found] == [("stuck-joint", "run4")]
    assert "joints.2" in found[0].what


def test_a_column_that_moves_in_no_episode_is_a_note(tmp_path: Path) -> None:
    found = findings_of(write(tmp_path, *(episode(number, still=2) for number in range(4))))
    assert [(f.kind, f.severity) for f in found] == [("never-moves", "note")]


def test_copies_and_near_copies_are_found(tmp_path: Path) -> None:
    one = episode(0)
    near = replace(one, id="near", low_dim=one.low_dim + np.float32(0.01))
    found = findings_of(write(tmp_path, one, replace(one, id="copy"), near, episode(1), episode(2), episode(3)))
    by_kind = {f.kind: f for f in found}
    assert by_kind["duplicate"].severity == "warning"
    assert "near-duplicate" in by_kind


def test_idle_ends_are_those_that_trim_takes_off(tmp_path: Path) -> None:
    still = episode(0, n=160)
    still.low_dim[:40], still.low_dim[120:] = still.low_dim[40], still.low_dim[119]
    assert still.action is not None
    still.action[:25], still.action[120:] = still.action[25], still.action[119]
    root = write(tmp_path, still, episode(1))
    (found,) = (f for f in findings_of(root) if f.kind == "idle-ends")
    (cut, _) = plan_trim(root, margin_s=0)
    assert cut.id == found.place.episode == "run0"
    assert 20 <= cut.first <= 26  # the commands begin before the robot does
    assert found.evidence["idle_start_s"] == pytest.approx(cut.first / 10)
    assert found.evidence["idle_end_s"] == pytest.approx((160 - cut.end) / 10)


def test_masked_steps_are_counted(tmp_path: Path) -> None:
    one = episode(0)
    one.valid[30:90] = False
    found = findings_of(write(tmp_path, one, episode(1)))
    masked = next(f for f in found if f.kind == "masked-steps")
    assert (masked.evidence["n_masked"], masked.place.start_s) == (60, 3.0)


def test_what_ingest_noted_is_told_again(tmp_path: Path) -> None:
    noted = replace(episode(0), findings=("view front: 3 damaged images passed over",))
    found = findings_of(write(tmp_path, noted, episode(1)))
    assert [(f.severity, f.what) for f in found] == [("warning", "view front: 3 damaged images passed over")]


def test_a_dataset_without_episodes_is_an_error(tmp_path: Path) -> None:
    EpisodeStore(tmp_path).write_spec(task_from_dict(SPEC, where="test"))
    assert "empty" in {f.kind for f in findings_of(tmp_path)}
