"""A hostile or broken log cannot ask for memory, depth or paths that no recorder needs."""

from __future__ import annotations

import io
import json
import random
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from tests.damage import salvaged, write_log
from tests.synthetic import write_mcap
from vilp_data import limits
from vilp_data.errors import LogError, UsageError, VilpDataError
from vilp_data.salvage import salvage_log
from vilp_data.sources import inflate, mcap_clean, open_log

# --- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        "../../etc/passwd",
        "/etc/passwd",
        "a/../../b",
        "a\0b",
        "..",
        "C:\\windows",
        "C:/windows",
        "a\\..\\..\\b",
        "",
        "x" * 300,
    ],
)
def test_a_name_that_leads_out_of_its_folder_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(LogError, match="outside its own folder"):
        limits.inside(tmp_path, name, where="info.json")


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "link").symlink_to("/etc")
    with pytest.raises(LogError, match="outside"):
        limits.inside(tmp_path / "log", "link/passwd", where="info.json")


@given(st.text())
def test_a_file_name_is_one_visible_name_that_fits(name: str) -> None:
    plain = limits.file_name(name)
    assert plain not in ("", ".", "..")
    assert not plain.startswith(".")
    assert not set(plain) & set("/\\\0:\n")
    assert len(plain.encode()) <= limits.NAME_BYTES


def test_a_file_inside_is_named(tmp_path: Path) -> None:
    assert limits.inside(tmp_path, "data/chunk-000/a.parquet", where="x") == tmp_path / "data/chunk-000/a.parquet"


def test_topics_that_look_like_paths_stay_inside_the_dataset(tmp_path: Path) -> None:
    """Neither the log's name nor its topics choose where an episode is written."""
    from tests.synthetic import task_spec
    from vilp_data.ingest import ingest_logs

    (tmp_path / "in").mkdir()
    log = write_mcap(tmp_path / "in" / "..sneaky name..mcap", cameras=("../../../out",))
    views = {"front": {"topic": "/camera/../../../out/image", "height": 48, "width": 64}}
    ingest_logs([log.path], tmp_path / "data", task_spec(log, views=views), workers=1)
    assert {path.name for path in tmp_path.iterdir()} == {"in", "data"}
    assert not [path for path in (tmp_path / "data" / "episodes").rglob("*") if path.name.startswith("..")]


# --- how limits are raised --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("said", "value"), [("5", 5), ("4GiB", 4 << 30), ("2 MB", 2_000_000), ("", 7)])
def test_the_environment_raises_a_limit(said: str, value: int) -> None:
    assert limits._limit("X", 7, {"VILP_MAX_X": said}) == value


@pytest.mark.parametrize("said", ["much", "-1", "0", "1e9", "4 TBB", "9" * 30])
def test_what_is_no_limit_is_refused(said: str) -> None:
    with pytest.raises(UsageError, match="VILP_MAX_X"):
        limits._limit("X", 7, {"VILP_MAX_X": said})


def test_a_log_above_a_limit_is_read_once_the_limit_that_the_error_names_is_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_mcap(tmp_path / "run.mcap").path

    def count() -> int:
        with open_log(path) as log:
            return sum(1 for _ in log.messages([topic.name for topic in log.topics()]))

    sent = count()
    monkeypatch.setattr(limits, "CHUNK_BYTES", 1000)
    with pytest.raises(LogError, match=r"set VILP_MAX_CHUNK_BYTES=(\d+)") as refused:
        count()
    monkeypatch.setattr(limits, "CHUNK_BYTES", int(str(refused.value.remedy).rpartition("=")[2]))
    assert count() == sent


# --- inflating --------------------------------------------------------------------------------------------------------

MOST = 32 << 20
"""Bytes: what a log of a few kB may make a test hold."""


