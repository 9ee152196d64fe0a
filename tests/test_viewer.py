"""Logs and episodes drawn with Rerun: what goes in comes out, in every way of looking at it."""

from __future__ import annotations

import base64
import json
import os
import signal
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from mcap.writer import Writer
from rerun.chunk import Chunk, RrdReader

from tests.export_datasets import blind_dataset
from tests.lerobot_folders import write_v21
from tests.real_data import real_data
from tests.synthetic import (
    JOINTS,
    START_NS,
    card_frame,
    encode_image,
    joints_at,
    psnr,
    task_spec,
    write_mcap,
    write_zarr,
    zarr_task_spec,
)
from tests.video_logs import write_video
from tests.video_packets import GROUP, encode, number_of, numbered_frames
from vilp_data import shards, viewer
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.errors import LogError, StoreError, UsageError
from vilp_data.ingest import ingest_logs
from vilp_data.keys import FORMAT_VERSION
from vilp_data.latents import latents_path
from vilp_data.plots import panel_rank
from vilp_data.spec import TaskSpec
from vilp_data.types import F16, U8, Episode
from vilp_data.viewer import canvas as viewer_canvas
from vilp_data.viewer import process as viewer_process
from vilp_data.viewer import window as viewer_window

EPISODE = "one"
SAME_CARD_DB = 30.0  # JPEG at quality 95 stays above; a swapped channel, a flip and the next frame stay below


class ShiftEncoder:
    """A FrameEncoder whose reconstruction is 10 grey levels too bright: its PSNR is 20 log10(255 / 10) = 28.13 dB."""

    key = "shift"
    key_fields: dict[str, str] = {}  # noqa: RUF012
    trained_on: frozenset[str] = frozenset()

    def encode(self, frames: U8) -> F16:
        return frames.transpose(0, 3, 1, 2).astype(np.float16)

    def decode(self, latents: F16) -> U8:
        return (latents.transpose(0, 2, 3, 1) + 10).astype(np.uint8)

    def latent_shape(self, height: int, width: int) -> tuple[int, int, int]:
        return 3, height, width


def small_store(root: Path, *, n_steps: int = 12) -> tuple[EpisodeStore, ShiftEncoder]:
    """A dataset of one episode with two views, and latents of both."""
    views = {name: {"topic": f"/{name}", "height": 48, "width": 64} for name in ("front", "side")}
    spec = TaskSpec.model_validate(
        {
            "name": "small",
            "views": views,
            "low_dim": {"pose": {"topic": "/pose", "fields": ["position.x", "position.y"]}},
            "action": {
                "move": {"topic": "/act", "fields": ["linear.x", "linear.y"]},
                "grip": {"topic": "/grip", "fields": ["position[0:1]"]},
            },
        }
    )
    frames = {
        view: np.minimum(np.stack([card_frame(i + 3 * v) for i in range(n_steps)]), 245) for v, view in enumerate(views)
    }
    ticks = np.arange(n_steps)
    episode = Episode(
        id=EPISODE,
        frames=frames,
        source_index=dict.fromkeys(views, ticks.astype(np.int32)),
        log_time_ns=1_700_000_000_000_000_000 + ticks * 100_000_000,
        low_dim=np.stack([ticks, -ticks], 1).astype(np.float32),
        action=np.stack([ticks, 2 * ticks, np.sign(ticks - 5)], 1).astype(np.float32),
        state=None,
        valid=np.ones(n_steps, np.bool_),
        age_s={},
        rate_hz=10.0,
        tags={},
        outcome="success",
    )
    store, encoder = EpisodeStore(root), ShiftEncoder()
    store.write_spec(spec)
    store.write(episode, Origin("log.mcap", "0" * 64, EPISODE, "key", {}))
    entry = store.entry(EPISODE)
    for view in views:
        header = {"format": str(FORMAT_VERSION), "source_frames_sha256": entry.frames_sha256[view]}
        latents = encoder.encode(frames[view])
        shards.write_shard(latents_path(root, view, encoder.key, EPISODE), {"latents": latents}, header)
    return store, encoder


