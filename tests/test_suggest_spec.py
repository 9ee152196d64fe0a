"""The suggested task reads the log it was suggested for: as it stands, or with one line un-commented."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.json_log import Said, image, joints, number, transform, write_json_log
from tests.real_data import real_data
from tests.synthetic import START_NS, write_mcap, write_zarr
from tests.video_logs import PERIOD_NS, VIDEO, Row, write_depth, write_log
from tests.video_logs import joints as video_joints
from tests.video_packets import encode, number_of, numbered_frames, video_message
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import LogError
from vilp_data.ingest import ingest_logs
from vilp_data.log_summary import format_summary, summarise
from vilp_data.model_size import common_size, cut_share, model_size
from vilp_data.recorder import EpisodeRecorder
from vilp_data.sources import open_log
from vilp_data.sources.mcap_log import McapLog
from vilp_data.spec import TaskSpec
from vilp_data.suggest_spec import _part_names, suggest_spec
from vilp_data.task_toml import parse_task
from vilp_data.topic_roles import role_of
from vilp_data.types import Message


def ingested(log: Path, text: str, root: Path) -> EpisodeStore:
    """The dataset that a task makes of a log, which must be read without a failure."""
    report = ingest_logs([log], root, parse_task(text, where="suggested"), workers=1)
    assert report.failed == []
    assert report.written
    return EpisodeStore(root)


def uncommented(text: str, key: str) -> str:
    """The task with its one line about `key` un-commented."""
    changed, count = re.subn(rf"^# (?={re.escape(key)} = )", "", text, flags=re.M)
    assert count == 1, text
    return changed


def suggested(log: Path) -> TaskSpec:
    return parse_task(suggest_spec(log), where="suggested")


# --- every kind of log ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["cdr", "protobuf", "json"])
def test_a_log_of_messages_is_ingested_as_suggested(tmp_path: Path, encoding: str) -> None:
    log = write_mcap(tmp_path / "run.mcap", encoding=encoding, cameras=("front", "side"))  # type: ignore[arg-type]
    text = suggest_spec(log.path)
    spec = parse_task(text, where="suggested")
    assert {view: table.topic for view, table in spec.views.items()} == {
        "front": "/camera/front/image",
        "side": "/camera/side/image",
    }
    assert spec.rate_hz == 10
    assert spec.low_dim["joint_states"].names == ("shoulder", "elbow", "wrist")
    assert spec.action["action"].topic == "/action"
    assert all(table.clock == "header" for table in spec.clocks().values())
    episode = ingested(log.path, text, tmp_path / "data").read("run")
    assert episode.valid.all()
    assert episode.action is not None
    np.testing.assert_allclose(episode.low_dim[:, 0], np.arange(20) / 10, atol=1e-6)


def test_a_store_of_demonstrations_is_ingested_as_suggested(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "replay.zarr")
    text = suggest_spec(log.path)
    assert "write the rate at which they were recorded" in text
    store = ingested(log.path, text, tmp_path / "data")
    assert len(store.index()) == 3
    assert (store.index()[0].has_action, store.spec().low_dim["state"].topic) == (True, "state")


@pytest.mark.parametrize(
    ("relative", "episodes"),
    [
        ("logs/webviz_bags/packages_webviz-core_public_fixtures_example-bz2.bag", 1),
        ("logs/lichtblick/e2e_fixtures_assets_custom-camera-model.mcap", 1),
        ("logs/lichtblick/e2e_fixtures_assets_example_logs.mcap", 1),
        ("robosuite_demos/v1.0.1/robosuite/models/assets/demonstrations/lift/panda/demo.hdf5", 1),
    ],
)
def test_real_logs_are_ingested_as_suggested(tmp_path: Path, relative: str, episodes: int) -> None:
    log = real_data(relative)
    assert len(ingested(log, suggest_spec(log), tmp_path / "data").index()) == episodes


def test_a_real_robot_s_table_and_camera_are_found() -> None:
    spec = suggested(real_data("g1_inspire_lerobot"))
    (view,) = spec.views.values()
    assert (view.topic, view.height, view.width, view.fit) == ("observation.images.cam_high", 96, 128, None)
    assert ([part.topic for part in spec.low_dim.values()], [part.topic for part in spec.action.values()]) == (
        ["observation.state"],
        ["action"],
    )


def test_a_topic_of_one_message_is_no_state(tmp_path: Path) -> None:
    log = write_json_log(tmp_path / "run.mcap", [*frames(), joints(0.5, ["a", "b"], [0.0, 1.0])])
    assert suggested(log).low_dim == {}
    assert "but one message only" in suggest_spec(log)


def test_topics_that_end_alike_are_named_by_what_tells_them_apart() -> None:
    sensors = ("ship/pressure_pa/ins/3/sbg", "ship/heave_m/ins/3/sbg", "ship/fix/ins/3/sbg", "ship/fix/ins/0/anavs")
    names = _part_names([*sensors, "/left/joint_states", "ship/fix/ins/1/anavs"])
    assert names == {
        sensors[0]: "pressure_pa", sensors[1]: "heave_m", sensors[2]: "fix", sensors[3]: "ins_0_anavs",
        "/left/joint_states": "left_joint_states", "ship/fix/ins/1/anavs": "ins_1_anavs",
    }  # fmt: skip
    twice = _part_names(["a/fix/b/c/d", "a/pose/b/c/d", "a/fix/e/f/g", "a/pose/e/f/g"])
    assert sorted(twice.values()) == ["fix_b_c_d", "fix_e_f_g", "pose_b_c_d", "pose_e_f_g"]


def test_a_clock_is_no_command() -> None:
    assert role_of("/time_reference", [Message("/time_reference", "array", 0, 0, np.zeros(2))]).kind == "unused"
    assert role_of("/reference", [Message("/reference", "array", 0, 0, np.zeros(2))]).kind == "command"


def test_what_a_simulator_says_of_its_world_is_not_what_a_policy_sees(tmp_path: Path) -> None:
    """Logs of `record` and `render` carry it, as an array of a ROS type."""
    with EpisodeRecorder(tmp_path / "run.mcap", metadata={}) as log:
        for tick in range(20):
            log.vector("/sim/state", tick * 100_000_000 + START_NS, np.arange(32.0))
            log.vector("/arm/state", tick * 100_000_000 + START_NS, np.arange(7.0))
    with open_log(tmp_path / "run.mcap") as written:
        [simulated, measured] = [[*written.messages([topic])] for topic in ("/sim/state", "/arm/state")]
    assert role_of("/sim/state", simulated).kind == "other"
    assert role_of("/arm/state", measured).kind == "state"


# --- choices ------------------------------------------------------------------------------------------------------------------------


def frames(count: int = 20) -> list[Said]:
    return [image(k / 10, index=k) for k in range(count)]


def states(count: int = 20) -> list[Said]:
    return [joints(k / 10, ["a", "b"], [k / 10, 1.0]) for k in range(count)]


def commands(topic: str, count: int = 20) -> list[Said]:
    return [joints(k / 10, ["a"], [k / 10], topic=topic) for k in range(count)]


def test_of_several_commands_the_user_un_comments_one(tmp_path: Path) -> None:
    log = write_json_log(
        tmp_path / "run.mcap", [*frames(), *states(), *commands("/arm/command"), *commands("/leader/joint_states")]
    )
    text = suggest_spec(log)
    assert parse_task(text, where="x").action == {}
    assert 'its name says "leader"' in text
    assert ingested(log, text, tmp_path / "watched").read("run").action is None
    chosen = ingested(log, uncommented(text, "action.arm_command"), tmp_path / "data").read("run")
    assert chosen.action is not None
    assert chosen.valid.all()


def test_a_log_without_commands_offers_the_state_one_step_later(tmp_path: Path) -> None:
    log = write_json_log(tmp_path / "run.mcap", [*frames(), *states()])
    text = uncommented(suggest_spec(log), "action.joint_states_next")
    episode = ingested(log, text, tmp_path / "data").read("run")
    assert episode.action is not None
    np.testing.assert_array_equal(episode.action[:-1], episode.low_dim[1:])


def test_joints_of_several_publishers_become_parts_of_their_own(tmp_path: Path) -> None:
    hand = [joints(k / 10 + 0.01, ["finger"], [1.0]) for k in range(20)]
    log = write_json_log(tmp_path / "run.mcap", [*frames(), *states(), *hand])
    spec = suggested(log)
    assert [part.names for part in spec.low_dim.values()] == [("a", "b"), ("finger",)]
    ingested(log, suggest_spec(log), tmp_path / "data")


def test_transforms_are_offered_from_the_root_to_the_tool(tmp_path: Path) -> None:
    tree = [
        transform(k / 10, parent, child, 1.0)
        for k in range(20)
        for parent, child in (("base", "arm"), ("arm", "tool0"))
    ]
    tree += [transform(k / 10, "base", "camera_link", 1.0) for k in range(20)]
    static = transform(-1.0, "arm", "zz_bolt", 1.0, topic="/tf_static")
    log = write_json_log(tmp_path / "run.mcap", [*frames(), *states(), *tree, static])
    text = suggest_spec(log)
    assert 'from_frame = "base", to_frame = "tool0"' in text
    assert "frames: arm, base, camera_link, tool0, zz_bolt" in text
    episode = ingested(log, uncommented(text, "low_dim.tool0"), tmp_path / "data").read("run")
    assert episode.low_dim.shape[1] == 2 + 7


def test_frames_may_be_called_like_arrows(tmp_path: Path) -> None:
    tree = [transform(k / 10, "a -> b", "tool -> 0\n", 1.0) for k in range(20)]
    text = suggest_spec(write_json_log(tmp_path / "run.mcap", [*frames(), *states(), *tree]))
    assert 'from_frame = "a -> b", to_frame = "tool -> 0\\n"' in text
    episode = ingested(tmp_path / "run.mcap", uncommented(text, "low_dim.tool_-_0"), tmp_path / "data").read("run")
    assert episode.low_dim.shape[1] == 2 + 7


@pytest.mark.parametrize(("offset_s", "said"), [(30.0, "30.0 s before"), (-30.0, "30.0 s after")])
def test_stamps_that_lie_far_off_are_said_to_lie_before_or_after(tmp_path: Path, offset_s: float, said: str) -> None:
    early = [joints(k / 10 - offset_s, ["a"], [1.0])._replace(t_s=k / 10) for k in range(20)]
    log = write_json_log(tmp_path / "run.mcap", [*early, *(number(k / 10, 1.0, "/cmd") for k in range(20))])
    assert f"header stamps lie {said} log time" in suggest_spec(log)
    assert f"header stamps lie {said} log time" in format_summary(summarise(log))


def test_a_pause_is_not_made_of_what_the_index_does_not_tell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = [*frames(), *(message._replace(t_s=message.t_s + 60) for message in frames())]
    log = write_json_log(tmp_path / "run.mcap", said)
    assert "the log pauses" in suggest_spec(log)
    whole = McapLog.message_times
    monkeypatch.setattr(McapLog, "message_times", lambda log: ({t: n[:-5] for t, n in whole(log)[0].items()}, True))
    assert "the log pauses" not in suggest_spec(log)


def test_headers_that_tell_no_time_are_not_used(tmp_path: Path) -> None:
    still = [
        Said(k / 10, "/joint_states", "sensor_msgs/msg/JointState", joints(0.0, ["a"], [k / 10]).body)
        for k in range(20)
    ]
    log = write_json_log(tmp_path / "run.mcap", [*frames(), *still])
    spec = suggested(log)
    assert (spec.low_dim["joint_states"].clock, spec.views["front"].clock) == ("log", "header")
    assert "its header stamps tell no time" in suggest_spec(log)
    assert ingested(log, suggest_spec(log), tmp_path / "data").read("run").valid.all()


def test_a_clock_far_from_the_log_s_is_used_only_where_every_topic_has_it(tmp_path: Path) -> None:
    def early(said: list[Said]) -> list[Said]:
        return [message._replace(t_s=message.t_s + 5000) for message in said]

    together = write_json_log(tmp_path / "a.mcap", early([*frames(), *states()]))
    assert {table.clock for table in suggested(together).clocks().values()} == {"header"}
    apart = write_json_log(
        tmp_path / "b.mcap",
        [*early(frames()), *early(states()), *(number(5000 + k / 10, 1.0, "/cmd") for k in range(20))],
    )
    assert {table.clock for table in suggested(apart).clocks().values()} == {"log"}
    ingested(apart, suggest_spec(apart), tmp_path / "data")


def test_pauses_and_switches_are_offered_for_cutting(tmp_path: Path) -> None:
    said = [*frames(), *states(), *(message._replace(t_s=message.t_s + 60) for message in (*frames(), *states()))]
    said += [number(t, value, "/recording") for t, value in ((0.0, True), (1.0, False), (60.0, True), (61.0, False))]
    log = write_json_log(tmp_path / "run.mcap", said)
    text = suggest_spec(log)
    by_gap = parse_task(re.sub(r'^# (?=episodes = \{ by = "gap")', "", text, flags=re.M), where="x")
    assert by_gap.episodes.gap_s == pytest.approx(29, abs=1)
    chosen = re.sub(r'^# (?=episodes = \{ by = "topic")', "", text, flags=re.M).replace('"header"', '"log"')
    chosen = re.sub(r'(topic = "/camera/front/image".*\n)', r'\1clock = "log"\n', chosen)
    chosen = chosen.replace('topic = "/joint_states"', 'topic = "/joint_states", clock = "log"')
    assert len(ingested(log, chosen, tmp_path / "data").index()) == 2


def test_slow_topics_get_the_patience_they_need(tmp_path: Path) -> None:
    slow = [image(float(k), "/overview/image", index=k) for k in range(20)] + [
        number(2.0 * k, 1.0, "/gripper/state") for k in range(10)
    ]
    slow = [message for message in slow if message.topic != "/gripper/state"] + [
        joints(2.0 * k, ["g"], [1.0], "/gripper/state") for k in range(11)
    ]
    log = write_json_log(tmp_path / "run.mcap", slow)
    spec = suggested(log)
    assert (spec.rate_hz, spec.views["overview"].stale_after_s, spec.low_dim["gripper_state"].stale_after_s) == (
        1.0,
        2.5,
        5.0,
    )
    assert ingested(log, suggest_spec(log), tmp_path / "data").read("run").valid.all()


def test_a_raw_topic_beside_its_compressed_one_is_not_a_second_camera(tmp_path: Path) -> None:
    said = [
        image(k / 10, topic, index=k)
        for k in range(5)
        for topic in ("/cam/left/image_raw/compressed", "/cam/left/image_raw")
    ]
    text = suggest_spec(write_json_log(tmp_path / "run.mcap", said))
    assert [view.topic for view in parse_task(text, where="x").views.values()] == ["/cam/left/image_raw/compressed"]
    assert "/cam/left/image_raw: shows what /cam/left/image_raw/compressed shows" in text


def thermal(number: int) -> Any:
    return np.random.default_rng(number).integers(7000, 9000, (48, 64)).astype(np.uint16)


def test_grey_of_16_bits_is_suggested_as_a_picture_and_as_depth_only_to_un_comment(tmp_path: Path) -> None:
    log = write_depth(tmp_path / "run.mcap", [thermal(n) for n in range(12)], "mono16", topic="/thermal/image_raw")
    text = suggest_spec(log)
    (view,) = parse_task(text, where="suggested").views.values()
    assert view.depth is None
    assert view.levels is not None
    assert 7000 <= view.levels[0] < 7100 < 8900 < view.levels[1] <= 9000
    assert ingested(log, text, tmp_path / "picture")
    other = uncommented(re.sub(r"^levels = .*$", "", text, flags=re.M), "depth")
    (view,) = ingested(log, other, tmp_path / "depth").spec().views.values()
    assert view.depth is not None


def test_grey_of_16_bits_on_a_topic_called_depth_is_suggested_as_depth(tmp_path: Path) -> None:
    log = write_depth(tmp_path / "run.mcap", [thermal(n) for n in range(12)], "mono16", topic="/camera/depth/image_raw")
    text = suggest_spec(log)
    (view,) = parse_task(text, where="suggested").views.values()
    assert view.depth is not None
    assert "\n# levels = [" in text


def test_a_png_of_16_bits_is_a_camera(tmp_path: Path) -> None:
    data = [base64.b64encode(cv2.imencode(".png", thermal(n))[1].tobytes()).decode() for n in range(12)]
    said = [Said(n / 10, "/ir", "foxglove.CompressedImage", {"format": "png", "data": d}) for n, d in enumerate(data)]
    log = write_json_log(tmp_path / "run.mcap", said)
    assert ingested(log, suggest_spec(log), tmp_path / "data").spec().views["ir"].levels is not None
    assert "48x64" in format_summary(summarise(log))


def test_video_with_b_frames_is_never_read_by_log_time(tmp_path: Path) -> None:
    sent = encode(numbered_frames(40), "h264 with B frames")
    rows = [
        Row(START_NS + n * PERIOD_NS, VIDEO, video_message(p.data, "h264").body, START_NS + (p.shows - 70) * PERIOD_NS)
        for n, p in enumerate(sent)
    ]
    log = write_log(tmp_path / "run.mcap", [*rows, *video_joints(40)])
    text = suggest_spec(log)
    (view,) = parse_task(text, where="suggested").views.values()
    assert view.clock == "header"
    assert view.offset_s == pytest.approx(7.0, abs=0.3)
    store = ingested(log, text, tmp_path / "data")
    (entry,) = store.index()
    frames = store.read_frames(next(iter(store.spec().views)), entry)
    numbers = [number_of(frame) for frame in frames]
    assert numbers == sorted(numbers)
    assert len(numbers) > 30


def test_odd_names_still_make_a_task(tmp_path: Path) -> None:
    said = [image(k / 10, topic, index=k) for k in range(5) for topic in ('/ca"m/größe 1', "/cam/2", "image")]
    log = write_json_log(tmp_path / '7 weird "name".mcap', said)
    assert len(ingested(log, suggest_spec(log), tmp_path / "data").spec().views) == 3


def test_a_log_that_no_task_could_read_says_what_is_in_it(tmp_path: Path) -> None:
    log = write_json_log(tmp_path / "run.mcap", [Said(0.0, "/rosout", "rcl_interfaces/msg/Log", {"msg": "hello"})])
    with pytest.raises(LogError, match=r"no camera and no numbers(.|\n)*/rosout"):
        suggest_spec(log)


# --- sizes --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("image_size", "expected", "cut"),
    [
        ((480, 640), (96, 128), 0), ((96, 96), (96, 96), 0), ((512, 512), (96, 96), 0), ((1080, 1920), (96, 160), 0.0625),
        ((720, 1280), (96, 160), 0.0625), ((360, 520), (96, 128), 0.0769), ((640, 480), (128, 96), 0), ((96, 160), (96, 160), 0),
    ],
)  # fmt: skip
def test_sizes_keep_the_aspect_as_far_as_the_models_allow(
    image_size: tuple[int, int], expected: tuple[int, int], cut: float
) -> None:
    size = model_size(*image_size)
    assert (size.height, size.width) == expected
    assert size.cut == pytest.approx(cut, abs=1e-3)


@given(images=st.lists(st.tuples(st.integers(16, 3000), st.integers(16, 3000)), min_size=1, max_size=4))
def test_cameras_share_one_size_that_the_models_take(images: list[tuple[int, int]]) -> None:
    size = common_size(images)
    assert size.height % 32 == size.width % 32 == 0
    assert size.cut == max(cut_share(size.height, size.width, *image) for image in images)
    assert 0 <= size.cut < 1
    if len(set(images)) == 1:
        assert (size.height, size.width) == (model_size(*images[0]).height, model_size(*images[0]).width)
