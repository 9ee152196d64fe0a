"""LeRobot v3 exports: times, tables and videos as the format wants them, and pictures as near as they are said to be."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.export_datasets import HEIGHT, SPEC, WIDTH, demonstration, plain_dataset, shown, write
from tests.synthetic import card_frame, psnr
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import StoreError, UsageError
from vilp_data.export import export_dataset, lerobot
from vilp_data.export.lerobot_stats import image_stats, pixel_counts, vector_stats
from vilp_data.export.video import CODINGS, VideoWriter, frame_rate, read_video
from vilp_data.ingest import ingest_logs
from vilp_data.sources import open_log
from vilp_data.sources.lerobot_log import LeRobotLog
from vilp_data.task_toml import task_from_dict

FRONT = "videos/observation.images.front/chunk-000/file-000.mp4"


def table_of(folder: Path) -> dict[str, list[Any]]:
    return pq.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()


def episodes_of(folder: Path) -> list[dict[str, Any]]:
    return pq.read_table(folder / lerobot.EPISODES_PATH).to_pylist()


def test_row_k_is_at_k_over_fps_and_so_is_its_frame(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "out", "lerobot")
    table = table_of(tmp_path / "out")
    assert table["timestamp"] == [np.float32(k / 10) for n in (14, 9, 11) for k in range(n)]
    assert table["episode_index"] == [0] * 14 + [1] * 9 + [2] * 11
    assert table["index"] == list(range(34))
    assert [k for k, done in enumerate(table["next.done"]) if done] == [13, 22, 33]
    with av.open(str(tmp_path / "out" / FRONT)) as container:
        times = [frame.pts * frame.time_base for frame in container.decode(video=0)]
    assert times == [Fraction(k, 10) for k in range(34)]
    starts = [row["videos/observation.images.front/from_timestamp"] for row in episodes_of(tmp_path / "out")]
    assert starts == [0.0, 1.4, 2.3]


def test_an_episode_begins_with_a_frame_that_can_be_decoded_alone(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "out", "lerobot")
    with av.open(str(tmp_path / "out" / FRONT)) as container:
        keys = {number for number, packet in enumerate(container.demux(video=0)) if packet.is_keyframe}
    assert {0, 14, 23} <= keys
    assert max(np.diff(sorted({*keys, 34}))) <= 10


def test_the_colour_card_comes_back_as_near_as_reported(tmp_path: Path) -> None:
    one = demonstration("card", 30)
    write(tmp_path / "data", one)
    reported = {}
    for images in ("h264", "h264-420", "lossless"):
        report = export_dataset(tmp_path / "data", tmp_path / images, "lerobot", images=images)  # type: ignore[arg-type]
        view = report.views["front"]
        frames = np.stack(list(read_video(tmp_path / images / FRONT, Fraction(10))))
        if images == "lossless":
            assert np.array_equal(frames, shown(one, "front"))
            assert view.psnr_db is None
            continue
        reported[images] = view.psnr_db
        assert view.psnr_db == pytest.approx(psnr(frames, shown(one, "front")), abs=0.01)
        worst = min(psnr(a, b) for a, b in zip(frames, shown(one, "front"), strict=True))
        assert view.psnr_min_db == pytest.approx(worst, abs=0.01)
    assert reported["h264"] > 40
    assert reported["h264"] > reported["h264-420"] + 3  # chroma at half size is what costs


def test_what_the_tables_say_of_an_episode(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "out", "lerobot")
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 10, 34)
    assert info["splits"] == {"train": "0:2", "val": "2:3"}
    assert info["features"]["observation.state"]["names"] == ["arm.0", "arm.1", "arm.2", "gripper.0"]
    assert info["features"]["action"]["names"] == ["target.x", "target.y"]
    first, second, third = episodes_of(tmp_path / "out")
    assert first["tasks"] == ["pick it up"]
    assert second["tasks"] == third["tasks"] == ["handover"]
    assert json.loads(first["vilp/tags"]) == {"operator": "ann", "task": "pick it up"}
    assert [row["vilp/outcome"] for row in (first, second, third)] == ["success", "unknown", "success"]
    tasks = pq.read_table(tmp_path / "out/meta/tasks.parquet").to_pydict()
    assert tasks == {"task_index": [0, 1], "task": ["pick it up", "handover"]}


def test_statistics_are_of_the_training_side_alone(tmp_path: Path) -> None:
    episodes = plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "out", "lerobot")
    stats = json.loads((tmp_path / "out/meta/stats.json").read_text())
    training = np.concatenate([one.action for one in episodes[:2] if one.action is not None]).astype(np.float64)
    assert stats["action"]["mean"] == pytest.approx(training.mean(axis=0).tolist())
    assert stats["action"]["count"] == [23]
    pixels = np.concatenate([shown(one, "front") for one in episodes[:2]]) / 255
    assert np.ravel(stats["observation.images.front"]["mean"]) == pytest.approx(pixels.mean(axis=(0, 1, 2)))


def test_image_statistics_from_counts_are_exact() -> None:
    images = np.random.default_rng(0).integers(3, 250, (5, 7, 9, 3), dtype=np.uint8)
    stats, scaled = image_stats(pixel_counts(images), 5), images.reshape(-1, 3) / 255
    for name, expected in (
        ("mean", scaled.mean(0)),
        ("std", scaled.std(0)),
        ("min", scaled.min(0)),
        ("max", scaled.max(0)),
    ):
        assert np.ravel(stats[name]) == pytest.approx(expected)
    assert np.ravel(stats["q50"]) == pytest.approx(np.quantile(scaled, 0.5, axis=0, method="inverted_cdf"))
    assert np.shape(stats["mean"]) == (3, 1, 1)


def test_vector_statistics_leave_unknown_rows_out() -> None:
    stats = vector_stats(np.array([[1, 2], [np.nan, 9], [3, 4]], np.float32))
    assert (stats["mean"], stats["count"]) == ([2, 3], [2])
    assert vector_stats(np.full((2, 2), np.nan)) == {}


def test_files_are_begun_anew_at_their_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain_dataset(tmp_path / "data")
    monkeypatch.setattr(lerobot, "DATA_FILE_MB", 0)
    monkeypatch.setattr(lerobot, "VIDEO_FILE_MB", 0)
    monkeypatch.setattr(lerobot, "CHUNK_FILES", 2)
    export_dataset(tmp_path / "data", tmp_path / "out", "lerobot")
    files = sorted(
        str(path.relative_to(tmp_path / "out" / "data")) for path in (tmp_path / "out/data").rglob("*.parquet")
    )
    assert files == ["chunk-000/file-000.parquet", "chunk-000/file-001.parquet", "chunk-001/file-000.parquet"]
    last = episodes_of(tmp_path / "out")[-1]
    assert (last["data/chunk_index"], last["data/file_index"], last["dataset_from_index"]) == (1, 0, 23)
    assert (tmp_path / "out" / "data/chunk-001/file-000.parquet").is_file()


@pytest.mark.parametrize("rate_hz", [10.0, 30000 / 1001, 12.5])
def test_our_own_reader_finds_the_same_steps_in_every_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate_hz: float
) -> None:
    """Several files of each kind, a rate that is no whole number: the reader knows nothing of the writer, and ingests what was stored."""
    ticks = [np.round(np.arange(n) * 1e9 / rate_hz).astype(np.int64) for n in (14, 9, 11)]
    episodes = [
        replace(demonstration(name, len(times)), rate_hz=rate_hz, log_time_ns=times)
        for name, times in zip(("pick", "place", "put"), ticks, strict=True)
    ]
    write(tmp_path / "data", *episodes, spec={**SPEC, "rate_hz": rate_hz})
    monkeypatch.setattr(lerobot, "VIDEO_FILE_MB", 0)
    monkeypatch.setattr(lerobot, "DATA_FILE_MB", 0)
    export_dataset(tmp_path / "data", tmp_path / "out", "lerobot", images="lossless")
    assert len(list((tmp_path / "out/videos").rglob("*.mp4"))) == 6
    with open_log(tmp_path / "out") as log:
        assert isinstance(log, LeRobotLog)
        assert len(log.episodes()) == 3
    table = {
        "name": "again", "rate_hz": rate_hz,
        "views": {v: {**t, "clock": "log", "topic": f"observation.images.{v}"} for v, t in SPEC["views"].items()},
        "low_dim": {"state": {"topic": "observation.state", "clock": "log"}},
        "action": {"target": {"topic": "action", "clock": "log"}},
    }  # fmt: skip
    report = ingest_logs([tmp_path / "out"], tmp_path / "again", task_from_dict(table, where="test"), workers=1)
    assert not report.failed
    store = EpisodeStore(tmp_path / "again")
    for before, entry in zip(episodes, store.index(), strict=True):
        after = store.read(entry.id)
        assert np.abs(np.diff(after.log_time_ns) - np.diff(before.log_time_ns)).max() <= 1
        assert np.array_equal(after.low_dim, before.low_dim)
        assert np.array_equal(after.action, before.action)
        for view in SPEC["views"]:
            assert np.array_equal(shown(after, view), shown(before, view))


def test_frames_that_slipped_by_one_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "data", demonstration("slip", 20))
    honest = VideoWriter.append

    def slipping(writer: VideoWriter, images: Any) -> None:
        frames = list(images)
        honest(writer, [frames[0], *frames[:-1]])

    monkeypatch.setattr(VideoWriter, "append", slipping)
    with pytest.raises(StoreError, match="nearer to their neighbours"):
        export_dataset(tmp_path / "data", tmp_path / "out", "lerobot")
    assert not (tmp_path / "out").exists()


def test_a_depth_view_is_never_coded_with_loss(tmp_path: Path) -> None:
    one = demonstration("deep", 8)
    frames = {**one.frames, "side": one.frames["side"][..., :1]}
    depth = {"unit": "mm", "near_m": 0.2, "far_m": 1.5}
    side = {**SPEC["views"]["side"], "depth": depth}
    write(tmp_path / "data", replace(one, frames=frames), spec={**SPEC, "views": {**SPEC["views"], "side": side}})
    report = export_dataset(tmp_path / "data", tmp_path / "out", "lerobot")
    assert report.views["side"].psnr_db is None
    path = tmp_path / "out" / FRONT.replace("front", "side")
    for channel in range(3):
        decoded = np.stack(list(read_video(path, Fraction(10))))[..., channel : channel + 1]
        assert np.array_equal(decoded, frames["side"][one.source_index["side"]])
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["features"]["observation.images.side"]["info"]["video.is_depth_map"] is True


def test_one_number_is_no_list_and_a_state_keeps_its_precision(tmp_path: Path) -> None:
    one = demonstration("state", 6, state=5)
    write(tmp_path / "data", one)
    export_dataset(tmp_path / "data", tmp_path / "out", "lerobot")
    assert one.state is not None
    assert np.array_equal(np.array(table_of(tmp_path / "out")["sim_state"]), one.state)


def test_an_odd_size_is_kept_in_444_and_refused_in_420(tmp_path: Path) -> None:
    frames = np.stack([card_frame(i, 25, 33) for i in range(4)])
    for name in ("h264", "lossless"):
        writer = VideoWriter(tmp_path / f"{name}.mp4", height=25, width=33, fps=Fraction(10), coding=CODINGS[name])
        writer.append(frames)
        writer.close()
        assert np.stack(list(read_video(tmp_path / f"{name}.mp4", Fraction(10)))).shape == frames.shape
    with pytest.raises(UsageError, match="even"):
        VideoWriter(tmp_path / "x.mp4", height=25, width=33, fps=Fraction(10), coding=CODINGS["h264-420"])


def test_rates_are_the_fractions_that_cameras_have() -> None:
    assert frame_rate(10.0) == 10
    assert frame_rate(29.97002997) == Fraction(30000, 1001)
    assert frame_rate(12.5) == Fraction(25, 2)
    assert float(frame_rate(14.98731)) == pytest.approx(14.98731, rel=1e-6)


def test_frames_are_the_size_of_the_view(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "out", "lerobot", images="png")
    feature = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]["observation.images.side"]
    assert (feature["dtype"], feature["shape"]) == ("image", [HEIGHT, WIDTH, 3])
    assert not (tmp_path / "out" / "videos").exists()