def chunks_of(rrd: Path, entity: str) -> list[Chunk]:
    """Everything but static data at an entity of an .rrd file."""
    return [chunk for chunk in RrdReader(rrd).stream() if chunk.entity_path == f"/{entity}" and not chunk.is_static]


def entities(rrd: Path) -> set[str]:
    return {chunk.entity_path.lstrip("/") for chunk in RrdReader(rrd).stream()}


def column(rrd: Path, entity: str, name: str) -> list[object]:
    """All values of one component at an entity, in order of time."""
    rows: list[tuple[object, object]] = []
    for chunk in chunks_of(rrd, entity):
        batch = chunk.to_record_batch()
        if name in batch.schema.names:
            times = batch.column(viewer_canvas.TIMELINE).cast("int64").to_pylist()
            rows += zip(times, batch.column(name).to_pylist(), strict=True)
    return [value for _, value in sorted(rows, key=lambda row: row[0])]


def series_names(rrd: Path, entity: str) -> list[str]:
    """The names of the series that are drawn at an entity."""
    for chunk in RrdReader(rrd).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if chunk.entity_path == f"/{entity}" and chunk.is_static and name.endswith(":names"):
                return [str(series) for series in batch.column(name).to_pylist()[0]]
    return []


def rows_of_panels(rrd: Path) -> list[int]:
    """How many panels each row of the layout has, from the top."""
    reader = RrdReader(rrd)
    [blueprint] = reader.blueprints()
    containers: dict[str, list[str]] = {}
    for chunk in reader.stream(store=blueprint):
        batch = chunk.to_record_batch()
        if "ContainerBlueprint:contents" in batch.schema.names:
            containers[chunk.entity_path.lstrip("/")] = batch.column("ContainerBlueprint:contents").to_pylist()[0]
    [rows] = [inside for inside in containers.values() if containers.keys() >= set(inside)]
    return [len(containers[row]) for row in rows]


def encoded_frames(rrd: Path, entity: str) -> list[U8]:
    """Recorded JPEG or PNG images read back as RGB."""
    blobs = [np.array(blob[0], np.uint8) for blob in column(rrd, entity, "EncodedImage:blob")]
    return [cv2.imdecode(blob, cv2.IMREAD_COLOR_RGB) for blob in blobs]


def raw_frames(rrd: Path, entity: str, height: int, width: int) -> list[U8]:
    return [np.array(row[0], np.uint8).reshape(height, width, 3) for row in column(rrd, entity, "Image:buffer")]


# --- colour -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("encoding", "codec"), [("cdr", "raw"), ("protobuf", "jpeg"), ("json", "png")])
def test_the_colour_card_goes_through_rerun_unchanged(tmp_path: Path, encoding: str, codec: str) -> None:
    log = write_mcap(tmp_path / "a.mcap", encoding=encoding, image_codec=codec)
    viewer.draw_log(log.path, tmp_path / "a.rrd")
    entity = "camera/front/image"
    read = (
        (raw_frames(tmp_path / "a.rrd", entity, 48, 64))
        if codec == "raw"
        else encoded_frames(tmp_path / "a.rrd", entity)
    )
    assert len(read) == len(log.frames["front"])
    for shown, recorded in zip(read, log.frames["front"], strict=True):
        assert psnr(shown, recorded) >= SAME_CARD_DB


def mistakes() -> Iterator[tuple[str, Callable[[U8], U8]]]:
    yield "red and blue swapped", lambda frames: frames[..., ::-1]
    yield "upside down", lambda frames: frames[:, ::-1]
    yield "mirrored", lambda frames: frames[:, :, ::-1]
    yield "one frame late", lambda frames: np.roll(frames, 1, axis=0)


@pytest.mark.parametrize(("name", "mistake"), mistakes(), ids=lambda value: value if isinstance(value, str) else "")
def test_the_colour_test_fails_for(tmp_path: Path, name: str, mistake: Callable[[U8], U8]) -> None:
    log = write_mcap(tmp_path / "a.mcap", encoding="protobuf")
    viewer.draw_log(log.path, tmp_path / "a.rrd")
    wrong = mistake(np.stack(encoded_frames(tmp_path / "a.rrd", "camera/front/image")))
    assert psnr(wrong[1], log.frames["front"][1]) < SAME_CARD_DB