@contextmanager
def holding_less_than(most: int) -> Iterator[None]:
    """The block never holds more than `most` bytes at a time."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def bomb(size: int) -> bytes:
    """A zstd frame of `size` zeros, which never says how many: a few kB for gigabytes."""
    stream = zstandard.ZstdCompressor(level=1).compressobj()
    block = bytes(1 << 20)
    return b"".join([*(stream.compress(block) for _ in range(size >> 20)), stream.flush()])


PACKERS: dict[str, Callable[[bytes], bytes]] = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}


@pytest.mark.parametrize("compression", PACKERS)
def test_a_chunk_inflates_to_no_more_than_it_claims(compression: str) -> None:
    packed = PACKERS[compression](bytes(50_000_000))
    assert len(packed) < 250_000
    with holding_less_than(2 << 20), pytest.raises(ValueError, match=r"1000|Destination"):
        inflate.inflate(packed, compression, 1000)
    with holding_less_than(2 << 20):
        assert len(inflate.inflate_prefix(packed, compression, 1000).data) == 1000


@pytest.mark.parametrize("compression", PACKERS)
@pytest.mark.parametrize("less", [1, 100, 131_072])
def test_a_chunk_that_inflates_to_more_than_it_claims_is_faulty_however_little_more(
    compression: str, less: int
) -> None:
    packed = PACKERS[compression](random.Random(0).randbytes(300_000))
    found = inflate.inflate_prefix(packed, compression, 300_000 - less)
    assert "more than" in found.fault
    assert len(found.data) == 300_000 - less


def test_what_comes_out_is_held_once() -> None:
    for compression, packed in (("zstd", bomb(64 << 20)), ("lz4", lz4.frame.compress(bytes(64 << 20)))):
        with holding_less_than(80 << 20):
            assert len(inflate.inflate_prefix(packed, compression, 64 << 20).data) == 64 << 20


@pytest.mark.parametrize("compression", PACKERS)
def test_a_claim_of_terabytes_allocates_nothing(compression: str) -> None:
    """The claim is in the chunk's header and in the compressed frame's own. Half a gigabyte could be had, and would be seen here."""
    for claim in (1 << 29, 1 << 45):
        packed = bytearray(lz4.frame.compress(b"hello " * 100, store_size=True))
        packed[6:14] = struct.pack("<Q", claim)
        if compression == "zstd":  # eight bytes of content size, no checksum, a window of 1 MB
            packed = bytearray(b"\x28\xb5\x2f\xfd" + bytes([0b11000000, 10 << 3]) + struct.pack("<Q", claim))
            packed += bytes([0b00000001 | 600 << 3 & 0xFF, 600 >> 5, 0]) + b"hello " * 100
        with holding_less_than(4 << 20), pytest.raises(ValueError, match=r"\S"):
            inflate.inflate(bytes(packed), compression, claim)


def test_a_huge_zstd_window_is_refused() -> None:
    frame = b"\x28\xb5\x2f\xfd" + bytes([0b00000000, (31 - 10) << 3]) + b"\x01\x00\x00"
    with pytest.raises(ValueError, match=r"\S"):
        inflate.inflate(frame, "zstd", 100)


@given(st.binary(max_size=400), st.sampled_from(["zstd", "lz4", "bz2", ""]), st.integers(0, 1000), st.booleans())
def test_any_bytes_inflate_to_a_bounded_prefix_or_a_fault(
    packed: bytes, compression: str, size: int, marked: bool
) -> None:
    mark = {"zstd": b"\x28\xb5\x2f\xfd", "lz4": b"\x04\x22\x4d\x18", "bz2": b"BZh9"}.get(compression, b"")
    packed = mark + packed if marked else packed
    data, fault = inflate.inflate_prefix(packed, compression, size)
    assert len(data) <= size
    assert fault or len(data) == size
    try:
        assert len(inflate.inflate(packed, compression, size)) == size
    except ValueError as error:
        assert str(error)


@given(st.lists(st.binary(max_size=300), max_size=30), st.data())
def test_a_cut_frame_gives_a_prefix_that_grows_with_it(parts: list[bytes], data: Any) -> None:
    content = b"".join(part * 40 for part in parts)
    packed = lz4.frame.compress(content, store_size=False, block_linked=data.draw(st.booleans()))
    before = -1
    for end in sorted(data.draw(st.lists(st.integers(0, len(packed)), max_size=8))):
        found = inflate.inflate_prefix(packed[:end], "lz4", len(content)).data
        assert content.startswith(found)
        assert len(found) >= before
        before = len(found)


# --- records ----------------------------------------------------------------------------------------------------------


def chunk_that_claims(size: int, packed: bytes, compression: str = "zstd") -> bytes:
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 10, size, 1, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", Opcode.CHUNK, len(body)) + body


def unindexed(path: Path, *records: bytes) -> Path:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    begin = stream.getvalue()
    end = struct.pack("<BQI", Opcode.DATA_END, 4, 0) + struct.pack("<BQQQI", Opcode.FOOTER, 20, 0, 0, 0) + begin[:8]
    path.write_bytes(begin + b"".join(records) + end)
    return path


def test_a_chunk_that_claims_terabytes_is_refused_in_words(tmp_path: Path) -> None:
    path = unindexed(tmp_path / "run.mcap", chunk_that_claims(1 << 42, zstandard.compress(b"x")))
    with pytest.raises(LogError, match=r"claims more than any recorder writes(.|\n)*VILP_MAX_CHUNK_BYTES"):
        open_log(path)
    with holding_less_than(MOST), pytest.raises(LogError):
        salvage_log(path, tmp_path / "out.mcap")


def test_a_chunk_that_inflates_to_far_more_than_its_wrong_size_costs_salvage_little(tmp_path: Path) -> None:
    """Its size may be what is damaged, so a larger one is tried; 10 kB are not believed to have been 256 MB."""
    record, path = chunk_that_claims(100, bomb(256 << 20)), tmp_path / "run.mcap"
    assert len(record) < 50_000
    write_mcap(path)
    content = path.read_bytes()
    begin = 17 + struct.unpack_from("<Q", content, 9)[0]
    path.write_bytes(content[:begin] + record + content[begin:])
    with holding_less_than(100 << 20):
        salvage_log(path, tmp_path / "out.mcap")
    with open_log(tmp_path / "out.mcap") as log:
        assert sum(topic.message_count or 0 for topic in log.topics()) > 100


def test_a_damaged_size_of_a_large_chunk_is_still_made_good(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, n=300, extras=False, compression=CompressionType.ZSTD, chunk_size=1 << 30)
    content = bytearray(path.read_bytes())
    begin = 17 + struct.unpack_from("<Q", content, 9)[0]
    assert content[begin] == Opcode.CHUNK
    content[begin + 25 : begin + 33] = struct.pack("<Q", 5000)
    found, report = salvaged(path, bytes(content))
    assert found == sent
    assert report is not None
    assert (report.complete, report.whole) == (True, False)


def test_a_channel_that_is_described_anew_without_end_is_refused_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each description gives one id another meaning, and a message of it follows: there are 65,535 ids."""

    def record(opcode: int, body: bytes) -> bytes:
        return struct.pack("<BQ", opcode, len(body)) + body

    def channel(number: int) -> bytes:
        topic = b"/t%d" % number
        body = struct.pack("<HHI", 1, 0, len(topic)) + topic + struct.pack("<I", 4) + b"json" + struct.pack("<I", 0)
        return record(Opcode.CHANNEL, body) + record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, number, 0) + b"{}")

    path = unindexed(tmp_path / "run.mcap", *(channel(number) for number in range(200)))
    assert salvage_log(path, tmp_path / "out.mcap").recovered == 200
    monkeypatch.setattr(mcap_clean, "HIGHEST_ID", 100)
    with pytest.raises(LogError, match="more channels"):
        salvage_log(path, tmp_path / "out.mcap", force=True)


