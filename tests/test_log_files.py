"""Which paths are logs: bags as one, their parts never torn apart, nothing in a folder lost from sight."""

from __future__ import annotations

from pathlib import Path

import pytest

from vilp_data.errors import UsageError
from vilp_data.log_files import find_logs
from vilp_data.log_hashes import _file_stats
from vilp_data.sources.folder_hash import folder_sha256, log_files


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


def test_suffixes_count_in_either_case(tmp_path: Path) -> None:
    make(tmp_path, "A.MCAP", "b.Bag", "c.BAG.active")
    assert found(tmp_path) == ["A.MCAP", "b.Bag"]
    assert [path.name for path in find_logs([tmp_path]).passed_over] == ["c.BAG.active"]


def test_linked_folders_are_followed_and_links_that_lead_nowhere_or_back_are_named(tmp_path: Path) -> None:
    make(tmp_path / "disk", "run.mcap", "deep/er.bag")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "monday").symlink_to(tmp_path / "disk")
    (tmp_path / "logs" / "tuesday").symlink_to(tmp_path / "unmounted")
    (tmp_path / "disk" / "deep" / "back").symlink_to(tmp_path / "logs")
    (tmp_path / "disk" / "deep" / "up").symlink_to(tmp_path / "disk")
    logs = find_logs([tmp_path / "logs"])
    assert found(tmp_path / "logs") == ["monday/deep/er.bag", "monday/run.mcap"]
    assert [path.name for path in logs.passed_over] == ["up", "tuesday"]
    with pytest.raises(UsageError, match="tuesday"):
        (tmp_path / "logs" / "monday").unlink()
        find_logs([tmp_path / "logs"])


def test_what_lies_behind_a_link_counts_in_a_log_s_hash(tmp_path: Path) -> None:
    make(tmp_path / "elsewhere", "deep/0.0")
    make(tmp_path / "store", ".zgroup")
    (tmp_path / "store" / "data").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "loop").symlink_to(tmp_path / "store")
    assert list(log_files(tmp_path / "store")) == [".zgroup", "data/deep/0.0"]
    before = folder_sha256(tmp_path / "store"), _file_stats(tmp_path / "store")
    (tmp_path / "elsewhere" / "deep" / "0.0").write_bytes(b"other")
    after = folder_sha256(tmp_path / "store"), _file_stats(tmp_path / "store")
    assert before[0] != after[0]
    assert before[1][0] != after[1][0]


def test_unfinished_recordings_are_passed_over_and_named(tmp_path: Path) -> None:
    make(tmp_path, "run.bag", "run.bag.active")
    assert [path.name for path in find_logs([tmp_path]).passed_over] == ["run.bag.active"]
    (tmp_path / "run.bag").unlink()
    with pytest.raises(UsageError, match=r"run\.bag\.active(.|\n)*salvage"):
        find_logs([tmp_path])