# --- what is drawn ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["cdr", "protobuf", "json"])
def test_joints_are_plotted_by_name_from_the_schema_alone(tmp_path: Path, encoding: str) -> None:
    log = write_mcap(tmp_path / "a.mcap", encoding=encoding)
    viewer.draw_log(log.path, tmp_path / "a.rrd")
    rows = column(tmp_path / "a.rrd", "joint_states/position", "Scalars:scalars")
    assert len(rows) == len(log.joints)
    np.testing.assert_allclose(rows[10], joints_at((int(log.joint_times_ns[10]) - 1_700_000_000 * 10**9) / 1e9))
    [names] = [
        chunk.to_record_batch().column("SeriesLines:names").to_pylist()[0]
        for chunk in RrdReader(tmp_path / "a.rrd").stream()
        if chunk.entity_path == "/joint_states/position" and chunk.is_static
    ]
    assert names == list(JOINTS)


def test_the_topics_that_a_task_calls_actions_come_first() -> None:
    topics = ["/joint_states", "/odom", "/twist_mux", "/cmd_vel", "/sim/state"]
    ranked = sorted(topics, key=lambda topic: panel_rank(topic, {"/twist_mux"}))
    assert ranked == ["/twist_mux", "/cmd_vel", "/joint_states", "/odom", "/sim/state"]


def test_a_task_is_no_condition_and_no_hindrance(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "a.mcap", cameras=("front", "side"))
    viewer.draw_log(log.path, tmp_path / "with.rrd", spec=task_spec(log))
    viewer.draw_log(log.path, tmp_path / "without.rrd")
    assert entities(tmp_path / "with.rrd") == entities(tmp_path / "without.rrd")
    assert {"camera/front/image", "camera/side/image", "action/position"} <= entities(tmp_path / "with.rrd")


def test_the_first_of_many_episodes_is_shown_and_said(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "many.zarr", episode_lengths=(12, 9, 5))
    drawn = viewer.draw_log(log.path, tmp_path / "a.rrd", spec=zarr_task_spec())
    assert "3 episodes, showing episode_000" in drawn.notes[0]
    assert len(raw_frames(tmp_path / "a.rrd", "img", 32, 32)) == 12


