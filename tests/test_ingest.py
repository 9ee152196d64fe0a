"""Logs into the store: what is taken, what is refused and in which words, what is never lost."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr

from tests import synthetic
from tests.faults import kill_after, kill_moments, run_until_files, run_until_killed, tree
from tests.sources.test_hdf5_log import write_hdf5
from tests.synthetic import task_spec, write_mcap, write_zarr, zarr_task_spec
from tests.synthetic_bags import write_rosbag1, write_rosbag2
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import BusyError, StoreError, UsageError
from vilp_data.ingest import IngestReport, ingest_logs
from vilp_data.sources.mcap_log import McapLog
from vilp_data.spec import TaskSpec, load_task
from vilp_data.staleness import stale_episodes
from vilp_data.types import Episode
from vilp_data.writer_lock import writer_lock


def ingest(logs: list[Path], root: Path, spec: TaskSpec, *, include_failures: bool = False) -> IngestReport:
    return ingest_logs(logs, root, spec, workers=1, include_failures=include_failures)


def test_copies_of_a_log_take_one_line_however_many_there_are(tmp_path: Path) -> None:
    write_zarr(tmp_path / "a.zarr")
    for name in "bcdef":
        shutil.copytree(tmp_path / "a.zarr", tmp_path / f"{name}.zarr")
    report = ingest([tmp_path], tmp_path / "data", zarr_task_spec())
    assert len(report.written) == 3
    (note,) = report.notes
    assert "and 2 more: 15 copies of what" in note


def only_episode(root: Path) -> Episode:
    store = EpisodeStore(root)
    (entry,) = store.index()
    return store.read(entry.id)


@pytest.mark.parametrize("codec", ["png", "raw"])
@pytest.mark.parametrize("encoding", ["cdr", "protobuf", "json"])
def test_every_encoding_gives_the_frames_and_vectors_that_were_recorded(
    tmp_path: Path, encoding: str, codec: str
) -> None:
    log = write_mcap(tmp_path / "run.mcap", encoding=encoding, image_codec=codec, cameras=("front", "side"))  # type: ignore[arg-type]
    ingest([log.path], tmp_path / "data", task_spec(log))
    episode = only_episode(tmp_path / "data")
    assert episode.n_steps == 20
    assert episode.valid.all()
    for camera, frames in log.frames.items():
        np.testing.assert_array_equal(episode.frames[camera][episode.source_index[camera]], frames)
    np.testing.assert_allclose(episode.low_dim[:, 0], np.arange(20) / 10, atol=1e-6)
    assert episode.action is not None
    np.testing.assert_allclose(episode.action, [synthetic.action_at(k / 10) for k in range(20)], atol=1e-6)


@pytest.mark.parametrize("compression", ["none", "lz4", "bz2"])
def test_a_ros1_bag_gives_the_episode_of_the_same_messages_in_mcap(tmp_path: Path, compression: str) -> None:
    log = write_mcap(tmp_path / "run.mcap", image_codec="png", n_frames=6, height=16, width=24)
    bag = write_rosbag1(tmp_path / "bag.bag", log, compression=compression)  # type: ignore[arg-type]
    ingest([log.path, bag], tmp_path / "data", task_spec(log))
    one, other = (EpisodeStore(tmp_path / "data").read(name) for name in ("run", "bag"))
    assert np.array_equal(one.frames["front"], other.frames["front"])
    assert np.array_equal(one.low_dim, other.low_dim)
    assert one.action is not None
    assert other.action is not None
    assert np.array_equal(one.action, other.action)
    assert np.array_equal(one.log_time_ns, other.log_time_ns)


def test_a_step_off_in_time_would_be_seen(tmp_path: Path) -> None:
    """The same log read with its clock shifted by one tick must not give the same frames and vectors."""
    log = write_mcap(tmp_path / "run.mcap", image_codec="png")
    spec = task_spec(log).model_dump(by_alias=True)
    spec["views"]["front"]["offset_s"] = 0.1
    ingest([log.path], tmp_path / "data", TaskSpec.model_validate(spec))
    shifted = only_episode(tmp_path / "data")
    true_low_dim = np.array([synthetic.joints_at(k / 10) for k in range(shifted.n_steps)], np.float32)
    assert np.abs(shifted.low_dim - true_low_dim).max() > 0.05


def test_jpeg_frames_keep_the_colour_card(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", image_codec="jpeg")
    ingest([log.path], tmp_path / "data", task_spec(log))
    stored, true = only_episode(tmp_path / "data").frames["front"], log.frames["front"]
    assert synthetic.psnr(stored, true) > 32
    for wrong in (stored[..., ::-1], stored[:, ::-1], stored[:, :, ::-1], np.roll(stored, 1, axis=0)):
        assert synthetic.psnr(wrong, true) < 32


def test_a_zarr_store_gives_one_episode_for_each_end(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "replay.zarr")
    report = ingest([log.path], tmp_path / "data", zarr_task_spec())
    assert report.written == ["replay-episode_000", "replay-episode_001", "replay-episode_002"]
    store, first = EpisodeStore(tmp_path / "data"), 0
    for entry, end in zip(store.index(), log.episode_ends, strict=True):
        episode = store.read(entry.id)
        np.testing.assert_array_equal(episode.frames["top"], log.img[first:end])
        np.testing.assert_array_equal(episode.low_dim, log.state[first:end, :2].astype(np.float32))
        np.testing.assert_array_equal(episode.action, log.action[first:end].astype(np.float32))
        first = int(end)


def test_an_episode_may_lack_actions(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", with_actions=False)
    spec = task_spec(log, action={"target": {"topic": synthetic.ACTION_TOPIC}})
    ingest([log.path], tmp_path / "data", spec)
    assert only_episode(tmp_path / "data").action is None


def test_actions_can_be_taken_from_the_state_some_steps_ahead(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", with_actions=False)
    ingest([log.path], tmp_path / "data", task_spec(log, action={"target": {"from": "joints", "shift": 2}}))
    episode = only_episode(tmp_path / "data")
    assert episode.action is not None
    np.testing.assert_array_equal(episode.action[:-2], episode.low_dim[2:])


def test_a_second_run_does_nothing_and_a_changed_spec_says_which_field(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    spec, root = task_spec(log), tmp_path / "data"
    ingest([log.path], root, spec)
    before = tree(root)
    report = ingest([log.path], root, spec)
    assert (report.written, report.fresh) == ([], ["run"])
    assert tree(root) == before
    smaller = spec.model_dump(by_alias=True)
    smaller["views"]["front"] |= {"height": 24, "width": 32}
    changed = TaskSpec.model_validate(smaller)
    assert "views.front.height: 48 -> 24" in stale_episodes(root, changed)["run"]
    assert ingest([log.path], root, changed).written == ["run"]
    assert only_episode(root).frames["front"].shape[1:] == (24, 32, 3)


def test_a_copy_of_a_log_under_another_name_is_known_by_its_content(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    (tmp_path / "copy.mcap").write_bytes(log.path.read_bytes())
    for root, logs in (("one", [log.path, tmp_path / "copy.mcap"]), ("other", [tmp_path / "copy.mcap", log.path])):
        report = ingest(logs, tmp_path / root, task_spec(log))
        assert report.written == ["copy"]
        assert "byte for byte" in report.notes[0]
    assert tree(tmp_path / "one") == tree(tmp_path / "other")


def test_two_logs_of_the_same_name_are_two_episodes(tmp_path: Path) -> None:
    for folder, seed in (("a", 1), ("b", 2)):
        (tmp_path / folder).mkdir()
        log = write_mcap(tmp_path / folder / "run.mcap", jitter_s=0.001, seed=seed)
    report = ingest([tmp_path / "a", tmp_path / "b"], tmp_path / "data", task_spec(log))
    assert len(report.written) == 2


def test_failures_are_left_out_unless_asked_for(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", tags={"success": "false", "seed": "7"})
    spec = task_spec(log)
    assert ingest([log.path], tmp_path / "data", spec).left_out == ["run"]
    assert ingest([log.path], tmp_path / "data", spec, include_failures=True).written == ["run"]
    episode = only_episode(tmp_path / "data")
    assert (episode.outcome, episode.tags["seed"]) == ("failure", "7")


# --- bad input -----------------------------------------------------------------------------------------------------------


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


# --- logs that change --------------------------------------------------------------------------------------------------------


def write_grown_zarr(path: Path, lengths: list[int], *, edit_row: int | None = None) -> None:
    shutil.rmtree(path, ignore_errors=True)
    write_zarr(path, episode_lengths=lengths)
    if edit_row is not None:
        zarr.open_group(path)["data/action"][edit_row] = 77.0


def stored_files(root: Path) -> dict[str, bytes]:
    return {name: data for name, data in tree(root).items() if name.endswith(".safetensors")}


def test_one_more_demonstration_in_a_store_adds_one_episode_and_touches_no_other(tmp_path: Path) -> None:
    log, root = tmp_path / "replay.zarr", tmp_path / "data"
    write_grown_zarr(log, [12, 9, 5])
    ingest([log], root, zarr_task_spec())
    before = stored_files(root)
    write_grown_zarr(log, [12, 9, 5, 8])
    report = ingest([log], root, zarr_task_spec())
    assert report.written == ["replay-episode_003"]
    assert report.fresh == [f"replay-episode_00{i}" for i in range(3)]
    assert (report.replaced, report.notes) == ([], [])
    assert stored_files(root).items() >= before.items()
    assert len(EpisodeStore(root).index()) == 4


def test_a_changed_demonstration_replaces_its_episode_and_is_named(tmp_path: Path) -> None:
    log, root = tmp_path / "replay.zarr", tmp_path / "data"
    write_grown_zarr(log, [12, 9, 5])
    ingest([log], root, zarr_task_spec())
    write_grown_zarr(log, [12, 9, 5], edit_row=15)
    report = ingest([log], root, zarr_task_spec())
    assert report.written == report.replaced == ["replay-episode_001"]
    action = EpisodeStore(root).read("replay-episode_001").action
    assert action is not None
    assert action[3].tolist() == [77.0, 77.0]
    write_grown_zarr(tmp_path / "whole" / "replay.zarr", [12, 9, 5], edit_row=15)
    ingest([tmp_path / "whole" / "replay.zarr"], tmp_path / "fresh", zarr_task_spec())
    assert tree(root) == tree(tmp_path / "fresh")


def test_a_store_of_which_most_changed_is_kept_beside_the_first_wherever_an_ingest_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "replay.zarr"
    for root in ("whole", "killed"):
        write_grown_zarr(log, [6, 5, 5, 5])
        ingest([log], tmp_path / root, zarr_task_spec())
        write_grown_zarr(log, [6, 4, 5, 5])  # rows move: of four demonstrations one is unchanged
        if root == "killed":
            with monkeypatch.context() as patch:
                kill_after(2, patch)
                with pytest.raises(KeyboardInterrupt):
                    ingest([log], tmp_path / root, zarr_task_spec())
        assert ingest([log], tmp_path / root, zarr_task_spec()).replaced == []
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")


def test_an_attribute_that_was_corrected_reaches_its_episode_without_decoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, root = write_hdf5(tmp_path / "demos.hdf5"), tmp_path / "data"
    table = zarr_task_spec().model_dump(by_alias=True) | {"state": None}
    table["views"]["top"]["topic"], table["low_dim"]["agent"]["topic"] = "obs/top_image", "obs/eef"
    table["action"]["target"]["topic"] = "actions"
    spec = TaskSpec.model_validate(table)
    written = ingest([log], root, spec).written
    with h5py.File(log, "r+") as file:
        file["data/demo_1"].attrs["success"] = "false"
    monkeypatch.setattr("vilp_data.ingest.assemble_episode", lambda *_, **__: pytest.fail("decoded again"))
    report = ingest([log], root, spec)
    assert (report.fresh, report.restated) == (written, [written[1]])
    assert EpisodeStore(root).entry(written[1]).outcome == "failure"


def test_another_store_of_the_same_name_overwrites_nothing(tmp_path: Path) -> None:
    write_grown_zarr(tmp_path / "monday" / "replay.zarr", [12, 9, 5])
    write_grown_zarr(tmp_path / "tuesday" / "replay.zarr", [7, 8])
    root = tmp_path / "data"
    ingest([tmp_path / "monday"], root, zarr_task_spec())
    before = stored_files(root)
    report = ingest([tmp_path / "tuesday"], root, zarr_task_spec())
    assert len(report.written) == 2
    assert not report.replaced
    assert "both are kept" in report.notes[0]
    assert stored_files(root).items() >= before.items()


def test_two_stores_of_one_name_given_together_keep_their_episodes(tmp_path: Path) -> None:
    write_grown_zarr(tmp_path / "a" / "replay.zarr", [12, 9, 5])
    write_grown_zarr(tmp_path / "b" / "replay.zarr", [12, 9, 5], edit_row=15)
    root = tmp_path / "data"
    assert len(ingest([tmp_path / "a", tmp_path / "b"], root, zarr_task_spec()).written) == 4
    again = ingest([tmp_path / "b", tmp_path / "a"], root, zarr_task_spec())
    assert (again.written, len(again.fresh)) == ([], 4)


def test_a_later_log_of_the_same_name_is_kept_beside_the_first_and_said(tmp_path: Path) -> None:
    for day, seed in (("monday", 1), ("tuesday", 2)):
        (tmp_path / day).mkdir()
        log = write_mcap(tmp_path / day / "run.mcap", jitter_s=0.001, seed=seed)
    root = tmp_path / "data"
    ingest([tmp_path / "monday"], root, task_spec(log))
    before = stored_files(root)
    report = ingest([tmp_path / "tuesday"], root, task_spec(log))
    (new,) = report.written
    assert new.startswith("run-")
    assert new in report.notes[0]
    assert stored_files(root).items() >= before.items()
    assert ingest([tmp_path], root, task_spec(log)).fresh == ["run", new]


def test_a_log_that_looks_untouched_is_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    os.utime(log.path, (1e9, 1e9))
    ingest([log.path], tmp_path / "data", task_spec(log))
    monkeypatch.setattr(McapLog, "sha256", lambda self: pytest.fail("read again"))
    assert ingest([log.path], tmp_path / "data", task_spec(log)).fresh == ["run"]
    monkeypatch.undo()
    changed = write_mcap(log.path, jitter_s=0.001, seed=3)
    os.utime(log.path, (1e9, 1e9))
    assert ingest([log.path], tmp_path / "data", task_spec(changed)).written != []


# --- which files are logs ------------------------------------------------------------------------------------------------------


def test_hidden_files_in_folders_are_nobody_s_logs(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "logs.mcap")
    folder = tmp_path / "logs"
    (folder / ".Trash").mkdir(parents=True)
    log.path.rename(folder / "run.mcap")
    for hidden in ("._run.mcap", ".DS_Store", ".Trash/old.mcap"):
        (folder / hidden).write_bytes(b"of no interest")
    report = ingest([folder], tmp_path / "data", task_spec(log))
    assert (report.written, report.failed) == (["run"], [])


def test_an_episode_never_hides_behind_a_dot(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / ".run.mcap")
    assert ingest([log.path], tmp_path / "data", task_spec(log)).written == ["run"]
    assert only_episode(tmp_path / "data").id == "run"


def test_logs_that_are_passed_over_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    log = write_mcap(folder / "run.mcap")
    for name in ("old.bag.active", "take.mcap.active", "notes.txt"):
        (folder / name).write_bytes(b"x")
    report = ingest([folder], tmp_path / "data", task_spec(log))
    assert [Path(path).name for path in report.passed_over] == ["old.bag.active", "take.mcap.active"]
    (folder / "run.mcap").unlink()
    with pytest.raises(UsageError, match="old.bag.active"):
        ingest([folder], tmp_path / "data", task_spec(log))


def test_a_split_bag_is_one_episode_and_its_folder_hides_no_other_log(tmp_path: Path) -> None:
    (tmp_path / "logs" / "bag").mkdir(parents=True)
    log = write_mcap(tmp_path / "logs" / "bag" / "stray.mcap", height=16, width=24)
    write_rosbag2(tmp_path / "split", log, parts=3)
    for file in (tmp_path / "split").iterdir():
        file.rename(tmp_path / "logs" / "bag" / file.name)
    report = ingest([tmp_path / "logs"], tmp_path / "data", task_spec(log))
    assert (report.written, report.failed) == (["bag", "stray"], [])
    store = EpisodeStore(tmp_path / "data")
    bag, stray = (store.read(name) for name in report.written)
    assert np.array_equal(bag.frames["front"], stray.frames["front"])
    assert np.array_equal(bag.low_dim, stray.low_dim)


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_zarr_stores_of_both_formats_are_found_in_folders(tmp_path: Path, zarr_format: int) -> None:
    source = zarr.open_group(write_zarr(tmp_path / "source.zarr").path, mode="r")
    store = zarr.create_group(tmp_path / "logs" / "deep" / "replay.zarr", zarr_format=zarr_format)
    for group in ("data", "meta"):
        made = store.create_group(group)
        for name, array in source[group].arrays():
            chunks = (7, *array.shape[1:]) if group == "data" else array.shape
            made.create_array(name, data=array[:], chunks=chunks, config={"write_empty_chunks": True})
    assert len(ingest([tmp_path / "logs"], tmp_path / "data", zarr_task_spec()).written) == 3


# --- the store -----------------------------------------------------------------------------------------------------------


def test_a_lost_or_damaged_index_is_rebuilt_from_the_headers(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "replay.zarr")
    ingest([log.path], tmp_path / "data", zarr_task_spec())
    store = EpisodeStore(tmp_path / "data")
    entries = store.index()
    store.index_path.write_bytes(b"PAR1 damaged PAR1")
    assert store.index() == entries
    store.index_path.unlink()
    assert store.index() == entries
    store.steps_path(entries[0].id).unlink()
    assert store.index() == entries[1:]


def test_frames_of_another_ingest_are_noticed(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "replay.zarr")
    ingest([log.path], tmp_path / "data", zarr_task_spec())
    store = EpisodeStore(tmp_path / "data")
    one, two = store.index()[:2]
    store.frames_path("top", one.id).write_bytes(store.frames_path("top", two.id).read_bytes())
    with pytest.raises(StoreError, match="not the frames"):
        store.read(one.id)


@pytest.mark.parametrize("damage", ["deleted", "cut", "of another episode"])
def test_frames_that_do_not_fit_are_made_again(tmp_path: Path, damage: str) -> None:
    log, root = write_zarr(tmp_path / "replay.zarr"), tmp_path / "data"
    ingest([log.path], root, zarr_task_spec())
    before, store = tree(root), EpisodeStore(root)
    one, two = store.index()[:2]
    path = store.frames_path("top", one.id)
    whole, other = path.read_bytes(), store.frames_path("top", two.id).read_bytes()
    path.unlink() if damage == "deleted" else path.write_bytes(whole[:-5] if damage == "cut" else other)
    assert ingest([log.path], root, zarr_task_spec()).written == [one.id]
    assert tree(root) == before


def test_a_dataset_of_another_format_version_is_refused(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "replay.zarr")
    ingest([log.path], tmp_path / "data", zarr_task_spec())
    path = tmp_path / "data" / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 99}))
    with pytest.raises(StoreError, match="another version"):
        EpisodeStore(tmp_path / "data").spec()


def test_what_a_killed_ingest_left_half_written_goes_with_the_next(tmp_path: Path) -> None:
    log, root = write_mcap(tmp_path / "run.mcap"), tmp_path / "data"
    half = root / "episodes" / "frames" / "front" / ".run.safetensors.1.tmp"
    half.parent.mkdir(parents=True)
    half.write_bytes(b"half")
    ingest([log.path], root, task_spec(log))
    assert not half.exists()


# --- killed at any moment ------------------------------------------------------------------------------------------------

INGEST = """
import sys
from pathlib import Path
from tests.synthetic import zarr_task_spec
from vilp_data.ingest import ingest_logs
ingest_logs([Path(sys.argv[1])], Path(sys.argv[2]), zarr_task_spec(), workers=1)
"""


@pytest.mark.parametrize("nth", kill_moments(few=4, many=44))
def test_ingest_killed_at_any_moment_and_run_again_gives_the_same_bytes(tmp_path: Path, nth: int) -> None:
    log = write_zarr(tmp_path / "replay.zarr", episode_lengths=(12, 9, 5, 14))
    killed = run_until_killed(INGEST, [str(log.path), str(tmp_path / "killed")], nth=nth)
    assert killed or nth > 30
    ingest([log.path], tmp_path / "killed", zarr_task_spec())
    ingest([log.path], tmp_path / "whole", zarr_task_spec())
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")


TWO_WORKERS = """
import sys
from pathlib import Path
from vilp_data.ingest import ingest_logs
from vilp_data.spec import load_task
ingest_logs([Path(sys.argv[1])], Path(sys.argv[2]), load_task(sys.argv[3]), workers=2)
"""


@pytest.mark.parametrize(
    "count", [1, 5, pytest.param(3, marks=pytest.mark.slow), pytest.param(9, marks=pytest.mark.slow)]
)
def test_two_workers_killed_and_run_again_give_the_bytes_of_one(tmp_path: Path, count: int) -> None:
    logs, task = tmp_path / "logs", tmp_path / "task.toml"
    logs.mkdir()
    for i in range(6):
        log = write_mcap(logs / f"run{i}.mcap", jitter_s=0.001, seed=i)
    task.write_text(
        'name = "synthetic"\nrate_hz = 10.0\n[low_dim.joints]\ntopic = "/joint_states"\nfields = ["position"]\n'
        '[views.front]\ntopic = "/camera/front/image"\nheight = 48\nwidth = 64\n'
    )
    killed = tmp_path / "killed"
    assert run_until_files(TWO_WORKERS, [str(logs), str(killed), str(task)], folder=killed, count=count)
    with writer_lock(killed):  # whoever could still write is gone
        after = tree(killed)
    spec = load_task(str(task))
    report = ingest_logs([logs], killed, spec, workers=2)
    assert len(report.written) + len(report.fresh) == 6
    assert report.written
    assert not {name for name in after if "/steps/" in name and tree(killed)[name] != after[name]}
    ingest([log.path.parent], tmp_path / "whole", spec)
    assert tree(killed) == tree(tmp_path / "whole")
