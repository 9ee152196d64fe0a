"""Zarr stores in the diffusion-policy layout: rows become timed messages, each chunk read once."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import zarr

from tests.real_data import real_data
from tests.synthetic import SyntheticZarr, write_zarr
from vilp_data import limits
from vilp_data.decode import decode_image, decode_vector
from vilp_data.errors import LogError, UsageError
from vilp_data.sources import open_log
from vilp_data.sources.zarr_chunks import inflated_bytes


@pytest.fixture
def store(tmp_path: Path) -> SyntheticZarr:
    return write_zarr(tmp_path / "demonstrations.zarr", episode_lengths=(12, 9, 5))


def test_arrays_are_topics_and_episode_ends_are_episodes(store: SyntheticZarr) -> None:
    with open_log(store.path, array_rate_hz=20.0) as log:
        assert [(t.name, t.schema, t.encoding, t.message_count) for t in log.topics()] == [
            (name, "array", "array", 26) for name in ("action", "img", "state")
        ]
        spans = [(e.name, e.start_ns, e.end_ns) for e in log.episodes()]
    assert spans == [
        ("episode_000", 0, 600_000_000),
        ("episode_001", 600_000_000, 1_050_000_000),
        ("episode_002", 1_050_000_000, 1_300_000_000),
    ]


@pytest.mark.parametrize("rate_hz", [10.0, 30.0, 59.94])
def test_episodes_hold_exactly_their_rows_at_any_rate(store: SyntheticZarr, rate_hz: float) -> None:
    with open_log(store.path, array_rate_hz=rate_hz) as log:
        begin = 0
        for episode, end in zip(log.episodes(), store.episode_ends.tolist(), strict=True):
            rows = list(log.messages(["state"], start_ns=episode.start_ns, end_ns=episode.end_ns))
            assert [m.body[0] for m in rows] == list(range(begin, end))
            assert [m.log_time_ns for m in rows] == [round(i * 1e9 / rate_hz) for i in range(begin, end)]
            begin = end


def test_rows_of_several_arrays_come_in_order_of_time_and_decode_exactly(store: SyntheticZarr) -> None:
    with open_log(store.path) as log:
        messages = list(log.messages(["state", "img", "action"]))
    assert [m.topic for m in messages[:4]] == ["action", "img", "state", "action"]
    assert np.array_equal(np.stack([decode_image(m) for m in messages if m.topic == "img"]), store.img)
    assert np.array_equal(
        np.stack([decode_vector(m, ["[0:2]"]) for m in messages if m.topic == "state"]), np.float32(store.state[:, :2])
    )


def test_each_chunk_is_read_once_over_neighbouring_episodes(
    store: SyntheticZarr, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads: list[slice] = []
    original = zarr.Array.__getitem__

    def counted(self: zarr.Array, rows: slice) -> object:
        reads.append(rows)
        return original(self, rows)

    with open_log(store.path) as log:
        monkeypatch.setattr(zarr.Array, "__getitem__", counted)
        for episode in log.episodes():
            list(log.messages(["img"], start_ns=episode.start_ns, end_ns=episode.end_ns))
    assert [rows.start for rows in reads] == [0, 7, 14, 21]


def test_hash_depends_on_contents_and_names_but_not_on_the_place(store: SyntheticZarr, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(store.path, tmp_path / "copy.zarr"))
    with open_log(store.path) as one, open_log(copy) as other:
        assert one.sha256() == other.sha256()
    (copy / "data" / "state" / "0.0").rename(copy / "data" / "state" / "moved")
    with open_log(store.path) as one, open_log(copy) as other:
        assert one.sha256() != other.sha256()


def test_an_unknown_array_is_refused_with_the_nearest_one(store: SyntheticZarr) -> None:
    with open_log(store.path) as log, pytest.raises(LogError, match="did you mean 'state'"):
        log.messages(["stat"])


def test_a_missing_chunk_is_refused_instead_of_read_as_zeros(store: SyntheticZarr) -> None:
    (store.path / "data" / "action" / "1.0").unlink()
    with open_log(store.path) as log:
        assert len(list(log.messages(["state"]))) == 26
        with pytest.raises(LogError, match=r"data/action lacks its chunk 1\.0"):
            list(log.messages(["action"]))


@pytest.mark.parametrize("size", [0, 1, 15, 40])
def test_a_cut_off_chunk_is_refused(store: SyntheticZarr, size: int) -> None:
    chunk = store.path / "data" / "img" / "2.0.0.0"
    chunk.write_bytes(chunk.read_bytes()[:size])
    with open_log(store.path) as log, pytest.raises(LogError, match="chunk 2 of data/img cannot be read"):
        list(log.messages(["img"]))


@pytest.mark.parametrize("missing", ["data", "meta/episode_ends"])
def test_a_store_of_another_layout_is_refused(store: SyntheticZarr, missing: str) -> None:
    shutil.rmtree(store.path / missing)
    with pytest.raises(LogError, match="diffusion-policy layout"):
        open_log(store.path)


def test_arrays_shorter_than_the_episodes_are_refused(store: SyntheticZarr) -> None:
    shutil.rmtree(store.path / "meta" / "episode_ends")
    zarr.open_group(store.path / "meta", mode="a").create_array("episode_ends", data=np.array([12, 40]))
    with pytest.raises(LogError, match="shorter than its episodes"):
        open_log(store.path)


def test_damaged_array_metadata_is_refused(store: SyntheticZarr) -> None:
    (store.path / "data" / "img" / ".zarray").write_text('{"chunks": [')
    with pytest.raises(LogError, match="cannot be opened"):
        open_log(store.path)


def store_of(path: Path, array: np.ndarray, ends: list[int], **options: Any) -> Path:
    """A zarr v3 store of one array, data/action."""
    root = zarr.open_group(path, mode="w")
    root.create_group("data").create_array("action", data=array, **options)
    root.create_group("meta").create_array("episode_ends", data=np.array(ends))
    return path


def test_a_sharded_store_is_read_and_its_missing_shard_named(tmp_path: Path) -> None:
    rows = np.arange(1, 25, dtype=np.float32).reshape(12, 2)
    path = store_of(tmp_path / "sharded.zarr", rows, [5, 12], chunks=(2, 2), shards=(4, 2))
    with open_log(path) as log:
        assert np.array_equal([message.body for message in log.messages(["action"])], rows)
    (path / "data" / "action" / "c" / "2" / "0").unlink()
    with open_log(path) as log, pytest.raises(LogError, match="lacks its chunk c/2/0"):
        list(log.messages(["action"]))


def test_rows_behind_the_last_episode_are_doubted(store: SyntheticZarr) -> None:
    with open_log(store.path) as log:
        assert log.doubts() == []
    root = zarr.open_group(store.path, mode="r+")
    root["meta/episode_ends"].resize((2,))  # as a writer that crashed leaves it
    with open_log(store.path) as log:
        assert len(log.episodes()) == 2
        assert [
            f"data/{name} has 5 rows in no demonstration" in log.doubts()[k]
            for k, name in enumerate(("action", "img", "state"))
        ]


def test_an_array_whose_metadata_is_damaged_is_doubted(store: SyntheticZarr) -> None:
    metadata = store.path / "data" / "img" / ".zarray"
    metadata.write_text(metadata.read_text().replace('"dtype"', '"type"'))
    with open_log(store.path) as log:
        assert [topic.name for topic in log.topics()] == ["action", "state"]
        assert "data/img is read as no array" in log.doubts()[0]


CODECS = {
    "zstd": zarr.codecs.ZstdCodec(), "gzip": zarr.codecs.GzipCodec(), "blosc": zarr.codecs.BloscCodec(),
}  # fmt: skip


@pytest.mark.parametrize("codec", CODECS)
def test_a_chunk_that_is_small_in_words_and_large_in_bytes_is_refused_before_it_is_inflated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codec: str
) -> None:
    monkeypatch.setattr(limits, "ARRAY_CHUNK_BYTES", 100_000)
    wide = store_of(tmp_path / "wide.zarr", np.ones((1, 5_000_000), np.uint8), [1], compressors=CODECS[codec])
    with open_log(wide) as log, pytest.raises(LogError, match="VILP_MAX_ARRAY_CHUNK_BYTES"):
        log.first_messages("action", 1)
    fair = np.random.default_rng(0).integers(0, 255, (100, 100)).astype(np.uint8)
    path = store_of(tmp_path / "small.zarr", fair, [100], compressors=CODECS[codec], chunks=(100, 100))
    with open_log(path) as log:
        assert np.array_equal([message.body for message in log.messages(["action"])], fair)
    (bomb,) = (file for file in (wide / "data" / "action" / "c").rglob("*") if file.is_file() and file.name == "0")
    (path / "data" / "action" / "c" / "0" / "0").write_bytes(bomb.read_bytes())
    with open_log(path) as log, pytest.raises(LogError, match="VILP_MAX_ARRAY_CHUNK_BYTES"):
        log.first_messages("action", 1)


@pytest.mark.parametrize("name", ["gzip", "bz2", "lzma", "zlib", "lz4", "zstd", "blosc", ""])
def test_what_a_chunk_inflates_to_is_told_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(limits, "ARRAY_CHUNK_BYTES", 50_000)
    codec = numcodecs.get_codec({"id": name}) if name else None
    path = tmp_path / "array"
    array = zarr.create_array(path, data=np.ones(40_000, np.uint8), chunks=(40_000,), zarr_format=2, compressors=codec)
    assert inflated_bytes(array, path / "0") <= 40_000
    array = zarr.create_array(path, data=np.ones(9_000_000, np.uint8), chunks=(9_000_000,), zarr_format=2,
                              compressors=codec, overwrite=True)  # fmt: skip
    assert inflated_bytes(array, path / "0") > 50_000
    assert (path / "0").stat().st_size < 50_000 or not name


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, 1e-300, 1e12, float("nan"), float("inf")])
def test_a_rate_that_rows_cannot_have_is_wrong_use(store: SyntheticZarr, rate_hz: float) -> None:
    with pytest.raises(UsageError, match="array_rate_hz"):
        open_log(store.path, array_rate_hz=rate_hz)


def test_human_pusht_store_has_206_episodes_of_0_to_255_images() -> None:
    with open_log(real_data("pusht/pusht_cchi_v7_replay.zarr")) as log:
        episodes = log.episodes()
        assert len(episodes) == 206
        assert log.topics()[0].message_count == 25_650
        second = list(
            log.messages(["img", "state"], start_ns=episodes[1].start_ns, end_ns=episodes[1].start_ns + 10**9)
        )
        frames = [decode_image(m) for m in second if m.topic == "img"]
    assert len(frames) == 10
    assert frames[0].shape == (96, 96, 3)
    assert frames[0].max() == 255
