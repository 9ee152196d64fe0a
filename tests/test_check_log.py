"""Whole logs checked: good ones are left alone, each fault is found in its topic and place, damage is a finding and never a crash."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.faulty_logs import CAMERA, write_faulty
from tests.lerobot_folders import write_v21
from tests.real_data import real_data
from tests.synthetic import ACTION_TOPIC, JOINT_TOPIC, Encoding, write_mcap, write_zarr
from vilp_data.check.findings import Finding, grouped
from vilp_data.check.log import check_log
from vilp_data.check.report import BINS
from vilp_data.check.sources import check_sources
from vilp_data.errors import UsageError
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task


def findings_of(path: Path, **options: Any) -> list[Finding]:
    return check_sources([path], **options).findings


def kinds(path: Path, **options: Any) -> list[str]:
    return sorted({finding.kind for finding in findings_of(path, **options)})


def test_a_good_log_has_nothing_to_complain_about(tmp_path: Path) -> None:
    report = check_sources([write_faulty(tmp_path / "good.mcap")])
    assert report.findings == []
    (fit,) = report.fits
    assert fit.fit.best == 0
    assert fit.fit.gain[0] > 0.9


@pytest.mark.parametrize("encoding", ["cdr", "protobuf", "json"])
def test_good_logs_of_every_encoding_are_left_alone(tmp_path: Path, encoding: Encoding) -> None:
    log = write_mcap(tmp_path / "run.mcap", encoding=encoding, n_frames=60, jitter_s=0.002)
    assert [f for f in findings_of(log.path) if f.severity != "note"] == []
    checked = check_log(log.path)
    joints = next(topic for topic in checked.topics if topic.name == JOINT_TOPIC)
    assert joints.timing is not None
    assert joints.timing.rate_hz == pytest.approx(50, rel=0.05)
    assert joints.timing.lag_s == pytest.approx(0.004, abs=1e-4)


CASES: list[tuple[dict[str, Any], str, str, tuple[float, float] | None]] = [
    ({"gap": (8.0, 10.0)}, "gap", JOINT_TOPIC, (8.0, 10.0)),
    ({"black": (12.0, 15.0)}, "black", CAMERA, (12.0, 14.5)),
    ({"frozen": (5.0, 9.0)}, "frozen", CAMERA, (5.0, 8.5)),
    ({"stuck": (6.0, 8.0)}, "stuck", JOINT_TOPIC, (6.0, 7.95)),
    ({"stuck_joint": (10.0, 15.0)}, "stuck-joint", JOINT_TOPIC, (10.0, 14.95)),
    ({"nan": (3.0, 4.0)}, "nan", JOINT_TOPIC, (3.0, 3.95)),
    ({"clock_back": (9.0, 30.0)}, "clock-jump", JOINT_TOPIC, (9.0, 9.0)),
    ({"clock_ahead": (9.0, 30.0)}, "clock-jump-ahead", JOINT_TOPIC, (9.0, 9.0)),
    ({"skew_s": 7.0}, "skew", JOINT_TOPIC, None),
    ({"drift_s": 0.15}, "drift", JOINT_TOPIC, None),
    ({"repeat_stamps": True}, "duplicate-stamps", JOINT_TOPIC, None),
    ({"zero_stamps": True}, "header-unset", JOINT_TOPIC, None),
    ({"drop_every": 10}, "missing-messages", CAMERA, None),
    ({"action_late": 1}, "action-late", ACTION_TOPIC, None),
    ({"action_late": -2}, "action-early", ACTION_TOPIC, None),
]


@pytest.mark.parametrize(("fault", "kind", "topic", "span"), CASES, ids=[case[1] for case in CASES])
def test_each_fault_is_found_in_its_place(
    tmp_path: Path, fault: dict[str, Any], kind: str, topic: str, span: tuple[float, float] | None
) -> None:
    found = findings_of(write_faulty(tmp_path / "bad.mcap", **fault))
    finding = next((f for f in found if f.kind == kind), None)
    assert finding is not None, [f.kind for f in found]
    assert finding.place.topic == topic
    if span is not None:
        assert finding.place.start_s == pytest.approx(span[0], abs=0.6 if topic == CAMERA else 0.11)
        assert (finding.place.end_s or finding.place.start_s) == pytest.approx(
            span[1], abs=0.6 if topic == CAMERA else 0.11
        )


def test_a_task_makes_a_late_action_an_error(tmp_path: Path) -> None:
    spec = TaskSpec.model_validate({
        "name": "t", "rate_hz": 20, "views": {"front": {"topic": CAMERA, "height": 48, "width": 64}},
        "low_dim": {"joints": {"topic": JOINT_TOPIC}}, "action": {"target": {"topic": ACTION_TOPIC}},
    })  # fmt: skip
    (found,) = findings_of(write_faulty(tmp_path / "late.mcap", action_late=1), spec=spec)
    assert (found.kind, found.severity) == ("action-late", "error")


def test_a_topic_of_the_task_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    assert "missing-topic" in kinds(write_faulty(tmp_path / "run.mcap"), spec=load_task("hanoi"))


def test_idle_ends_are_a_note_with_how_much_could_be_trimmed(tmp_path: Path) -> None:
    found = findings_of(write_faulty(tmp_path / "idle.mcap", idle=(3.0, 4.0)))
    idle = next(f for f in found if f.kind == "idle-ends")
    assert idle.severity == "note"
    assert float(idle.evidence["idle_start_s"]) == pytest.approx(3.0, abs=0.15)
    assert float(idle.evidence["idle_end_s"]) == pytest.approx(4.0, abs=0.15)


def test_logs_of_different_rates_are_not_fitted_together(tmp_path: Path) -> None:
    """A step late is 50 ms in one and 100 ms in the other: one fit of both would have a remedy that is right for neither."""
    fast = write_faulty(tmp_path / "fast.mcap", seed=1, action_late=1, duration_s=15)
    more = write_faulty(tmp_path / "more.mcap", seed=2, action_late=1, duration_s=15)
    slow = write_faulty(tmp_path / "slow.mcap", seed=3, action_late=1, duration_s=30, rate_hz=10)
    report = check_sources([fast, more, slow])
    assert [(fit.rate_hz, fit.fit.n_steps > 500) for fit in report.fits] == [
        (pytest.approx(20, rel=0.01), True), (pytest.approx(10, rel=0.01), False),
    ]  # fmt: skip
    offsets = {str(f.remedy).split(" on ")[0] for f in report.findings if f.kind == "action-late"}
    assert offsets == {"offset_s = -0.05", "offset_s = -0.1"}


@pytest.mark.parametrize("keep", [0, 3, 100, 0.5, 0.99])
def test_a_log_that_is_cut_off_is_an_error_with_salvage_as_its_remedy(tmp_path: Path, keep: float) -> None:
    whole = write_faulty(tmp_path / "whole.mcap", duration_s=5).read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: int(keep if keep in (0, 3, 100) else keep * len(whole))])
    (found,) = findings_of(path)
    assert (found.severity, found.kind) == ("error", "unreadable")
    if keep:
        assert "vilp-data salvage" in str(found.remedy)


def test_a_damaged_chunk_is_an_error_and_what_came_before_is_judged(tmp_path: Path) -> None:
    path = write_faulty(tmp_path / "run.mcap", black=(1.0, 3.0))
    data = bytearray(path.read_bytes())
    data[len(data) * 3 // 4] ^= 0xFF
    path.write_bytes(data)
    found = findings_of(path)
    assert found[0].kind == "damaged"
    assert "vilp-data salvage" in str(found[0].remedy)
    assert "black" in {f.kind for f in found}


def test_a_zarr_of_demonstrations_is_judged_by_demonstration(tmp_path: Path) -> None:
    store = write_zarr(tmp_path / "demos.zarr", episode_lengths=(60, 50, 40))
    report = check_sources([store.path])
    (checked,) = report.checked
    assert checked.n_episodes == 3
    assert [f for f in report.findings if f.severity == "error"] == []
    assert len(checked.thumbnails) == 3


def test_a_path_without_a_log_is_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        check_sources([tmp_path / "nothing.mcap"])
    with pytest.raises(UsageError):
        check_sources([tmp_path])


def test_what_is_kept_does_not_grow_with_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vilp_data.check.log.SEGMENT_NUMBERS", 2000)
    monkeypatch.setattr("vilp_data.check.log.LOOK_EVERY", 100)
    path = write_faulty(tmp_path / "long.mcap", duration_s=40, gap=(20.0, 22.0), nan=(30.0, 31.0))
    report = check_sources([path])
    assert sorted({f.kind for f in report.findings}) == ["gap", "nan"]
    joints = next(topic for topic in report.checked[0].topics if topic.name == JOINT_TOPIC)
    assert joints.timing is not None
    assert joints.timing.n_messages == 800 - 39
    assert joints.timeline is not None
    assert len(joints.timeline.longest_s) == BINS
    assert all(len(sheet.pictures) <= 24 for sheet in report.checked[0].sheets)


@pytest.mark.slow
def test_logs_of_people_and_robots_raise_no_false_alarm() -> None:
    report = check_sources([real_data("pusht/pusht_keypoint_x356_y356.zarr")])
    assert {f.kind for f in report.findings} <= {"idle-ends"}
    assert report.fits[0].fit.best == 0


def robot_folder(path: Path, *, missing: Sequence[int]) -> Path:
    """A LeRobot dataset of 30 short episodes, of which those are without video, and the last one without its table."""
    folder = write_v21(path, lengths=[5] * 30)
    for episode in missing:
        folder.video(episode).unlink()
    folder.table(29).unlink()
    return path


def test_pictures_are_of_the_episodes_that_are_whole_and_each_cause_is_told_by_itself(tmp_path: Path) -> None:
    path = robot_folder(tmp_path / "robot", missing=[k for k in range(29) if k not in (7, 20)])
    (checked,) = (report := check_sources([path])).checked
    (sheet,) = checked.sheets
    assert {label.split(",")[0] for label, _ in sheet.pictures} == {"episode_000007", "episode_000020"}
    assert {topic.name: topic.n_messages for topic in checked.topics if topic.timing}["action"] == 10
    titles = [group.first.what for group in grouped(report.findings) if group.first.kind == "damaged"]
    assert sorted(titles) == ["the episode's table is missing", "the video is missing"]


def test_with_a_task_only_the_topics_that_it_reads_are_judged(tmp_path: Path) -> None:
    log = write_faulty(tmp_path / "bad.mcap", black=(3.0, 6.0), gap=(8.0, 10.0))
    spec = TaskSpec.model_validate({"name": "t", "rate_hz": 20, "low_dim": {"joints": {"topic": JOINT_TOPIC}}})
    assert {finding.place.topic for finding in findings_of(log)} == {CAMERA, JOINT_TOPIC}
    assert {finding.place.topic for finding in findings_of(log, spec=spec)} == {JOINT_TOPIC}


def test_the_file_that_git_mangled_is_named() -> None:
    (found,) = findings_of(real_data("logs/keelson/connectors_klog_bin_2024-05-15.mcap"))
    assert "line endings" in found.what
    assert "binary" in str(found.remedy)
    assert "vilp-data salvage" in str(found.remedy)
