"""`open_log` tells formats by content, and says what to do about everything that is no log."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.real_data import real_data
from tests.synthetic import write_mcap, write_zarr
from vilp_data.errors import LogError, UsageError, salvage_command
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
    path = real_data("logs/keelson/connectors_klog_bin_2024-05-15.mcap")
    with pytest.raises(LogError, match="binary") as told:
        open_log(path)
    assert f"vilp-data salvage {path} -o " in str(told.value.remedy)


def test_what_a_folder_that_nobody_may_write_to_holds_is_salvaged_into_the_one_at_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda folder, mode: folder != tmp_path)
    assert salvage_command(tmp_path / "run.bag").endswith("/run.bag -o run-salvaged.mcap`")
    assert salvage_command(Path("run.bag")) == "`vilp-data salvage run.bag -o run-salvaged.mcap`"


@pytest.mark.parametrize(
    ("suffix", "head"),
    [("mcap", b"\x89MCAP0\r\r\n\r\n"), ("mcap", b"\x89MCAP0\n\1"), ("bag", b"#ROSBAG V2.0\r\n")],
)
def test_a_log_with_converted_line_endings_is_told_with_the_command_that_saves_it(
    tmp_path: Path, suffix: str, head: bytes
) -> None:
    path = tmp_path / f"run.{suffix}"
    path.write_bytes(head + bytes(200))
    with pytest.raises(LogError, match="line endings") as told:
        open_log(path)
    assert f"*.{suffix}" in str(told.value.remedy)
    assert f"`vilp-data salvage {path} -o {tmp_path / 'run-salvaged.mcap'}`" in str(told.value.remedy)
