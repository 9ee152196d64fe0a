"""Salvage of MCAP files: every whole message comes back, none is invented, and what was lost is said."""

from __future__ import annotations

import io
import random
import struct
import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from tests.damage import LAYOUTS, cuts, invented, mutated, read_log, salvaged, write_log
from tests.real_data import real_data
from tests.synthetic import task_spec, write_mcap
from vilp_data.errors import LogError, UsageError
from vilp_data.ingest import ingest_logs
from vilp_data.log_summary import summarise
from vilp_data.salvage import SALVAGE_RECORD, salvage_log
from vilp_data.salvage_report import format_report
from vilp_data.sources import line_endings, open_log
from vilp_data.sources.file_bytes import FileBytes

DEFAULT_STEPS, ALL_STEPS = 12, 100
STEPS = [pytest.param(DEFAULT_STEPS, id="some"), pytest.param(ALL_STEPS, id="every percent", marks=pytest.mark.slow)]


def library_count(path: Path) -> int:
    """Messages that the mcap library's stream reader gets out before it gives up."""
    count = 0
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream).records:
                count += type(record).__name__ == "Message"
    except Exception:
        return count
    return count


def inflatable(content: bytes) -> int:
    """Whole messages in a cut file, counted by walking it and inflating its last chunk as far as the libraries do."""
    count, position = 0, 8
    while position + 9 <= len(content):
        opcode, length = struct.unpack_from("<BQ", content, position)
        body = content[position + 9 : position + 9 + length]
        if opcode == Opcode.MESSAGE:
            count += len(body) == length
        if opcode == Opcode.CHUNK and len(body) >= 32:
            (name_length,) = struct.unpack_from("<I", body, 28)
            name, packed = body[32 : 32 + name_length], body[40 + name_length :]
            if name == b"zstd":
                data = zstandard.ZstdDecompressor().decompressobj().decompress(packed)
            else:
                data = lz4.frame.LZ4FrameDecompressor().decompress(packed) if name == b"lz4" else packed
            inner = 0
            while inner + 9 <= len(data):
                kind, size = struct.unpack_from("<BQ", data, inner)
                inner += 9 + size
                count += kind == Opcode.MESSAGE and inner <= len(data)
        position += 9 + length
    return count


# --- whole logs -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_whole_log_is_copied_byte_for_byte(tmp_path: Path, layout: str) -> None:
    write_log(tmp_path / "run.mcap", **LAYOUTS[layout])
    report = salvage_log(tmp_path / "run.mcap", tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == (tmp_path / "run.mcap").read_bytes()
    assert report.whole
    assert report.complete
    assert "is whole (150 messages)" in format_report(report)


# --- cut off ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_cut_log_gives_every_message_that_inflates_and_never_fewer_as_more_bytes_are_there(
    tmp_path: Path, layout: str, steps: int
) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, n=500, size=800, **LAYOUTS[layout])
    content, before = path.read_bytes(), 0
    for part in cuts(content, steps=steps):
        found, report = salvaged(tmp_path / "cut.mcap", part)
        assert found == sent[: len(found)]
        assert len(found) >= max(before, inflatable(part), library_count(tmp_path / "cut.mcap"))
        assert report is None or report.complete == (len(found) == len(sent) and report.ended)
        before = len(found)
    assert before == len(sent)