def test_a_record_above_the_limit_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "RECORD_BYTES", 1000)
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start()
        writer.add_message(writer.register_channel("/t", "json", 0), 1, b'"' + b"x" * 5000 + b'"', 1)
        writer.finish()
    with pytest.raises(LogError, match="VILP_MAX_RECORD_BYTES"):
        open_log(path)


def test_a_chunk_whose_checksum_is_right_and_whose_size_is_wrong_is_refused(tmp_path: Path) -> None:
    data = b"\x05" + struct.pack("<Q", 22) + bytes(22)
    packed = zstandard.compress(data + bytes(100_000))
    body = (
        struct.pack("<QQQII", 0, 0, len(data), zlib.crc32(data), 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    )
    path = unindexed(tmp_path / "run.mcap", struct.pack("<BQ", Opcode.CHUNK, len(body)) + body)
    with pytest.raises(LogError, match="where the header says"):
        open_log(path)


# --- messages ---------------------------------------------------------------------------------------------------------


def log_of(path: Path, encoding: str, schema: tuple[str, str, bytes], data: bytes) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4)
        writer.start()
        writer.add_message(writer.register_channel("/t", encoding, writer.register_schema(*schema)), 1, data, 1)
        writer.finish()
    return path


def first(path: Path) -> Any:
    with open_log(path) as log:
        return next(iter(log.messages(["/t"])))


