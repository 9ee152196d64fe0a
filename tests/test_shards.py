"""Files that are whole or not there, and that say when they were damaged."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vilp_data import shards
from vilp_data.errors import BusyError, StoreError
from vilp_data.writer_lock import leftovers, remove_leftovers, writer_lock

TENSORS = {
    "frames": np.arange(5 * 4 * 3, dtype=np.uint8).reshape(5, 4, 3),
    "time": np.arange(5, dtype=np.int64),
    "valid": np.array([True, False, True]),
    "empty": np.zeros((0, 3), np.float32),
    "half": np.linspace(-1, 1, 7, dtype=np.float16),
}


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    path = tmp_path / "folder" / "a.safetensors"
    shards.write_shard(path, TENSORS, {"key": "value"})
    return path


def test_what_is_written_is_read_by_map_by_copy_and_by_safetensors_itself(shard: Path) -> None:
    for arrays in (
        shards.open_shard(shard).arrays,
        shards.read_shard(shard).arrays,
        safetensors.numpy.load_file(shard),
    ):
        assert set(arrays) == set(TENSORS)
        for name, array in TENSORS.items():
            assert arrays[name].dtype == array.dtype
            np.testing.assert_array_equal(arrays[name], array)
    assert shards.open_shard(shard).metadata["key"] == "value"


dtypes = st.sampled_from([np.uint8, np.bool_, np.float16, np.float32, np.float64, np.int32, np.int64])


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
@given(
    array=dtypes.flatmap(
        lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5))
    )
)
def test_any_array_comes_back_bit_for_bit(tmp_path: Path, array: np.ndarray) -> None:
    shards.write_shard(tmp_path / "x", {"x": array, "other": np.ones(3, np.uint8)}, {})
    back = shards.open_shard(tmp_path / "x").arrays["x"]
    assert back.shape == array.shape
    assert back.tobytes() == array.tobytes()


def test_the_same_content_gives_the_same_bytes(shard: Path, tmp_path: Path) -> None:
    shards.write_shard(tmp_path / "b", dict(reversed(TENSORS.items())), {"key": "value"})
    assert (tmp_path / "b").read_bytes() == shard.read_bytes()


def test_every_flipped_bit_and_every_cut_is_noticed(shard: Path, tmp_path: Path) -> None:
    whole = shard.read_bytes()
    damaged = tmp_path / "damaged"
    for position in range(len(whole)):
        damaged.write_bytes(whole[:position] + bytes([whole[position] ^ 4]) + whole[position + 1 :])
        with pytest.raises(StoreError):
            shards.verify_shard(damaged)
    for length in range(len(whole)):
        damaged.write_bytes(whole[:length])
        with pytest.raises(StoreError):
            shards.open_shard(damaged)


def test_mapped_arrays_cannot_be_written_to(shard: Path) -> None:
    with pytest.raises(ValueError, match="read-only"):
        shards.open_shard(shard).arrays["frames"][0] = 1


def test_an_open_shard_keeps_no_file_descriptor(shard: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    held = [shards.open_shard(shard) for _ in range(50)]
    assert len(os.listdir("/proc/self/fd")) == before
    assert len(held) == 50


def test_an_interrupted_write_leaves_the_old_file_and_no_other(shard: Path) -> None:
    before = shard.read_bytes()
    with pytest.raises(KeyboardInterrupt), shards.atomic_file(shard) as file:
        file.write(b"half of it")
        raise KeyboardInterrupt
    assert shard.read_bytes() == before
    assert [path.name for path in shard.parent.iterdir()] == [shard.name]


def test_a_full_disk_is_said_and_leaves_the_old_file(shard: Path) -> None:
    """A limit on file size stands in for a full disk: the operating system refuses the write half-way."""
    before = shard.read_bytes()
    code = (
        "import resource, signal, sys, numpy as np; from pathlib import Path; from vilp_data import shards\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "shards.write_shard(Path(sys.argv[1]), {'x': np.zeros(10**6, np.uint8)}, {})"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(shard)], capture_output=True, text=True, check=False)
    assert "StoreError" in ended.stderr
    assert "free some space" in ended.stderr
    assert shard.read_bytes() == before
    assert [path.name for path in shard.parent.iterdir()] == [shard.name]


def test_a_second_writer_is_told_that_the_dataset_is_busy(tmp_path: Path) -> None:
    with writer_lock(tmp_path), pytest.raises(BusyError, match="another process"), writer_lock(tmp_path):
        pass
    with writer_lock(tmp_path):
        pass


def test_what_a_killed_writer_left_is_cleared_away(tmp_path: Path) -> None:
    leftover = tmp_path / "latents" / "front" / "k" / ".e.safetensors.123.tmp"
    leftover.parent.mkdir(parents=True)
    leftover.write_bytes(b"half")
    remove_leftovers(tmp_path)
    assert not leftover.exists()


def test_what_was_left_by_those_who_write_without_the_lock_goes_once_it_is_old(tmp_path: Path) -> None:
    """Recorders, trainers and `generate` may be at work, so a young file may still be theirs."""
    old = tmp_path / "runs" / "vqgan" / ".a.safetensors.1.tmp"
    young = [tmp_path / "logs" / ".b.mcap.2.tmp", tmp_path / "generated" / "planner" / ".c.safetensors.3.tmp"]
    for leftover in (old, *young):
        leftover.parent.mkdir(parents=True)
        leftover.write_bytes(b"half")
    os.utime(old, (0, 0))
    remove_leftovers(tmp_path)
    assert not old.exists()
    assert all(leftover.exists() for leftover in young)


def test_a_folder_that_is_being_made_in_a_dataset_is_not_the_writers_to_clear_away(tmp_path: Path) -> None:
    """A rollout or an export with its folder in the dataset holds a lock of its own, and clears away what a killed one left."""
    for left in (tmp_path / ".run1.4242.tmp", tmp_path / "generated" / ".x.tmp", tmp_path / "runs" / ".y.tmp"):
        left.mkdir(parents=True)
        os.utime(left, (0, 0))
    assert leftovers(tmp_path) == []
    remove_leftovers(tmp_path)
    assert (tmp_path / ".run1.4242.tmp").is_dir()


def test_a_file_that_its_owner_renames_meanwhile_is_none_of_the_leftovers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / ".a.mcap.1.tmp").write_bytes(b"half")
    listed = Path.glob

    def glob(self: Path, pattern: str) -> list[Path]:
        found = list(listed(self, pattern))
        for path in found:
            path.rename(path.with_name("a.mcap"))
        return found

    monkeypatch.setattr(Path, "glob", glob)
    remove_leftovers(tmp_path)
    assert [path.name for path in (tmp_path / "logs").iterdir()] == ["a.mcap"]


def test_thousands_of_shards_open_under_a_low_descriptor_limit(shard: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(256, hard), hard))
    try:
        assert len([shards.open_shard(shard) for _ in range(1000)]) == 1000
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
