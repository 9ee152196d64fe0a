"""Demonstrations in robomimic HDF5: rows become timed messages, each demonstration stands alone, damage is said in words."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.real_data import real_data
from tests.synthetic import card_frame
from vilp_data.decode import decode_image, decode_vector
from vilp_data.errors import LogError, UsageError
from vilp_data.log_summary import summarise
from vilp_data.sources import IndexedLog, open_log
from vilp_data.types import LogEpisode

LENGTHS = (12, 9, 5)
ENV_ARGS = {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": 20, "robots": ["Panda"]}}


def write_hdf5(
    path: Path, *, lengths: Sequence[int] = LENGTHS, env_args: Mapping[str, Any] | None = ENV_ARGS, compression: str | None = "gzip"
) -> Path:  # fmt: skip
    """demo_0, demo_1, …; row i of the whole file has actions [i, -i], obs/eef [i, i/10, 1] and the picture card_frame(i)."""
    with h5py.File(path, "w") as file:
        data, first = file.create_group("data"), 0
        if env_args is not None:
            data.attrs["env_args"] = json.dumps(env_args)
        for number, length in enumerate(lengths):
            rows = np.arange(first, first + length, dtype=np.float64)
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = length
            demo.attrs["model_file"] = "<mujoco>" + "x" * 5000 + "</mujoco>"
            pictures = (
                np.stack([card_frame(int(row), 32, 32) for row in rows])
                if length
                else np.empty((0, 32, 32, 3), np.uint8)
            )
            arrays = {
                "actions": np.stack([rows, -rows], 1), "rewards": rows * 0, "dones": rows == rows[-1:],
                "states": np.stack([rows] * 4, 1), "obs/eef": np.stack([rows, rows / 10, rows * 0 + 1], 1).astype(np.float32),
                "obs/top_image": pictures, "next_obs/top_image": pictures,
            }  # fmt: skip
            for name, array in arrays.items():
                demo.create_dataset(name, data=array, chunks=(min(4, length), *array.shape[1:]) if length else None,
                                    compression=compression if length else None)  # fmt: skip
            first += length
        file.create_group("mask")["train"] = [f"demo_{n}".encode() for n in range(len(lengths) - 1)]
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_hdf5(tmp_path / "demos.hdf5")


def actions(log: IndexedLog, episode: LogEpisode) -> list[int]:
    return [int(m.body[0]) for m in log.messages(["actions"], start_ns=episode.start_ns, end_ns=episode.end_ns)]


def hashes(path: Path) -> dict[str, str]:
    with open_log(path) as log:
        return {e.name: log.demonstration_sha256(e.name) for e in log.episodes()}  # type: ignore[attr-defined]


def test_arrays_are_topics_and_demonstrations_follow_each_other_at_the_stated_rate(path: Path) -> None:
    with open_log(path, array_rate_hz=7.0) as log:
        assert [(t.name, t.schema, t.message_count) for t in log.topics()] == [
            (name, "array", 26) for name in ("actions", "dones", "obs/eef", "obs/top_image", "rewards", "states")
        ]
        assert [(e.name, e.start_ns, e.end_ns) for e in log.episodes()] == [
            ("demo_0", 0, 600_000_000), ("demo_1", 600_000_000, 1_050_000_000), ("demo_2", 1_050_000_000, 1_300_000_000)
        ]  # fmt: skip
        assert [actions(log, e) for e in log.episodes()] == [list(range(12)), list(range(12, 21)), list(range(21, 26))]


def test_rows_decode_to_what_was_stored(path: Path) -> None:
    with open_log(path) as log:
        messages = list(log.messages(["obs/top_image", "obs/eef"]))
    assert [m.topic for m in messages[:3]] == ["obs/eef", "obs/top_image", "obs/eef"]
    pictures = np.stack([decode_image(m) for m in messages if m.topic == "obs/top_image"])
    assert np.array_equal(pictures, np.stack([card_frame(i, 32, 32) for i in range(26)]))
    vectors = [decode_vector(m, ["[0:2]"]).tolist() for m in messages if m.topic == "obs/eef"]
    assert vectors == [[i, float(np.float32(i / 10))] for i in range(26)]


def test_a_file_that_states_no_rate_takes_the_one_asked_for_and_says_so(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "demos.hdf5", env_args=None)
    with open_log(path, array_rate_hz=10.0) as log:
        assert log.episodes()[1].start_ns == 1_200_000_000
    told = summarise(path, array_rate_hz=10.0)
    assert (told.assumed_rate_hz, told.log_clock) == (10.0, "none")
    stated = summarise(write_hdf5(tmp_path / "stated.hdf5"), array_rate_hz=10.0)
    assert (stated.assumed_rate_hz, stated.log_clock, stated.topics[0].rate_hz) == (None, "relative", pytest.approx(20))


@pytest.mark.parametrize("rate", [0, -5, "fast", None, float("nan"), True, [20]])
def test_a_stated_rate_that_is_none_is_not_believed(tmp_path: Path, rate: object) -> None:
    path = write_hdf5(tmp_path / "demos.hdf5", env_args={"env_kwargs": {"control_freq": rate}})
    with open_log(path, array_rate_hz=10.0) as log:
        assert log.episodes()[1].start_ns == 1_200_000_000


def test_tags_are_the_task_the_masks_and_short_attributes(path: Path) -> None:
    with open_log(path) as log:
        assert [dict(e.tags) for e in log.episodes()] == [
            {"task": "Lift", "masks": "train", "num_samples": "12"},
            {"task": "Lift", "masks": "train", "num_samples": "9"},
            {"task": "Lift", "num_samples": "5"},
        ]


def test_demonstrations_are_in_order_of_their_numbers(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "demos.hdf5", lengths=[2] * 12)
    with open_log(path) as log:
        assert [e.name for e in log.episodes()] == [f"demo_{n}" for n in range(12)]


def test_a_file_that_grows_keeps_the_hashes_of_its_demonstrations(path: Path, tmp_path: Path) -> None:
    old = hashes(path)
    write_hdf5(path, lengths=(*LENGTHS, 7), compression=None)
    new = hashes(path)
    assert {name: new[name] for name in old} == old
    assert len(set(new.values())) == 4


@pytest.mark.parametrize("topic", ["actions", "obs/top_image", "states"])
def test_one_other_value_is_another_hash_of_its_demonstration_alone(path: Path, topic: str) -> None:
    old = hashes(path)
    with h5py.File(path, "r+") as file:
        array = file[f"data/demo_1/{topic}"]
        array[3] = array[3] + 1
    new = hashes(path)
    assert [name for name in old if old[name] != new[name]] == ["demo_1"]


def test_a_single_demonstration_at_the_root_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "episode_0.hdf5", "w") as file:
        file["action"] = np.arange(12.0).reshape(6, 2)
        file["observations/qpos"] = np.arange(6.0)[:, None]
        file["observations/images/top"] = np.stack([card_frame(i, 32, 32) for i in range(6)])
    with open_log(tmp_path / "episode_0.hdf5") as log:
        assert [t.name for t in log.topics()] == ["action", "observations/images/top", "observations/qpos"]
        (episode,) = log.episodes()
        assert [m.body.tolist() for m in log.messages(["action"])] == [[2.0 * i, 2 * i + 1.0] for i in range(6)]
    assert episode.end_ns == 600_000_000


# --- damage -------------------------------------------------------------------------------------------------------------------


def assert_only_demo_1_fails(path: Path, topic: str, says: str) -> None:
    with open_log(path) as log:
        first, second, third = log.episodes()
        for whole, count in ((first, 12), (third, 5)):
            assert len(list(log.messages([topic], start_ns=whole.start_ns, end_ns=whole.end_ns))) == count
        with pytest.raises(LogError, match=says) as caught:
            list(log.messages([topic], start_ns=second.start_ns, end_ns=second.end_ns))
    assert "demo_1" in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize("length", [8, 10])
def test_arrays_of_different_lengths_stop_their_demonstration_only(path: Path, length: int) -> None:
    with h5py.File(path, "r+") as file:
        del file["data/demo_1/obs/eef"]
        file["data/demo_1/obs/eef"] = np.zeros((length, 3))
    assert_only_demo_1_fails(path, "obs/eef", f"different lengths(.|\n)*{length} rows, actions says 9")


def test_an_array_that_one_demonstration_lacks(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["data/demo_1/obs/eef"]
    assert_only_demo_1_fails(path, "obs/eef", "it has no obs/eef")


def test_chunks_that_were_never_written_are_refused_instead_of_read_as_zeros(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["data/demo_1/obs/eef"]
        array = file["data/demo_1"].create_dataset("obs/eef", (9, 3), "f4", chunks=(4, 3))
        array[:4] = 1
    assert_only_demo_1_fails(path, "obs/eef", "2 of 3 chunks never written")


def test_rows_that_were_never_written_are_refused(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["data/demo_1/obs/eef"]
        file["data/demo_1"].create_dataset("obs/eef", (9, 3), "f4")
    assert_only_demo_1_fails(path, "obs/eef", "all rows never written")


def test_a_damaged_chunk_is_refused(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "demos.hdf5", compression="gzip")
    with h5py.File(path, "r") as file:
        offset = file["data/demo_1/obs/top_image"].id.get_chunk_info(1).byte_offset
    data = bytearray(path.read_bytes())
    data[offset : offset + 40] = bytes(40)
    path.write_bytes(bytes(data))
    assert_only_demo_1_fails(path, "obs/top_image", "obs/top_image cannot be read")


@pytest.mark.parametrize("tenth", range(1, 10))
def test_a_file_cut_off_anywhere_is_refused(path: Path, tenth: int) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * tenth // 10])
    with pytest.raises(LogError, match="the HDF5 file is cut off"):
        open_log(path)


def test_a_log_may_only_hold_its_own_rows(path: Path, tmp_path: Path) -> None:
    """HDF5 can name other files: links, external storage, virtual arrays."""
    secret = tmp_path / "secret.bin"
    secret.write_bytes(bytes(9 * 3 * 4))
    with h5py.File(path, "r+") as file:
        obs = file["data/demo_1/obs"]
        obs["link"] = h5py.ExternalLink(str(path), "/data/demo_0/obs/eef")
        del obs["eef"]
        obs.create_dataset("eef", (9, 3), "f4", external=[(str(secret), 0, 108)])
    assert_only_demo_1_fails(path, "obs/eef", "kept in another file")
    with open_log(path) as log:
        assert "obs/link" not in {topic.name for topic in log.topics()}


def test_a_virtual_array_is_refused(path: Path, tmp_path: Path) -> None:
    with h5py.File(path, "r+") as file:
        layout = h5py.VirtualLayout((9, 3), "f4")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.hdf5"), "x", (9, 3))
        del file["data/demo_1/obs/eef"]
        file["data/demo_1"].create_virtual_dataset("obs/eef", layout)
    assert_only_demo_1_fails(path, "obs/eef", "kept in another file")


def test_a_length_that_no_memory_holds_is_refused_when_it_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "huge.hdf5", "w") as file:
        file.create_dataset("data/demo_0/actions", (2**40, 7), "f8", chunks=(1024, 7))
    with open_log(tmp_path / "huge.hdf5") as log:
        assert log.message_times()[1] is False
        with pytest.raises(LogError, match="never written"):
            next(iter(log.messages(["actions"])))


def test_groups_that_hold_each_other_do_not_hang(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data/demo_0/obs/again"] = file["data/demo_0"]
    with open_log(path) as log:
        assert len(actions(log, log.episodes()[0])) == 12


def test_a_heap_of_texts_that_would_send_hdf5_round_for_ever_is_refused(path: Path) -> None:
    data = bytearray(path.read_bytes())
    start = data.index(b"GCOL\x01\0\0\0")
    size = int.from_bytes(data[start + 8 : start + 16], "little")
    data[start + 8 : start + 16] = (size + 179).to_bytes(8, "little")
    path.write_bytes(bytes(data))
    with pytest.raises(LogError, match="a heap of texts"):
        open_log(path)


def test_attributes_that_are_damaged_are_said_in_the_tags(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data/demo_1"].attrs["note"] = np.zeros(3, np.dtype("S6"))
        file["data/demo_1"].attrs["success"] = True
    with open_log(path) as log:
        assert dict(log.episodes()[1].tags)["success"] == "True"


def test_an_hdf5_file_without_demonstrations_shows_what_is_inside(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "weather.h5", "w") as file:
        file["temperature"] = np.zeros(4)
    with pytest.raises(LogError, match="temperature(.|\n)*robomimic layout"):
        open_log(tmp_path / "weather.h5")


def test_an_unknown_topic_is_refused_with_the_nearest_one(path: Path) -> None:
    with open_log(path) as log, pytest.raises(LogError, match="did you mean 'actions'"):
        log.messages(["action"])


def test_a_rate_that_is_not_positive_is_wrong_use(path: Path) -> None:
    with pytest.raises(UsageError, match="array_rate_hz"):
        open_log(path, array_rate_hz=-1.0)


@pytest.mark.parametrize("stated", ["1e-300", "1e12", "1e308", "NaN", "-5", "0"])
def test_a_rate_that_rows_cannot_have_is_not_believed(tmp_path: Path, stated: str) -> None:
    path = write_hdf5(tmp_path / "demos.hdf5")
    with h5py.File(path, "r+") as file:
        file["data"].attrs["env_args"] = f'{{"env_kwargs": {{"control_freq": {stated}}}}}'
    with open_log(path, array_rate_hz=20.0) as log:
        assert [len(actions(log, episode)) for episode in log.episodes()] == list(LENGTHS)
        assert log.assumed_rate_hz == 20.0  # type: ignore[attr-defined]


def test_a_file_that_counts_more_rows_than_it_has_is_doubted(path: Path) -> None:
    for total, doubts in ((26, 0), (27, 1)):
        with h5py.File(path, "r+") as file:
            file["data"].attrs["total"] = total
        with open_log(path) as log:
            assert len(log.doubts()) == doubts


def test_real_robosuite_demonstrations_give_states_and_actions() -> None:
    root = "robosuite_demos/v1.0.1/robosuite/models/assets/demonstrations"
    with open_log(real_data(f"{root}/lift/panda/demo.hdf5"), array_rate_hz=20.0) as log:
        assert {t.name: t.message_count for t in log.topics()} == {"actions": 412, "joint_torques": 412, "states": 412}
        (episode,) = log.episodes()
        assert (episode.name, episode.tags["task"], episode.end_ns) == ("demo_1", "Lift", 20_600_000_000)
        assert next(iter(log.messages(["states"]))).body.shape == (32,)
    with open_log(
        real_data("robosuite_demos/v0.3.0/robosuite/models/assets/demonstrations/SawyerLift/demo.hdf5")
    ) as log:
        assert [(e.name, e.tags["task"]) for e in log.episodes()] == [
            ("demo_1", "SawyerLift"),
            ("demo_2", "SawyerLift"),
        ]