HOSTILE = {
    "deep json": ("json", ("s", "jsonschema", b"{}"), b"[" * 100_000 + b"]" * 100_000),
    "json below the recursion limit": ("json", ("s", "jsonschema", b"{}"), b"[" * 400 + b"]" * 400),
    "endless sequence": (
        "cdr", ("a/msg/B", "ros2msg", b"float64[] x\n"), b"\0\1\0\0" + struct.pack("<I", 0xFFFFFFFF) + bytes(8)
    ),
    "endless strings": (
        "cdr", ("a/msg/B", "ros2msg", b"string[] x\n"), b"\0\1\0\0" + struct.pack("<I", 0xFFFFFFFF) + bytes(8)
    ),
    "endless nothing": (
        "ros1", ("a/B", "ros1msg", b"a/E[] x\n" + b"=" * 80 + b"\nMSG: a/E\n"), struct.pack("<I", 0xFFFFFFFF)
    ),
    "a type in itself": ("cdr", ("a/msg/B", "ros2msg", b"a/B b\n"), b"\0\1\0\0" + bytes(8)),
    "a billion fields": ("cdr", ("a/msg/B", "ros2msg", b"string[1000000000] a\n"), b"\0\1\0\0" + bytes(8)),
    "types nested deep": (
        "cdr",
        ("a/msg/T0", "ros2msg", b"".join(
            (b"=" * 80 + b"\nMSG: a/T%d\n" % i if i else b"") + b"a/T%d x\n" % (i + 1) for i in range(500)
        ) + b"=" * 80 + b"\nMSG: a/T500\nint8 x\n"),
        b"\0\1\0\0" + bytes(8),
    ),
    "no descriptor": ("protobuf", ("a.B", "protobuf", b"\xff" * 40), b""),
    "a long definition": ("cdr", ("a/msg/B", "ros2msg", b"#" * (9 << 20)), b""),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_message_or_definition_is_an_error_in_words(tmp_path: Path, case: str) -> None:
    encoding, schema, data = HOSTILE[case]
    path = log_of(tmp_path / "run.mcap", encoding, schema, data)
    with holding_less_than(MOST), pytest.raises(VilpDataError) as caught:
        first(path)
    assert caught.value.remedy


def test_json_as_deep_as_messages_are_is_read(tmp_path: Path) -> None:
    data = json.dumps([[[{"[[[": "]"}]]] * 50).encode()
    assert first(log_of(tmp_path / "run.mcap", "json", ("s", "jsonschema", b"{}"), data)).body == json.loads(data)


def png_that_claims(width: int, height: int) -> bytes:
    def part(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(bytes(1000))) + part(b"IEND", b"")


def test_an_image_that_claims_gigapixels_is_refused_before_it_is_decoded() -> None:
    from vilp_data.decode import decode_image
    from vilp_data.types import Message

    body = {"data": png_that_claims(20_000, 20_000), "format": "png"}
    with holding_less_than(MOST), pytest.raises(VilpDataError, match=r"(?i)pixel|larger|claims"):
        decode_image(Message("/t", "sensor_msgs/msg/CompressedImage", 1, 1, body))


def test_a_png_whose_part_claims_more_than_the_file_is_not_whole() -> None:
    """A decoder would allocate what the part claims."""
    from vilp_data.decode.image_file import image_file

    whole = bytearray(png_that_claims(10, 10))
    found = image_file(bytes(whole))
    assert found is not None
    assert found.whole
    struct.pack_into(">I", whole, whole.index(b"IDAT") - 4, 1 << 30)
    found = image_file(bytes(whole))
    assert found is not None
    assert not found.whole
