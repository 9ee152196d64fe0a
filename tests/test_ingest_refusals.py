"""What ingest refuses, masks or names, and in which words; what must not be mixed in one dataset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests import synthetic
from tests.faults import tree
from tests.synthetic import task_spec, write_mcap, zarr_task_spec
from tests.test_ingest import ingest, only_episode
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import BusyError, StoreError, UsageError
from vilp_data.ingest import ingest_logs
from vilp_data.spec import TaskSpec
from vilp_data.writer_lock import writer_lock


def test_logs_that_cannot_be_read_are_named_and_keep_no_other_back(tmp_path: Path) -> None:
    good = write_mcap(tmp_path / "good.mcap")
    whole = good.path.read_bytes()
    bad = {
        "empty.mcap": b"",
        "text.mcap": b"not a log at all, but long enough to look",
        "cut.mcap": whole[: len(whole) * 2 // 3],
        "flipped.mcap": whole[:3000] + bytes([whole[3000] ^ 1]) + whole[3001:],
    }
    for name, content in bad.items():
        (tmp_path / name).write_bytes(content)
    report = ingest([tmp_path], tmp_path / "data", task_spec(good))
    assert report.written == ["good"]
    assert len(report.failed) == len(bad)
    for name in bad:
        assert any(name in message and "->" in message for _, message in report.failed), name
    assert [entry.id for entry in EpisodeStore(tmp_path / "data").index()] == ["good"]


def test_a_missing_topic_names_the_nearest(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    spec = task_spec(log, views={"front": {"topic": "/camera/frnt/image", "height": 48, "width": 64}})
    ((_, message),) = ingest([log.path], tmp_path / "data", spec).failed
    assert "did you mean '/camera/front/image'" in message


def test_another_aspect_ratio_is_refused_until_a_fit_is_stated(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    view = {"topic": "/camera/front/image", "height": 48, "width": 48}
    ((_, message),) = ingest([log.path], tmp_path / "data", task_spec(log, views={"front": view})).failed
    assert "fit = " in message
    assert ingest([log.path], tmp_path / "data", task_spec(log, views={"front": view | {"fit": "crop"}})).written


def test_an_episode_of_one_step_is_refused(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", n_frames=1)
    ((_, message),) = ingest([log.path], tmp_path / "data", task_spec(log)).failed
    assert "one step" in message


def test_commands_that_are_no_numbers_mask_their_steps_and_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(synthetic, "action_at", lambda t: [float("nan") if 0.45 < t < 0.75 else t, 0.0])
    log = write_mcap(tmp_path / "run.mcap")
    report = ingest([log.path], tmp_path / "data", task_spec(log))
    episode = only_episode(tmp_path / "data")
    assert np.flatnonzero(~episode.valid).tolist() == [5, 6, 7]
    assert episode.action is not None
    assert np.isfinite(episode.action).all()
    assert "action target: missing, stale or not finite at 3 of 20 steps, first at step 5" in report.findings["run"][0]


def test_a_sensor_that_stops_masks_what_it_can_no_longer_tell(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", joint_hz=1.0)
    spec = task_spec(log).model_dump(by_alias=True)
    spec["low_dim"]["joints"]["stale_after_s"] = 0.55
    ingest([log.path], tmp_path / "data", TaskSpec.model_validate(spec))
    assert (~only_episode(tmp_path / "data").valid).sum() == 8  # ages 0.6 to 0.9 s, twice


def test_planned_frames_closer_than_the_camera_are_refused(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", camera_hz=2.0)
    spec = task_spec(log, window={"frame_stride": 2}, rate_hz=10.0)
    ((_, message),) = ingest([log.path], tmp_path / "data", spec).failed
    assert "frame_stride" in message


def test_the_rate_is_the_slowest_camera_s_where_none_is_stated(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", camera_hz=20.0)
    ingest([log.path], tmp_path / "data", task_spec(log, rate_hz=None))
    assert only_episode(tmp_path / "data").rate_hz == pytest.approx(20.0)


def test_a_wrong_path_and_an_empty_folder_are_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        ingest([tmp_path / "nowhere"], tmp_path / "data", zarr_task_spec())
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="no logs in this folder"):
        ingest([tmp_path / "empty"], tmp_path / "data", zarr_task_spec())


def test_a_folder_without_write_permission_is_said(tmp_path: Path) -> None:
    """/sys refuses new folders to everybody, the superuser included."""
    log = write_mcap(tmp_path / "run.mcap")
    with pytest.raises(StoreError, match="permission"):
        ingest([log.path], Path("/sys/kernel/vilp-test"), task_spec(log))


def test_a_data_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    (tmp_path / "data").write_text("a file is in the way")
    with pytest.raises(StoreError, match="cannot be written"):
        ingest([log.path], tmp_path / "data", task_spec(log))


def test_ingest_while_another_process_writes_is_refused(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    with writer_lock(tmp_path / "data"), pytest.raises(BusyError):
        ingest([log.path], tmp_path / "data", task_spec(log))


# --- one dataset, one spec, one time scale -----------------------------------------------------------------------------------


def write_two_runs(folder: Path) -> tuple[Path, Path, TaskSpec]:
    one = write_mcap(folder / "a.mcap", jitter_s=0.001, seed=1)
    two = write_mcap(folder / "b.mcap", jitter_s=0.001, seed=2)
    return one.path, two.path, task_spec(one)


def with_elbow_first(spec: TaskSpec) -> TaskSpec:
    table = spec.model_dump(by_alias=True)
    table["low_dim"]["joints"]["names"] = ("elbow", "shoulder", "wrist")
    return TaskSpec.model_validate(table)


def test_episodes_of_another_spec_do_not_stay_beside_new_ones(tmp_path: Path) -> None:
    a, b, spec = write_two_runs(tmp_path)
    ingest([a], tmp_path / "data", spec)
    before = tree(tmp_path / "data")
    with pytest.raises(UsageError, match=r'low_dim\[0\].names\[0\]: "shoulder" -> "elbow"'):
        ingest([b], tmp_path / "data", with_elbow_first(spec))
    assert tree(tmp_path / "data") == before
    assert ingest([a, b], tmp_path / "data", with_elbow_first(spec)).written == ["a", "b"]


def test_a_dataset_belongs_to_one_task(tmp_path: Path) -> None:
    a, b, spec = write_two_runs(tmp_path)
    ingest([a], tmp_path / "data", spec)
    with pytest.raises(UsageError, match="another task"):
        ingest([b], tmp_path / "data", spec.model_copy(update={"name": "other"}))


def test_a_spec_that_fits_no_log_leaves_the_dataset_as_it_was(tmp_path: Path) -> None:
    a, _, spec = write_two_runs(tmp_path)
    table = spec.model_dump(by_alias=True)
    table["views"]["front"]["topic"] = "/nope"
    wrong = TaskSpec.model_validate(table)
    assert ingest([a], tmp_path / "new", wrong).failed
    assert tree(tmp_path / "new") == {}
    ingest([a], tmp_path / "data", spec)
    before = tree(tmp_path / "data")
    assert ingest([a], tmp_path / "data", wrong).failed
    assert tree(tmp_path / "data") == before


def test_a_dataset_without_its_spec_gets_it_from_the_next_run(tmp_path: Path) -> None:
    a, _, spec = write_two_runs(tmp_path)
    ingest([a], tmp_path / "data", spec)
    before = tree(tmp_path / "data")
    (tmp_path / "data" / "dataset.json").unlink()
    assert ingest([a], tmp_path / "data", spec).fresh == ["a"]
    assert tree(tmp_path / "data") == before


@pytest.mark.parametrize("workers", [1, 2])
def test_logs_of_another_rate_are_refused_where_none_is_stated(tmp_path: Path, workers: int) -> None:
    slow, fast = tmp_path / "m-slow.mcap", tmp_path / "a-fast.mcap"
    log = write_mcap(slow, camera_hz=10.0)
    ingest([slow], tmp_path / "data", task_spec(log, rate_hz=None))
    write_mcap(fast, camera_hz=20.0)
    close = write_mcap(tmp_path / "close.mcap", camera_hz=10.05)
    logs = [fast, close.path, slow]
    report = ingest_logs(logs, tmp_path / "data", task_spec(log, rate_hz=None), workers=workers)
    assert report.written == ["close"]
    ((name, message),) = report.failed
    assert name == "a-fast"
    assert "20 Hz" in message
    assert "state rate_hz" in message
    # In an empty dataset the first by id sets the rate, whatever the order of logs and workers.
    report = ingest_logs(logs[::-1], tmp_path / "empty", task_spec(log, rate_hz=None), workers=workers)
    assert report.written == ["a-fast"]
    assert [name for name, _ in report.failed] == ["close", "m-slow"]