def test_a_log_cut_inside_its_only_chunk_gives_more_than_the_mcap_library_gets(tmp_path: Path) -> None:
    for layout in ("one lz4 chunk", "one zstd chunk"):
        path = tmp_path / "run.mcap"
        sent = write_log(path, n=1500, size=800, **LAYOUTS[layout])
        content = path.read_bytes()
        path.write_bytes(content[: len(content) * 7 // 10])
        found, _ = salvaged(path)
        assert library_count(path) == 0
        assert len(found) > len(sent) // 2


def test_what_is_cut_off_is_reported_as_unknown_and_the_exit_is_not_clean(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_log(path, **LAYOUTS["none"])
    _, report = salvaged(path, path.read_bytes()[:20_000])
    assert report is not None
    assert not report.complete
    assert report.lost is None
    text = format_report(report)
    assert "nothing tells" in text
    assert "no end" in text
    assert "cut off" in text
    assert report.as_dict()["topics"][0]["lost"] is None


def test_a_log_that_lacks_only_its_index_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, **LAYOUTS["zstd"])
    content = path.read_bytes()
    end = content.rindex(struct.pack("<BQ", Opcode.DATA_END, 4)) + 13
    found, report = salvaged(path, content[: end + 30])
    assert found == sent
    assert report is not None
    assert report.complete
    assert not report.whole
    assert report.lost == 0


def test_attachments_and_metadata_are_kept_and_a_cut_attachment_is_counted_as_lost(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_log(path, **LAYOUTS["none"])
    content = path.read_bytes()
    attachment = content.index(b"abcabc")
    _, report = salvaged(path, content[: attachment + 100])
    assert report is not None
    assert (report.attachments, report.attachments_lost) == (0, 1)
    _, report = salvaged(path, content[: attachment + 2000])
    assert report is not None
    assert (report.attachments, report.metadata_records) == (1, 1)
    with path.with_suffix(".salvaged").open("rb") as stream:
        reader = make_reader(stream)
        assert [a.data for a in reader.iter_attachments()] == [b"abc" * 300]
        assert {m.name: m.metadata for m in reader.iter_metadata()}["episode"] == {"success": "true"}


# --- damaged in between -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rounds", [pytest.param(25, id="some"), pytest.param(1500, id="many", marks=pytest.mark.slow)])
@pytest.mark.parametrize("layout", ["none", "lz4", "zstd", "unchunked"])
def test_no_message_is_invented_and_none_is_lost_in_silence(tmp_path: Path, layout: str, rounds: int) -> None:
    """Whatever happens to the bytes: a message that was not sent as it is counts as suspicious or unverified."""
    path, rng = tmp_path / "run.mcap", random.Random(4)
    options = LAYOUTS[layout] | {"enable_data_crcs": layout == "unchunked"}
    sent = write_log(path, n=60, **options)
    content = path.read_bytes()
    for _ in range(rounds):
        found, report = salvaged(tmp_path / "damaged.mcap", mutated(content, rng))
        if report is None:
            continue
        assert invented(found, sent) <= report.suspicious + report.unverified
        assert not report.complete or Counter(found) == Counter(sent)
        with open_log(tmp_path / "damaged.salvaged") as log:
            assert sum(topic.message_count or 0 for topic in log.topics()) == len(found)


def test_a_chunk_that_fails_its_checksum_is_kept_and_counted_or_left_out(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, **LAYOUTS["none"])
    content = bytearray(path.read_bytes())
    content[content.index(sent[75].data) + 3] ^= 1
    found, report = salvaged(path, bytes(content))
    assert report is not None
    assert len(found) == len(sent)
    assert invented(found, sent) == 1
    assert 1 <= report.suspicious < len(sent) // 2
    assert report.lost == 0
    assert not report.complete
    kept, dropped = salvaged(path, drop_suspicious=True)
    assert dropped is not None
    assert invented(kept, sent) == 0
    assert len(kept) + dropped.suspicious_left_out == len(sent)
    assert "a checksum over them fails" in format_report(dropped)


def test_the_clean_log_says_what_in_it_is_suspicious(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, **LAYOUTS["none"])
    content = bytearray(path.read_bytes())
    content[content.index(sent[75].data) + 3] ^= 1
    _, report = salvaged(path, bytes(content))
    assert report is not None
    with open_log(path.with_suffix(".salvaged")) as log:
        said = log.metadata()[SALVAGE_RECORD]
    assert said["suspicious"] == str(report.suspicious)
    assert said["source"] == "run.mcap"


def test_behind_a_bad_record_reading_goes_on(tmp_path: Path) -> None:
    """A record's length is overwritten: what the index lists behind it comes back, and what is lost is counted."""
    for layout in ("none", "unchunked"):
        path = tmp_path / "run.mcap"
        sent = write_log(path, **LAYOUTS[layout])
        content = bytearray(path.read_bytes())
        head = content.index(sent[40].data) - 22 - 8
        content[head : head + 8] = struct.pack("<Q", 1 << 50)
        found, report = salvaged(path, bytes(content))
        assert report is not None
        assert found == sent[:40] + sent[41:]
        assert (report.lost, report.topics[sent[40].topic].lost) == (1, 1)


def test_a_lost_first_chunk_does_not_take_the_channels_with_it(tmp_path: Path) -> None:
    """Its writer describes channels there alone; the summary repeats them."""
    path = tmp_path / "run.mcap"
    sent = write_log(path, **LAYOUTS["zstd"])
    content = bytearray(path.read_bytes())
    first = content.index(b"\x28\xb5\x2f\xfd")
    content[first + 10 : first + 60] = bytes(50)
    found, report = salvaged(path, bytes(content))
    assert report is not None
    assert len(found) > len(sent) * 3 // 4
    assert invented(found, sent) == 0
    assert report.lost == len(sent) - len(found)


def test_messages_whose_channel_nothing_describes_are_left_out_and_said(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_log(path, repeat_channels=False, **LAYOUTS["zstd"])
    content = bytearray(path.read_bytes())
    first = content.index(b"\x28\xb5\x2f\xfd")
    content[first + 10 : first + 60] = bytes(50)
    out = tmp_path / "out.mcap"
    path.write_bytes(content)
    report = salvage_log(path, out)
    assert report.recovered == 0
    assert not report.complete
    assert "the record that says what they are is lost" in format_report(report)


def test_a_damaged_chunk_head_is_told_from_the_index(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, **LAYOUTS["lz4"])
    content = bytearray(path.read_bytes())
    chunks = [m for m in range(len(content)) if content[m : m + 3] == b"lz4"]
    head = chunks[2] - 4 - 37
    assert content[head] == Opcode.CHUNK
    content[head + 1 : head + 9] = b"\xff" * 8
    found, report = salvaged(path, bytes(content))
    assert Counter(found) == Counter(sent)
    assert report is not None
    assert report.lost == 0


@pytest.mark.parametrize("begin", [b"", b"\0" * 8, b"\x89MCAP1\r\n"])
def test_a_damaged_first_mark_loses_nothing(tmp_path: Path, begin: bytes) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, **LAYOUTS["zstd"])
    found, report = salvaged(path, begin + path.read_bytes()[8:])
    assert found == sent
    assert report is not None
    assert not report.whole
    assert "first mark" in format_report(report)


def test_a_log_inside_an_attachment_gives_no_messages_of_its_own(tmp_path: Path) -> None:
    """The attachment's own head is damaged, so the search for the next record passes through it."""
    inner = tmp_path / "inner.mcap"
    write_log(inner, extras=False, use_chunking=False)
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, chunk_size=500)
        writer.start()
        channels = [writer.register_channel(f"/outer{i}", "json", 0) for i in range(3)]
        for k in range(40):
            writer.add_message(channels[k % 3], k, b"{}" * 20, k)
            if k == 20:
                writer.add_attachment(1, 1, "inner.mcap", "application/x-mcap", inner.read_bytes())
        writer.finish()
    sent, content = read_log(path), bytearray(path.read_bytes())
    head = content.index(inner.read_bytes()) - 8 - 4 - 18 - 4 - 10 - 16 - 9
    assert content[head] == Opcode.ATTACHMENT
    for damage in (bytes([content[head], *b"\xff" * 8]), bytes(9)):
        content[head : head + 9] = damage
        found, report = salvaged(tmp_path / "damaged.mcap", bytes(content))
        assert Counter(found) == Counter(sent)
        assert report is not None
        assert report.attachments_lost == 1


def test_a_chunk_without_a_checksum_that_inflates_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, enable_crcs=False, index_types=IndexType.NONE, **LAYOUTS["lz4"])
    found, report = salvaged(path, path.read_bytes()[:-1])
    assert found == sent
    assert report is not None


def test_one_channel_id_with_two_meanings_becomes_two_channels(tmp_path: Path) -> None:
    """Two logs in one file, as `cat` leaves them."""
    path = tmp_path / "run.mcap"
    sent = write_log(path, n=20)
    other = tmp_path / "other.mcap"
    with other.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_message(writer.register_channel("/elsewhere", "json", 0), 5, b"{}", 5)
        writer.finish()
    found, report = salvaged(path, path.read_bytes() + other.read_bytes())
    assert Counter(found) == Counter(sent + read_log(other))
    assert report is not None
    assert "another log follows" in format_report(report)


def test_an_index_record_that_turns_into_a_message_is_not_taken_for_granted(tmp_path: Path) -> None:
    """One bit makes it so, and its bytes happen to be a message of a known channel: only the statistics know better."""
    path = tmp_path / "run.mcap"
    sent = write_log(path, **LAYOUTS["none"])
    content = bytearray(path.read_bytes())
    index, position = -1, 8
    while index < 0:
        opcode, length = struct.unpack_from("<BQ", content, position)
        index = position if opcode == Opcode.MESSAGE_INDEX else -1
        position += 9 + length
    content[index] = Opcode.MESSAGE
    found, report = salvaged(path, bytes(content))
    assert report is not None
    assert invented(found, sent) <= report.unverified
    assert not report.complete
    assert "statistics count" in format_report(report)


def test_a_time_that_no_clock_tells_is_refused_and_left_out(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, use_chunking=False)
    content = bytearray(path.read_bytes())
    place = content.index(sent[10].data) - 16
    content[place : place + 8] = b"\xff" * 8
    path.write_bytes(content)
    with pytest.raises(LogError, match="2262"):
        open_log(path)
    found, report = salvaged(path)
    assert found == sent[:10] + sent[11:]
    assert report is not None
    assert report.lost == 1


def test_a_chunk_whose_frame_lost_its_end_is_packed_anew(tmp_path: Path) -> None:
    """Its data are right, as the checksum says, but other readers refuse the frame."""
    path = tmp_path / "run.mcap"
    sent = write_log(path, extras=False, **LAYOUTS["one lz4 chunk"])
    content = bytearray(path.read_bytes())
    (length,) = struct.unpack_from("<Q", content, content.index(b"\x04\x22\x4d\x18") - 8)
    end = content.index(b"\x04\x22\x4d\x18") + length
    assert content[end - 4 : end] == bytes(4)
    content[end - 4] = 16
    found, report = salvaged(path, bytes(content))
    assert found == sent
    assert report is not None
    assert (report.complete, report.whole) == (True, False)


# --- line endings -----------------------------------------------------------------------------------------------------


def test_line_feeds_that_became_pairs_are_turned_back(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, **LAYOUTS["zstd"])
    found, report = salvaged(path, path.read_bytes().replace(b"\n", b"\r\n"))
    assert found == sent
    assert report is not None
    assert report.complete
    assert "turned back" in format_report(report)


@pytest.mark.parametrize("block", [1, 2, 7, 1 << 20])
def test_every_pair_is_turned_back_wherever_it_lies(
    tmp_path: Path, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(line_endings, "BLOCK", block)
    content = b"#ROSBAG V2.0\nab\n\n\rc\r\r\n\n"
    path = tmp_path / "run.bag"
    path.write_bytes(content.replace(b"\n", b"\r\n"))
    out = io.BytesIO()
    with FileBytes(path) as source:
        what = line_endings.restore(source, out)
    assert out.getvalue() == content
    assert "not converted" not in what


@pytest.mark.parametrize("layout", ["none", "lz4", "zstd"])
def test_pairs_that_became_line_feeds_are_found_again_where_a_checksum_tells(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "run.mcap"
    sent = write_log(path, n=60, extras=False, **LAYOUTS[layout])
    content = path.read_bytes()
    places = [place for place in range(200, len(content) - 900) if content[place : place + 1] == b"\n"]
    damaged = content.replace(b"\r\n", b"\n")
    assert len(places) > 5
    found, report = salvaged(path, damaged)
    assert report is not None
    assert "had become line feeds" in format_report(report)
    assert invented(found, sent) <= report.suspicious + report.unverified
    assert len(found) > len(sent) // 2


def test_the_real_log_that_a_transfer_mangled_comes_back_whole(tmp_path: Path) -> None:
    """Its own (damaged) statistics count 4,702 messages in one chunk; the chunk's checksum says that every byte is right."""
    path = real_data("logs/keelson/connectors_klog_bin_2024-05-15.mcap")
    report = salvage_log(path, tmp_path / "out.mcap")
    assert (report.recovered, report.suspicious, report.unverified) == (4702, 0, 0)
    assert len(read_log(tmp_path / "out.mcap")) == 4702
    assert report.complete
    assert "behind the last message, where a log keeps none" in format_report(report)


# --- use --------------------------------------------------------------------------------------------------------------


def test_what_comes_back_can_be_inspected_and_ingested(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", chunk_size=4000, n_frames=30, tags={"seed": "7"})
    content = log.path.read_bytes()
    log.path.write_bytes(content[: len(content) * 3 // 4])
    with pytest.raises(LogError, match="vilp-data salvage"):
        open_log(log.path)
    report = salvage_log(log.path, tmp_path / "clean.mcap")
    assert {t.name: t.n_messages for t in summarise(tmp_path / "clean.mcap").topics} == {
        name: topic.recovered for name, topic in report.topics.items()
    }
    result = ingest_logs([tmp_path / "clean.mcap"], tmp_path / "data", task_spec(log), workers=1)
    assert len(result.written) == 1


def test_nothing_is_overwritten_unless_asked(tmp_path: Path) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / "out.mcap"
    write_log(path, n=5)
    out.write_bytes(b"precious")
    with pytest.raises(UsageError, match="--force"):
        salvage_log(path, out)
    with pytest.raises(UsageError, match="the log itself"):
        salvage_log(path, path, force=True)
    assert out.read_bytes() == b"precious"
    salvage_log(path, out, force=True)
    assert len(read_log(out)) == 5


@pytest.mark.parametrize("content", [b"", b"not a log at all", bytes(5000), b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n"])
def test_where_nothing_can_be_recovered_nothing_is_written(tmp_path: Path, content: bytes) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / "out.mcap"
    path.write_bytes(content)
    out.write_bytes(b"precious")
    with pytest.raises(LogError):
        salvage_log(path, out, force=True)
    assert [p.name for p in tmp_path.iterdir() if p.name not in ("run.mcap", "out.mcap")] == []
    assert out.read_bytes() == b"precious"


def test_the_same_damage_gives_the_same_bytes(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_log(path, **LAYOUTS["lz4"])
    path.write_bytes(path.read_bytes()[:9000])
    outputs = []
    for name in ("a.mcap", "b.mcap"):
        salvage_log(path, tmp_path / name)
        outputs.append(zlib.crc32((tmp_path / name).read_bytes()))
    assert outputs[0] == outputs[1]


@pytest.mark.parametrize(
    "relative",
    [
        "logs/keelson/test.e50a33.mcap",
        "logs/keelson/test.mcap",
        "logs/lichtblick/e2e_fixtures_assets_custom-camera-model.mcap",
        "logs/rosbags_rs_testbags/tests/test_bags/test_bag_mcap/test_bag_mcap.mcap",
        "logs/rosbag2_tests/rosbag2_py/test/resources/mcap/wbag/wbag_0.mcap",
    ],
)
def test_whole_real_logs_are_told_to_be_whole(tmp_path: Path, relative: str) -> None:
    path = real_data(relative)
    report: Any = salvage_log(path, tmp_path / "out.mcap")
    assert report.whole, format_report(report)
    assert (tmp_path / "out.mcap").read_bytes() == path.read_bytes()
