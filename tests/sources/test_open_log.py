"""`open_log` tells formats by content, and says what to do about everything that is no log."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.real_data import real_data
from tests.synthetic import write_mcap, write_zarr
from vilp_data.errors import LogError, UsageError
from vilp_data.sources import open_log


def test_format_is_told_by_content_whatever_the_suffix(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.bin")
    store = write_zarr(tmp_path / "demonstrations")
    with open_log(log.path) as one, open_log(store.path) as other:
        assert (one.format, other.format) == ("mcap", "zarr")


def test_missing_path_is_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such log"):
        open_log(tmp_path / "absent.mcap")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "the log is empty"),
        (b"hello world, not a log", "not a log"),
        (b"\x89MCAP", "cut off inside its first mark"),
        (b"\x89MCAP0\n\x01\x19", "line endings converted"),
        (b"#ROSBAG V2.0\n....", "the bag is cut off"),
        (b"#ROSBAG V1.2\n....", "a version that is not read"),
        (b"SQLite format 3\0....", "the bag is cut off"),
        (b"\x28\xb5\x2f\xfd....", "the compressed file is damaged"),
        (b"\x89HDF\r\n\x1a\n....", "the HDF5 file cannot be opened"),
    ],
)
def test_what_is_no_readable_log_is_named_with_a_remedy(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=says) as caught:
        open_log(path)
    assert str(path) in str(caught.value)
    assert caught.value.remedy


def test_a_folder_that_is_no_zarr_store_shows_what_is_inside(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.mcap").touch()
    with pytest.raises(LogError, match=r"a\.mcap"):
        open_log(tmp_path / "logs")


def rosbag2_folder(folder: Path, n_files: int) -> Path:
    folder.mkdir()
    names = [f"{folder.name}_{number}.mcap" for number in range(n_files)]
    listed = "".join(f"    - {name}\n" for name in names)
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{listed}")
    for name in names:
        write_mcap(folder / name, n_frames=2)
    return folder


def test_a_rosbag2_folder_stands_for_the_file_in_it(tmp_path: Path) -> None:
    folder = rosbag2_folder(tmp_path / "take", 1)
    with open_log(folder) as by_folder, open_log(folder / "take_0.mcap") as by_file:
        assert by_folder.path == by_file.path
        assert by_folder.sha256() == by_file.sha256()
        assert by_folder.episodes() == by_file.episodes()


def test_real_file_mangled_by_line_ending_conversion_is_recognised() -> None:
    with pytest.raises(LogError, match="binary"):
        open_log(real_data("logs/keelson/connectors_klog_bin_2024-05-15.mcap"))