def test_the_first_episode_that_has_all_its_files_is_shown(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_v21(tmp_path / "robot")
    folder.video(0).unlink()
    drawn = viewer.draw_log(folder.path, tmp_path / "a.rrd")
    whole = "of which episode_000001, episode_000002 have all their files, showing episode_000001; --episode NAME"
    assert whole in drawn.notes[0]
    with pytest.raises(LogError, match="the video is missing"):
        viewer.draw_log(folder.path, tmp_path / "b.rrd", episode="episode_000000")
    assert capfd.readouterr() == ("", "")  # nor any word of the library below


def test_another_episode_is_shown_by_name(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "many.zarr", episode_lengths=(12, 9, 5))
    drawn = viewer.draw_log(log.path, tmp_path / "a.rrd", episode="episode_001")
    assert drawn.notes == ()
    read = raw_frames(tmp_path / "a.rrd", "img", 32, 32)
    assert np.array_equal(np.stack(read), log.img[12:21])


def test_a_misspelt_episode_is_answered_with_the_nearest(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "many.zarr")
    with pytest.raises(UsageError, match="did you mean 'episode_001'"):
        viewer.draw_log(log.path, tmp_path / "a.rrd", episode="episode_01")


def test_an_ingested_episode_shows_its_stored_frames_to_the_byte(tmp_path: Path) -> None:
    store, _ = small_store(tmp_path)
    viewer.draw_episode(store, EPISODE, tmp_path / "a.rrd")
    read = raw_frames(tmp_path / "a.rrd", "side/real", 48, 64)
    assert np.array_equal(np.stack(read), store.read(EPISODE).frames["side"])


def test_each_part_of_an_action_is_plotted_under_its_own_name(tmp_path: Path) -> None:
    store, _ = small_store(tmp_path)
    viewer.draw_episode(store, EPISODE, tmp_path / "a.rrd")
    action = store.read(EPISODE).action
    assert action is not None
    assert column(tmp_path / "a.rrd", "action/move", "Scalars:scalars") == action[:, :2].tolist()
    assert column(tmp_path / "a.rrd", "action/grip", "Scalars:scalars") == action[:, 2:].tolist()


def test_a_reconstruction_comes_with_its_error_and_its_psnr(tmp_path: Path) -> None:
    store, encoder = small_store(tmp_path)
    viewer.draw_episode(store, EPISODE, tmp_path / "a.rrd", encoders={"front": encoder})
    error = raw_frames(tmp_path / "a.rrd", "front/error", 48, 64)[0]
    assert (error == 10 * viewer.ERROR_GAIN).all()
    values = [row[0] for row in column(tmp_path / "a.rrd", "front/psnr", "Scalars:scalars")]
    np.testing.assert_allclose(values, 20 * np.log10(255 / 10))


def test_stale_latents_are_left_out_and_said(tmp_path: Path) -> None:
    store, encoder = small_store(tmp_path)
    latents_path(tmp_path, "front", encoder.key, EPISODE).unlink()
    drawn = viewer.draw_episode(store, EPISODE, tmp_path / "a.rrd", encoders={"front": encoder, "side": encoder})
    assert "front: no reconstruction" in drawn.notes[0]
    assert "side/reconstructed" in entities(tmp_path / "a.rrd")
    assert "front/reconstructed" not in entities(tmp_path / "a.rrd")


def times_of(rrd: Path, entity: str) -> list[int]:
    """The times of what is drawn at an entity, nanoseconds of its time line."""
    columns = [chunk.to_record_batch().column(viewer_canvas.TIMELINE) for chunk in chunks_of(rrd, entity)]
    return sorted(time for column in columns for time in column.cast("int64").to_pylist())


def test_a_demonstration_deep_in_a_table_begins_at_zero(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "many.zarr", episode_lengths=(12, 9, 5)).path
    drawn = viewer.draw_log(log, tmp_path / "a.rrd", episode="episode_001")
    tenths = [k * 10**8 for k in range(9)]
    assert times_of(drawn.rrd, "img") == tenths
    assert times_of(drawn.rrd, "action") == tenths
    assert drawn.middle == {"duration": np.timedelta64(450, "ms")}
    store = ingested(tmp_path, log)
    second = store.index()[1].id
    assert times_of(viewer.draw_episode(store, second, tmp_path / "b.rrd").rrd, "action/target") == tenths


def ingested(tmp_path: Path, log: Path) -> EpisodeStore:
    ingest_logs([log], tmp_path / "data", zarr_task_spec(), workers=1)
    return EpisodeStore(tmp_path / "data")


def test_a_wall_clock_stays_one(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "a.mcap")
    drawn = viewer.draw_log(log.path, tmp_path / "a.rrd")
    assert times_of(drawn.rrd, "joint_states/position")[0] // 10**9 == START_NS // 10**9
    assert "timestamp" in drawn.middle


def test_without_a_camera_the_plots_have_all_the_room(tmp_path: Path) -> None:
    blind_dataset(tmp_path)
    store = EpisodeStore(tmp_path)
    assert rows_of_panels(viewer.draw_episode(store, store.index()[0].id, tmp_path / "a.rrd").rrd) == [3]
    seeing, _ = small_store(tmp_path / "seeing")
    assert rows_of_panels(viewer.draw_episode(seeing, EPISODE, tmp_path / "b.rrd").rrd) == [2, 3]


def test_columns_of_a_table_are_plotted_under_its_names(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "robot", images="image")
    viewer.draw_log(folder.path, tmp_path / "a.rrd")
    assert series_names(tmp_path / "a.rrd", "observation.state") == ["one", "two"]


# --- what cannot be read ----------------------------------------------------------------------------------------------


def write_json_log(path: Path, messages: list[tuple[str, str, bytes]]) -> Path:
    """A log of (topic, schema, bytes), a tenth of a second apart."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        channels: dict[str, int] = {}
        for number, (topic, schema, data) in enumerate(messages):
            if topic not in channels:
                schema_id = writer.register_schema(schema, "jsonschema", b"{}")
                encoding = "unheard of" if schema == "Unheard" else "json"
                channels[topic] = writer.register_channel(topic, encoding, schema_id)
            writer.add_message(channels[topic], START_NS + number * 10**8, data, 0)
        writer.finish()
    return path


def json_image(schema: str, **body: object) -> tuple[str, bytes]:
    return schema, json.dumps(body).encode()


PNG = encode_image(card_frame(0), "png")
GOOD = json_image("foxglove.CompressedImage", format="png", data=base64.b64encode(PNG).decode())
CUT_OFF = json_image("foxglove.CompressedImage", format="png", data=base64.b64encode(PNG[:-30]).decode())
DEPTH = json_image(
    "foxglove.RawImage",
    encoding="16UC1",
    height=2,
    width=2,
    step=4,
    data=base64.b64encode(np.array([0, 700, 1500, 65535], "<u2").tobytes()).decode(),
)


def test_a_depth_topic_is_drawn_as_distances_to_the_millimetre(tmp_path: Path) -> None:
    log = write_json_log(tmp_path / "a.mcap", [("/depth", *DEPTH), ("/camera", *GOOD)] * 3)
    drawn = viewer.draw_log(log, tmp_path / "a.rrd")
    assert len(encoded_frames(tmp_path / "a.rrd", "camera")) == 3
    assert drawn.notes == ()
    pngs = [np.array(blob[0], np.uint8) for blob in column(tmp_path / "a.rrd", "depth", "EncodedDepthImage:blob")]
    assert [cv2.imdecode(png, cv2.IMREAD_UNCHANGED).tolist() for png in pngs] == [[[0, 700], [1500, 65535]]] * 3


@pytest.mark.parametrize("first", [0, 3])
def test_a_video_topic_is_drawn_as_pictures_at_their_own_times(tmp_path: Path, first: int) -> None:
    sent = encode(numbered_frames(GROUP + 8), "h264")[first:]
    shown = [replace(packet, shows=packet.shows - first) for packet in sent]
    drawn = viewer.draw_log(write_video(tmp_path / "a.mcap", shown, "h264"), tmp_path / "a.rrd")
    frames = encoded_frames(tmp_path / "a.rrd", "camera/video")
    assert [number_of(frame) for frame in frames] == list(range(GROUP if first else 0, GROUP + 8))
    assert len(drawn.notes) == (1 if first else 0)
    assert all("before the first keyframe" in note for note in drawn.notes)


def test_damaged_images_among_good_ones_are_skipped_and_counted(tmp_path: Path) -> None:
    log = write_json_log(tmp_path / "a.mcap", [("/camera", *image) for image in (CUT_OFF, GOOD, CUT_OFF, GOOD, GOOD)])
    drawn = viewer.draw_log(log, tmp_path / "a.rrd")
    assert len(encoded_frames(tmp_path / "a.rrd", "camera")) == 3
    assert [note.partition(";")[0] for note in drawn.notes] == ["/camera: 2 messages left out"]


def test_a_message_that_does_not_fit_its_schema_is_skipped_and_counted(tmp_path: Path) -> None:
    number = ("/n", "Number", b'{"x": 1}')
    log = write_json_log(tmp_path / "a.mcap", [number, ("/n", "Number", b"{no json"), number])
    drawn = viewer.draw_log(log, tmp_path / "a.rrd")
    assert column(tmp_path / "a.rrd", "n", "Scalars:scalars") == [[1.0], [1.0]]
    assert [note.partition(";")[0] for note in drawn.notes] == ["/n: 1 message left out"]


def test_a_topic_in_an_unknown_encoding_is_left_out_and_said(tmp_path: Path) -> None:
    log = write_json_log(tmp_path / "a.mcap", [("/odd", "Unheard", b"?"), ("/n", "Number", b'{"x": 1}')])
    [note] = viewer.draw_log(log, tmp_path / "a.rrd").notes
    assert note.startswith("/odd: left out")


def test_nothing_to_draw_says_what_was_left_out(tmp_path: Path) -> None:
    log = write_json_log(tmp_path / "a.mcap", [("/camera", *CUT_OFF)])
    with pytest.raises(LogError, match=r"nothing to draw(.|\n)*/camera: 1 message left out"):
        viewer.draw_log(log, tmp_path / "a.rrd")
    assert not (tmp_path / "a.rrd").exists()


def test_real_log_with_service_events_and_damaged_images_is_drawn() -> None:
    with tempfile.TemporaryDirectory() as folder:
        rrd = Path(folder) / "a.rrd"
        services = "logs/rosbag2_tests/rosbag2_cpp/test/rosbag2_cpp/bags/topics_and_services.mcap"
        assert any("_service_event: left out" in note for note in viewer.draw_log(real_data(services), rrd).notes)
        damaged = "logs/rosbags_rs_testbags/tests/test_bags/test_bag_mcap/test_bag_mcap.mcap"
        assert any("/image: 2 messages left out" in note for note in viewer.draw_log(real_data(damaged), rrd).notes)


# --- what cannot be written -------------------------------------------------------------------------------------------


def test_a_folder_in_the_way_is_named_and_left_alone(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "a.mcap")
    (tmp_path / "out" / "a.rrd").mkdir(parents=True)
    with pytest.raises(StoreError, match="a folder is in the way"):
        viewer.draw_log(log.path, tmp_path / "out" / "a.rrd")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.rrd"]


@pytest.mark.parametrize("in_the_way", [True, False])
def test_a_folder_that_is_missing_or_a_file_is_wrong_use(tmp_path: Path, in_the_way: bool) -> None:
    log = write_mcap(tmp_path / "a.mcap")
    if in_the_way:
        (tmp_path / "out").write_bytes(b"")
    with pytest.raises(UsageError, match="no such folder"):
        viewer.draw_log(log.path, tmp_path / "out" / "a.rrd")


@pytest.mark.skipif(sys.platform != "linux", reason="needs a folder that nobody, not even root, may write into")
def test_a_folder_without_permission_is_a_plain_error(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "a.mcap")
    with pytest.raises(StoreError, match="cannot be written"):
        viewer.draw_log(log.path, Path("/proc/a.rrd"))


LIMITED = """
import resource, sys
from pathlib import Path
from vilp_data.errors import StoreError
from vilp_data.viewer import draw_log
limit = int(sys.argv[3])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    draw_log(Path(sys.argv[1]), Path(sys.argv[2]))
except StoreError as error:
    print(error.what)
"""


@pytest.mark.parametrize("missing_bytes", [2_000, 50_000])
def test_a_full_disk_is_a_plain_error_and_leaves_nothing_behind(tmp_path: Path, missing_bytes: int) -> None:
    log = write_mcap(tmp_path / "a.mcap", height=240, width=320, image_codec="raw", n_frames=4)
    viewer.draw_log(log.path, tmp_path / "whole.rrd")
    (tmp_path / "out").mkdir()
    limit = (tmp_path / "whole.rrd").stat().st_size - missing_bytes
    arguments = [str(log.path), str(tmp_path / "out" / "a.rrd"), str(limit)]
    ended = subprocess.run(
        [sys.executable, "-c", LIMITED, *arguments], capture_output=True, text=True, check=True, timeout=120
    )
    assert "cannot be written" in ended.stdout
    assert list((tmp_path / "out").iterdir()) == []


# --- ways to look at it -----------------------------------------------------------------------------------------------


def test_without_a_display_the_other_ways_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(UsageError, match=r"--web.*--save.*--screenshot"):
        viewer.present(lambda rrd: pytest.fail("drawn for nothing"))


def test_a_drawing_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "a.mcap")
    saved = tmp_path / "out" / "a.rrd"
    saved.parent.mkdir()
    saved.write_bytes(b"the one before")
    damaged = bytearray(log.path.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    log.path.write_bytes(damaged)
    with pytest.raises(LogError):
        viewer.draw_log(log.path, saved)
    assert saved.read_bytes() == b"the one before"
    assert [path.name for path in saved.parent.iterdir()] == ["a.rrd"]


def listening(process: psutil.Process) -> list[str]:
    """Addresses that a process and its children listen on."""
    family = [process, *process.children(recursive=True)]
    sockets = [socket for member in family for socket in member.net_connections("inet")]
    return [socket.laddr.ip for socket in sockets if socket.status == psutil.CONN_LISTEN]


SERVE = """
import sys
from pathlib import Path
from vilp_data import viewer
from vilp_data.viewer import window as viewer_window
drawn = viewer.Drawn(Path(sys.argv[1]), "", {})
viewer_window.serve_web(drawn, on_url=lambda url: print(url, flush=True), web_port=0, data_port=0)
"""


def test_the_web_page_is_served_to_this_machine_alone_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "a.mcap")
    viewer.draw_log(log.path, tmp_path / "a.rrd")
    server = subprocess.Popen([sys.executable, "-c", SERVE, str(tmp_path / "a.rrd")], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        url = server.stdout.readline().strip()
        family = psutil.Process(server.pid).children(recursive=True)
        assert url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(url, timeout=10) as page:
            assert b"<html" in page.read()
        addresses = listening(psutil.Process(server.pid))
        assert len(addresses) >= 2
        assert set(addresses) == {"127.0.0.1"}
        server.send_signal(signal.SIGINT)
        assert server.wait(timeout=20) == 0
        assert not [process for process in family if process.is_running() and process.status() != psutil.STATUS_ZOMBIE]
    finally:
        server.kill()
        server.wait()


def rerun_children() -> list[psutil.Process]:
    return psutil.Process(os.getpid()).children(recursive=True)


def picture_or_skip(draw: viewer_window.Draw, png: Path) -> U8:
    try:
        viewer.present(draw, screenshot=png)
    except viewer_process.ViewerError as error:
        if viewer_process.GRAPHICS_PACKAGE in str(error):
            pytest.skip(f"no graphics driver, not even a software one: {viewer_process.GRAPHICS_PACKAGE}")
        raise
    image = cv2.imdecode(np.frombuffer(png.read_bytes(), np.uint8), cv2.IMREAD_COLOR_RGB)
    assert image.shape == (900, 1600, 3)
    return image


def test_a_picture_shows_the_colour_card_the_right_way_round(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "a.mcap", encoding="protobuf", cameras=("front", "side"), height=96, width=160)
    before = rerun_children()
    image = picture_or_skip(partial(viewer.draw_log, log.path), tmp_path / "a.png").astype(int)
    left = image[:540, :800]  # the panel of the first camera
    corners = {"red": (230, 20, 20), "green": (20, 200, 20), "blue": (20, 20, 230), "yellow": (230, 220, 20)}
    centres = {}
    for name, colour in corners.items():
        rows, columns = np.nonzero((np.abs(left - np.array(colour)) < 30).all(axis=-1))
        assert len(rows) > 5_000, f"no {name} corner in the picture"
        centres[name] = (np.median(rows), np.median(columns))
    assert centres["red"][0] < 200 < 300 < centres["blue"][0]
    assert centres["red"][1] < 200 < 600 < centres["green"][1]
    assert centres["yellow"][0] > 300
    assert centres["yellow"][1] > 600
    assert rerun_children() == before


def test_a_viewer_without_a_graphics_driver_is_answered_with_the_package(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(name, "/nonexistent")
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    log = write_mcap(tmp_path / "a.mcap")
    with pytest.raises(viewer_process.ViewerError, match="apt-get install .*mesa-vulkan-drivers"):
        viewer.present(partial(viewer.draw_log, log.path), screenshot=tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()


def test_a_viewer_that_does_not_answer_in_time_is_ended(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "a.mcap")
    drawn = viewer.draw_log(log.path, tmp_path / "a.rrd")
    before = rerun_children()
    with pytest.raises(viewer_process.ViewerError, match="did not"):
        viewer_window.take_screenshot(drawn, tmp_path / "a.png", timeout_s=0.01)
    assert rerun_children() == before
    assert not (tmp_path / "a.png").exists()


def test_a_taken_port_is_not_used() -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert viewer_process.free_port(port) != port
