"""Damaged, unfinished and hostile bags are errors in words with a way out, never another number of messages."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
import zstandard

from tests.sources.test_bag_types import write_ros1_topic
from tests.sources.test_bags import Compression, read_all
from tests.synthetic import SyntheticLog
from tests.synthetic_bags import with_files, write_rosbag1, write_rosbag2
from vilp_data.errors import LogError
from vilp_data.sources import open_log


def test_a_bag_without_an_index_leads_to_salvage(bag: Path, tmp_path: Path) -> None:
    content = bag.read_bytes()
    place = content.index(b"index_pos=") + len(b"index_pos=")
    path = tmp_path / "run.bag.active"
    path.write_bytes(content[:place] + bytes(8) + content[place + 8 :])
    with pytest.raises(LogError, match=r"run\.bag\.active: the bag has no index(.|\n)*vilp-data salvage"):
        open_log(path)


def test_an_encrypted_bag_is_named_as_such(bag: Path, tmp_path: Path) -> None:
    content = bag.read_bytes()
    (length,) = struct.unpack_from("<I", content, 13)
    field = b"encryptor=rosbag/AesCbcEncryptor"
    header = content[17 : 17 + length] + struct.pack("<I", len(field)) + field
    path = tmp_path / "run.bag"
    path.write_bytes(content[:13] + struct.pack("<I", len(header)) + header + content[17 + length :])
    with pytest.raises(LogError, match=r"encrypted(.|\n)*AesCbc"):
        open_log(path)


@pytest.mark.parametrize("kind", ["bag", "db3", "file"])
def test_a_bag_cut_anywhere_is_an_error_with_a_way_out(
    tmp_path: Path, bag: Path, db3: Path, log: SyntheticLog, kind: str
) -> None:
    path = {"bag": bag, "db3": db3}.get(kind)
    if path is None:
        path = next(write_rosbag2(tmp_path / "run", log, compression="file").glob("*.zstd"))
    content, cut = path.read_bytes(), tmp_path / f"cut.{kind}"
    for size in [*range(1, 100, 9), *range(100, len(content), len(content) // 40), len(content) - 1]:
        cut.write_bytes(content[:size])
        with pytest.raises(LogError) as caught, open_log(cut) as reader:
            read_all(reader)
        assert caught.value.remedy
        assert str(cut) in str(caught.value)


def flipped(content: bytes, path: Path, count: int) -> Iterator[Path]:
    """Copies with one bit changed; those ends that hold headers and indexes more often than the messages between."""
    rng = random.Random(3)
    for _ in range(count):
        changed = bytearray(content)
        size = len(content)
        place = rng.choice(
            [rng.randrange(size), rng.randrange(min(size, 200)), size - 1 - rng.randrange(min(size, 2000))]
        )
        changed[place] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        yield path


@pytest.mark.parametrize("kind", ["none", "lz4", "bz2", "db3"])
def test_a_flipped_bit_gives_messages_or_an_error_in_words(
    tmp_path: Path, log: SyntheticLog, db3: Path, kind: str
) -> None:
    source = db3 if kind == "db3" else write_rosbag1(tmp_path / "run.bag", log, compression=kind)  # type: ignore[arg-type]
    caught = 0
    for path in flipped(source.read_bytes(), tmp_path / f"flipped.{kind}", 60):
        try:
            with open_log(path) as reader:
                for topic in reader.topics():
                    list(reader.messages([topic.name]))
        except LogError as error:
            caught += 1
            assert error.remedy
            assert str(path) in str(error)
    assert caught > 0


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_a_compressed_chunk_that_is_damaged_names_its_place(
    tmp_path: Path, log: SyntheticLog, compression: Compression
) -> None:
    path = write_rosbag1(tmp_path / "run.bag", log, compression=compression)
    content = bytearray(path.read_bytes())
    place = content.index(b"compression=") + 200
    content[place] ^= 0x55
    path.write_bytes(content)
    with (
        open_log(path) as reader,
        pytest.raises(LogError, match=f"the chunk at byte (.|\n)*{compression}(.|\n)*salvage"),
    ):
        read_all(reader)


def test_a_chunk_that_inflates_to_more_than_it_claims_is_refused(tmp_path: Path, log: SyntheticLog) -> None:
    path = write_rosbag1(tmp_path / "run.bag", log, compression="bz2")
    content = bytearray(path.read_bytes())
    place = content.index(b"size=") + len(b"size=")
    struct.pack_into("<I", content, place, 100)
    path.write_bytes(content)
    with open_log(path) as reader, pytest.raises(LogError, match="more than 100 bytes"):
        read_all(reader)


def test_messages_that_the_index_does_not_count_are_an_error(tmp_path: Path) -> None:
    path = write_ros1_topic(tmp_path / "run.bag", "std_msgs/msg/Int32", "int32 data", b"\1\0\0\0")
    content = bytearray(path.read_bytes())
    place = content.rindex(struct.pack("<II", 0, 1))  # connection 0 has one message
    struct.pack_into("<II", content, place, 0, 2)
    path.write_bytes(content)
    with pytest.raises(LogError, match="1 messages of connection 0, 2 by the bag's"):
        open_log(path)


def test_an_index_of_a_chunk_that_disagrees_with_the_bags_own_is_damage(tmp_path: Path, bag: Path) -> None:
    content = bytearray(bag.read_bytes())
    place = content.index(b"ver=") - 200
    while content[place : place + 5] != b"conn=" or b"count=" not in content[place : place + 60]:
        place += 1
    struct.pack_into("<I", content, place + 5, 77)
    path = tmp_path / "run.bag"
    path.write_bytes(content)
    with pytest.raises(LogError, match="0 messages of connection 0, 3 by the bag's"):
        open_log(path)


def test_files_that_a_bag_lacks_are_named(tmp_path: Path, log: SyntheticLog) -> None:
    folder = write_rosbag2(tmp_path / "run", log, parts=3)
    (folder / "run_1.db3").unlink()
    with pytest.raises(LogError, match=r"run_1\.db3(.|\n)*ros2 bag reindex"):
        open_log(folder)


@pytest.mark.parametrize(
    "text",
    [
        "rosbag2_bagfile_information:\n",
        "rosbag2_bagfile_information: [1, 2]\n",
        "rosbag2_bagfile_information:\n  relative_file_paths: run.db3\n",
        "rosbag2_bagfile_information:\n\t- {\n",
        "rosbag2_bagfile_information: !!python/object/apply:os.system ['true']\n",
    ],
)
def test_metadata_that_cannot_be_understood_is_an_error_with_a_way_out(tmp_path: Path, text: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(LogError, match=r"metadata\.yaml cannot be understood(.|\n)*reindex"):
        open_log(tmp_path)


def test_metadata_cannot_lead_out_of_the_folder(tmp_path: Path, log: SyntheticLog) -> None:
    folder = write_rosbag2(tmp_path / "run", log)
    shutil.copy(folder / "run.db3", tmp_path / "elsewhere.db3")
    metadata = folder / "metadata.yaml"
    metadata.write_text(with_files(metadata.read_text(), ["../elsewhere.db3"]))
    with pytest.raises(LogError, match="missing"):
        open_log(folder)


def test_a_database_that_is_no_bag_is_refused(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "shop.db3") as database:
        database.execute("CREATE TABLE orders (id INTEGER)")
    with pytest.raises(LogError, match="no bag of ROS 2"):
        open_log(tmp_path / "shop.db3")


def test_a_view_in_place_of_a_table_is_never_run(tmp_path: Path, db3: Path) -> None:
    path = tmp_path / "run.db3"
    shutil.copy(db3, path)
    with sqlite3.connect(path) as database:
        database.execute("ALTER TABLE messages RENAME TO kept")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)"
            " SELECT id, 1 AS topic_id, 1 AS timestamp, x'00' AS data FROM n"
        )
    with pytest.raises(LogError, match="no bag of ROS 2"):
        open_log(path)


@pytest.mark.parametrize(("column", "value"), [("timestamp", "'soon'"), ("data", "5"), ("topic_id", "99")])
def test_rows_of_another_kind_are_damage(tmp_path: Path, db3: Path, column: str, value: str) -> None:
    path = tmp_path / "run.db3"
    shutil.copy(db3, path)
    with sqlite3.connect(path) as database:
        database.execute(f"UPDATE messages SET {column} = {value} WHERE id = 7")
    with pytest.raises(LogError, match="damaged"), open_log(path) as reader:
        reader.episodes()
        read_all(reader)


def test_a_bag_that_its_recorder_did_not_close_is_not_read_in_part(tmp_path: Path, db3: Path) -> None:
    path = tmp_path / "run.db3"
    shutil.copy(db3, path)
    (tmp_path / "run.db3-wal").write_bytes(b"x" * 100)
    with pytest.raises(LogError, match=r"journal(.|\n)*run\.db3-wal(.|\n)*salvage"):
        open_log(path)


def test_reading_writes_nothing_beside_a_bag(tmp_path: Path, log: SyntheticLog) -> None:
    folder = write_rosbag2(tmp_path / "run", log, parts=2)
    before = sorted(os.listdir(folder))
    with open_log(folder) as reader:
        read_all(reader)
    assert sorted(os.listdir(folder)) == before


def test_a_small_file_cannot_fill_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vilp_data.sources.rosbag2_log.FREE_RATIO_BYTES", 1000)
    path = tmp_path / "bomb.db3.zstd"
    path.write_bytes(zstandard.ZstdCompressor().compress(bytes(10_000_000)))
    with pytest.raises(LogError, match="larger than any recording"):
        open_log(path)
