"""Logs into the store: every format and encoding gives what was recorded, and every log in a folder is found."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr

from tests import synthetic
from tests.faults import tree
from tests.synthetic import task_spec, write_mcap, write_zarr, zarr_task_spec
from tests.synthetic_bags import write_rosbag1, write_rosbag2
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.ingest import IngestReport, ingest_logs
from vilp_data.spec import TaskSpec
from vilp_data.staleness import stale_episodes
from vilp_data.types import Episode


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
