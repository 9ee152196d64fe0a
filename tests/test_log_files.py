"""Which paths are logs: bags as one, their parts never torn apart, nothing in a folder lost from sight."""

from __future__ import annotations

from pathlib import Path

import pytest

from vilp_data.errors import UsageError
from vilp_data.log_files import find_logs


def make(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")


def make_bag(folder: Path, *names: str, listed: tuple[str, ...] | None = None) -> None:
    make(folder, *names)
    lines = "".join(f"    - {name}\n" for name in listed or names)
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{lines}")


def found(folder: Path) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in find_logs([folder]).logs]


def test_logs_of_every_format_are_found_below_a_folder(tmp_path: Path) -> None:
    make(tmp_path, "a.mcap", "b.bag", "deep/er/c.db3", "d.mcap.zstd", "e.hdf5", "notes.txt", ".hidden.bag")
    make(tmp_path, "store/.zgroup", "store/data/0.0")
    assert found(tmp_path) == ["a.mcap", "b.bag", "d.mcap.zstd", "deep/er/c.db3", "e.hdf5", "store"]


def test_a_bag_of_several_files_is_one_log(tmp_path: Path) -> None:
    make_bag(tmp_path / "split", "split_0.db3", "split_1.db3")
    assert found(tmp_path) == ["split"]
    assert find_logs([tmp_path / "split"]).logs == [tmp_path / "split"]


def test_a_bag_of_one_plain_file_is_that_file_and_of_a_compressed_one_the_folder(tmp_path: Path) -> None:
    make_bag(tmp_path / "one", "one_0.mcap")
    make_bag(tmp_path / "packed", "packed_0.db3.zstd")
    assert found(tmp_path) == ["one/one_0.mcap", "packed"]


def test_files_that_a_bag_does_not_list_are_logs_of_their_own(tmp_path: Path) -> None:
    make_bag(tmp_path / "bag", "bag_0.db3", "bag_1.db3", "stray.mcap", listed=("bag_0.db3", "bag_1.db3"))
    assert found(tmp_path) == ["bag", "bag/stray.mcap"]


def test_parts_without_their_metadata_are_logs_of_their_own(tmp_path: Path) -> None:
    make(tmp_path, "bag_0.db3", "bag_1.db3")
    assert found(tmp_path) == ["bag_0.db3", "bag_1.db3"]


@pytest.mark.parametrize("text", ["rosbag2_bagfile_information: {\n", "rosbag2_bagfile_information:\n  version: 9\n"])
def test_a_bag_whose_metadata_cannot_be_understood_is_given_whole(tmp_path: Path, text: str) -> None:
    """So that reading it says what is wrong, rather than making episodes of its parts."""
    make(tmp_path / "bag", "bag_0.db3", "bag_1.db3")
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    assert found(tmp_path) == ["bag"]


def test_metadata_of_something_else_makes_no_bag(tmp_path: Path) -> None:
    make(tmp_path, "run.mcap")
    (tmp_path / "metadata.yaml").write_text("title: my recordings\n")
    assert found(tmp_path) == ["run.mcap"]


def test_unfinished_recordings_are_passed_over_and_named(tmp_path: Path) -> None:
    make(tmp_path, "run.bag", "run.bag.active")
    assert [path.name for path in find_logs([tmp_path]).passed_over] == ["run.bag.active"]
    (tmp_path / "run.bag").unlink()
    with pytest.raises(UsageError, match=r"run\.bag\.active(.|\n)*salvage"):
        find_logs([tmp_path])
