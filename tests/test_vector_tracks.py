"""Vectors of a demonstration: transforms between frames, joints of several publishers on one topic, logs without cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.json_log import Said, image, joints, number, stamp, transform, write_json_log
from tests.real_data import real_data
from vilp_data import transform_tree
from vilp_data.assemble import assemble_episode
from vilp_data.errors import DecodeError, LogError, SpecError
from vilp_data.ingest import ingest_logs
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import parse_task
from vilp_data.types import Episode
from vilp_data.vector_tracks import age_names

VIEWS = {"front": {"topic": "/camera/front/image", "height": 48, "width": 64}}
TOOL = {"topic": "/tf", "from_frame": "base", "to_frame": "tool"}


def assemble(path: Path, *, views: dict[str, Any] = VIEWS, start: int = 0, **table: Any) -> Episode:
    spec = TaskSpec.model_validate({"name": "x", "rate_hz": 10.0, "views": views, **table})
    with open_log(path) as log:
        (demonstration,) = log.episodes()
        return assemble_episode(log, demonstration, spec, episode_id="x")


def robot(count: int = 20, **options: Any) -> list[Said]:
    """Images at 10 Hz, and base -> arm -> tool at 50 Hz: arm at t, tool 100 beyond."""
    said = [image(k / 10, index=k) for k in range(count)]
    said += [transform(k / 50, "base", "arm", k / 50) for k in range(5 * count)]
    return [*said, *(transform(k / 50, "arm", "tool", 100.0, **options) for k in range(5 * count))]


def test_low_dim_may_be_the_transform_between_two_frames(tmp_path: Path) -> None:
    episode = assemble(write_json_log(tmp_path / "run.mcap", robot()), low_dim={"tool": TOOL})
    assert episode.valid.all()
    np.testing.assert_allclose(episode.low_dim[:, 0], 100 + np.arange(20) / 10, atol=1e-5)
    np.testing.assert_array_equal(episode.low_dim[:, 1:], np.tile([0, 0, 0, 0, 0, 1], (20, 1)))
    np.testing.assert_allclose(episode.age_s["/tf base->tool"], 0, atol=1e-6)


def test_the_age_of_a_transform_is_that_of_its_oldest_link(tmp_path: Path) -> None:
    said = [message for message in robot() if message.topic != "/tf" or "tool" in str(message.body)]
    said += [transform(0.4 * k, "base", "arm", 1.0) for k in range(5)]
    episode = assemble(write_json_log(tmp_path / "run.mcap", said), low_dim={"tool": TOOL})
    np.testing.assert_allclose(episode.age_s["/tf base->tool"][:9], [0, 0.1, 0.2, 0.3] * 2 + [0], atol=1e-6)


def test_a_long_log_s_transforms_are_read_again_where_a_late_joint_needs_what_was_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hand's own links come all along; that the tool hangs on it is said at the end, when they have been passed over."""
    said = [image(k / 10, index=k) for k in range(20)]
    said += [transform(k / 50, "base", "hand", k / 50) for k in range(100)]
    said += [transform(k / 50, "base" if k < 75 else "hand", "tool", 100.0) for k in range(100)]
    log = write_json_log(tmp_path / "run.mcap", said)
    whole = assemble(log, low_dim={"tool": TOOL})
    monkeypatch.setattr(transform_tree, "LINKS_BEFORE_SORTING_OUT", 20)
    again = assemble(log, low_dim={"tool": TOOL})
    np.testing.assert_array_equal(again.low_dim, whole.low_dim)
    np.testing.assert_allclose(again.low_dim[:, 0], [100 + (k / 10 if k >= 15 else 0) for k in range(20)], atol=1e-5)


@pytest.mark.parametrize("body", [{"transforms": 3}, {"transforms": [{"header": {}}]}])
def test_a_damaged_transform_keeps_no_other_log_back(tmp_path: Path, body: dict[str, Any]) -> None:
    good = write_json_log(tmp_path / "good.mcap", robot())
    bad = write_json_log(tmp_path / "bad.mcap", [*robot(), Said(0.5, "/tf", "tf2_msgs/msg/TFMessage", body)])
    spec = TaskSpec.model_validate({"name": "x", "rate_hz": 10.0, "views": VIEWS, "low_dim": {"tool": TOOL}})
    report = ingest_logs([bad, good], tmp_path / "data", spec, workers=1)
    assert (report.written, [name for name, _ in report.failed]) == (["good"], ["bad"])


def test_parts_may_be_of_several_frames_and_take_some_columns(tmp_path: Path) -> None:
    low_dim = {
        "arm": TOOL | {"to_frame": "arm", "fields": ["translation"]},
        "back": TOOL | {"from_frame": "tool", "to_frame": "base"},
    }
    episode = assemble(write_json_log(tmp_path / "run.mcap", robot()), low_dim=low_dim)
    assert episode.low_dim.shape == (20, 10)
    np.testing.assert_allclose(episode.low_dim[:, 3], -(100 + np.arange(20) / 10), atol=1e-5)


def test_an_action_may_be_a_frame_as_it_is_commanded(tmp_path: Path) -> None:
    episode = assemble(write_json_log(tmp_path / "run.mcap", robot()), action={"target": TOOL})
    assert episode.action is not None
    last_in_interval = 100 + np.minimum(np.arange(20) / 10 + 0.08, 1.98)
    np.testing.assert_allclose(episode.action[:, 0], last_in_interval, atol=1e-5)


def test_static_transforms_of_long_before_the_demonstration_hold_in_it(tmp_path: Path) -> None:
    said = [
        message
        for message in robot()
        if message.topic != "/tf" or message.body["transforms"][0]["child_frame_id"] == "arm"
    ]
    said.append(transform(-3600.0, "arm", "tool", 7.0, topic="/tf_static"))
    log = write_json_log(tmp_path / "run.mcap", said)
    spec = parse_task(
        'name = "x"\nrate_hz = 10\nlow_dim.tool = { topic = "/tf", from_frame = "base", to_frame = "/tool" }\n'
        '[episodes]\nby = "gap"\ngap_s = 60\n[views.front]\ntopic = "/camera/front/image"\nheight = 48\nwidth = 64\n',
        where="x",
    )
    report = ingest_logs([log], tmp_path / "data", spec, workers=1)
    assert (report.written, report.failed, report.findings) == (["run-at-03600.000s"], [], {})


def test_a_frame_that_fell_silent_masks_the_steps_that_need_it(tmp_path: Path) -> None:
    said = [
        message for message in robot() if message.topic != "/tf" or message.t_s <= 1.0 or "tool" in str(message.body)
    ]
    episode = assemble(write_json_log(tmp_path / "run.mcap", said), low_dim={"tool": TOOL})
    assert episode.valid.tolist() == [True] * 16 + [False] * 4
    assert "low_dim tool: missing, stale or not finite at 4 of 20 steps" in episode.findings[0]


def test_missing_frames_and_links_are_named(tmp_path: Path) -> None:
    log = write_json_log(tmp_path / "run.mcap", [*robot(), transform(0.5, "map", "odom", 1.0)])
    with pytest.raises(DecodeError, match=r"no frame called 'tol'\n.*arm, base, map, odom, tool"):
        assemble(log, low_dim={"tool": TOOL | {"to_frame": "tol"}})
    with pytest.raises(DecodeError, match="no transform between 'base' and 'map'"):
        assemble(log, low_dim={"tool": TOOL | {"to_frame": "odom"}})


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('low_dim.a = { topic = "/tf", from_frame = "b" }', "go together"),
        ('low_dim.a = { topic = "/tf", from_frame = "/b", to_frame = "b" }', "never moves in itself"),
        ('low_dim.a = { topic = "/tf", from_frame = "b", to_frame = "c", names = ["x"] }', "`names` is of joints"),
        (
            'low_dim.a = { topic = "/tf", from_frame = "b", to_frame = "c" }\nlow_dim.b = { topic = "/tf" }',
            "read both as transforms",
        ),
        ('action.a = { topic = "/tf", from_frame = "b", to_frame = "c", kind = "delta" }', 'of kind "absolute"'),
        ('low_dim.a = { topic = "/tf", from_fram = "b" }', "did you mean 'from_frame'"),
    ],
)
def test_tables_of_frames_that_cannot_be_are_refused(table: str, said: str) -> None:
    with pytest.raises(SpecError) as refused:
        parse_task(f'name = "x"\nrate_hz = 10\n{table}\n', where="x")
    assert said in str(refused.value)


# --- joints -------------------------------------------------------------------------------------------------------------------


def test_joints_of_several_publishers_on_one_topic_are_told_apart_by_name(tmp_path: Path) -> None:
    said = [image(k / 10, index=k) for k in range(20)]
    said += [joints(k / 50, ["elbow", "wrist"], [k / 50, 5.0]) for k in range(100)]
    said += [joints(k / 10 + 0.01, ["finger"], [k / 10]) for k in range(20)]
    low_dim = {
        name: {"topic": "/joint_states", "names": names}
        for name, names in (("arm", ["wrist", "elbow"]), ("hand", ["finger"]))
    }
    log = write_json_log(tmp_path / "run.mcap", said)
    episode = assemble(log, low_dim=low_dim)
    np.testing.assert_allclose(episode.low_dim[1:, 1], np.arange(1, 20) / 10, atol=1e-6)
    np.testing.assert_allclose(episode.low_dim[1:, 2], np.arange(19) / 10, atol=1e-6)
    assert episode.age_s["/joint_states low_dim.arm"].max() < 0.001
    np.testing.assert_allclose(episode.age_s["/joint_states low_dim.hand"][1:], 0.09, atol=1e-6)
    with pytest.raises(LogError, match=r"is of the joints named\n.*did you mean 'elbow'"):
        assemble(log, low_dim={"arm": {"topic": "/joint_states", "names": ["elbo"]}})
    with pytest.raises(DecodeError, match="no joint 'shoulder'"):
        assemble(log, low_dim={"arm": {"topic": "/joint_states", "names": ["elbow", "shoulder"]}})
    with pytest.raises(DecodeError, match="different lengths"):
        assemble(log, low_dim={"all": {"topic": "/joint_states"}})


def test_ages_have_names_of_their_own_only_where_they_may_differ() -> None:
    def names(**table: Any) -> set[str]:
        return set(age_names(TaskSpec.model_validate({"name": "x", "views": VIEWS, **table})).values())

    def parts(**changes: Any) -> dict[str, Any]:
        return {"a": {"topic": "/x"}, "b": {"topic": "/x", **changes}}

    assert names(low_dim=parts(fields=["velocity"])) == {"/x"}
    assert names(low_dim=parts(names=["elbow"])) == {"/x low_dim.a", "/x low_dim.b"}
    assert names(low_dim={"a": {"topic": "/x"}}, action={"b": {"topic": "/x"}}) == {"/x low_dim.a", "/x action.b"}
    rotation = {"topic": "/x", "kind": "delta_rotation", "frame": "base"}
    assert names(action={"a": {"topic": "/x", "kind": "delta"}, "b": rotation}) == {"/x"}
    assert names(action=parts(kind="delta")) == {"/x action.a", "/x action.b"}
    frames = {"from_frame": "base", "to_frame": "tool"}
    assert names(low_dim={"a": {"topic": "/x"} | frames, "b": {"topic": "/x"} | frames}) == {"/x base->tool"}


# --- rotations of poses -------------------------------------------------------------------------------------------------------


def poses(quaternion: Any, *, topic: str = "/pose", count: int = 20) -> list[Said]:
    """Poses at 10 Hz whose quaternion x y z w at step k is `quaternion(k)`."""

    def body(k: int) -> dict[str, Any]:
        orientation = dict(zip("xyzw", quaternion(k), strict=True))
        return {
            "header": {"stamp": stamp(k / 10)},
            "pose": {"position": {"x": 1, "y": 2, "z": 3}, "orientation": orientation},
        }

    return [Said(k / 10, topic, "geometry_msgs/msg/PoseStamped", body(k)) for k in range(count)]


FOUR = ["pose.orientation.x", "pose.orientation.y", "pose.orientation.z", "pose.orientation.w"]


@pytest.mark.parametrize("fields", [[], ["pose"], ["pose.orientation"], ["pose.position.x", *FOUR]])
def test_a_quaternion_that_was_never_set_masks_its_steps(tmp_path: Path, fields: list[str]) -> None:
    said = [image(k / 10, index=k) for k in range(20)] + poses(lambda k: (0, 0, 0, 0 if k < 8 else 1))
    episode = assemble(
        write_json_log(tmp_path / "run.mcap", said), low_dim={"pose": {"topic": "/pose", "fields": fields}}
    )
    assert episode.valid.tolist() == [False] * 8 + [True] * 12
    assert not episode.low_dim[:8, -4:].any()


@pytest.mark.parametrize("fields", [[], ["pose.orientation"], FOUR])
@pytest.mark.parametrize("part", ["low_dim", "action"])
def test_a_quaternion_that_flips_its_sign_is_stored_continuous_from_its_first(
    tmp_path: Path, fields: list[str], part: str
) -> None:
    turn = [(0.0, 0.0, np.sin(k / 40), -np.cos(k / 40)) for k in range(20)]
    flipped = poses(lambda k: [number * (-1) ** (k // 3) for number in turn[k]])
    log = write_json_log(tmp_path / "run.mcap", [*(image(k / 10, index=k) for k in range(20)), *flipped])
    episode = assemble(log, **{part: {"pose": {"topic": "/pose", "fields": fields}}})
    found = episode.low_dim if part == "low_dim" else episode.action
    assert found is not None
    np.testing.assert_allclose(found[:, -4:], turn, atol=1e-6)


def test_four_numbers_that_are_no_quaternion_stay_as_they_are(tmp_path: Path) -> None:
    said = [image(k / 10, index=k) for k in range(20)]
    said += [joints(k / 10, list("xyzw"), [0.0, 0.0, 0.0, (-1.0) ** k * (k > 3)]) for k in range(20)]
    episode = assemble(write_json_log(tmp_path / "run.mcap", said), low_dim={"joints": {"topic": "/joint_states"}})
    assert episode.valid.all()
    assert episode.low_dim[:6, 3].tolist() == [0, 0, 0, 0, 1, -1]


# --- without cameras ------------------------------------------------------------------------------------------------------------


def test_a_log_without_cameras_steps_by_its_low_dim(tmp_path: Path) -> None:
    said = [joints(k / 50, ["a"], [k / 50]) for k in range(100)] + [number(k / 20, k / 20, "/cmd") for k in range(40)]
    log = write_json_log(tmp_path / "run.mcap", said)
    action = {"target": {"topic": "/cmd", "clock": "log"}}
    episode = assemble(log, views={}, low_dim={"joints": {"topic": "/joint_states"}}, action=action)
    assert (episode.frames, episode.n_steps) == ({}, 20)
    np.testing.assert_allclose(episode.low_dim[:, 0], np.arange(20) / 10, atol=1e-6)
    assert episode.action is not None
    np.testing.assert_allclose(episode.action[:, 0], np.arange(20) / 10 + 0.05, atol=1e-6)


@pytest.mark.parametrize(
    ("table", "said"), [('low_dim.a = { topic = "/a" }', "states its rate_hz"), ("rate_hz = 10", "needs a view")]
)
def test_a_task_without_views_states_its_rate_and_has_low_dim(table: str, said: str) -> None:
    with pytest.raises(SpecError, match=said):
        parse_task(f'name = "x"\n{table}\n', where="x")


# --- a real robot, of a kind ------------------------------------------------------------------------------------------------------


def test_the_turtle_that_follows_is_where_the_tree_of_a_real_bag_says(tmp_path: Path) -> None:
    """In ROS's own turtle example every pose is published twice: as a turtlesim Pose, and through tf."""
    log = real_data("logs/webviz_bags/packages_webviz-core_public_fixtures_example.lz4.bag")
    world = {"topic": "/tf", "from_frame": "world", "to_frame": "turtle2"}
    low_dim = {
        "pose": {"topic": "/turtle2/pose", "clock": "log"},
        "frame": world,
        "relative": world | {"from_frame": "turtle1"},
    }
    with open_log(log) as reader:
        (demonstration,) = reader.episodes()
        spec = TaskSpec.model_validate({"name": "x", "rate_hz": 30, "low_dim": low_dim})
        episode = assemble_episode(reader, demonstration, spec, episode_id="x")
    assert episode.n_steps > 600
    x, y, theta = episode.low_dim[:, :3].T
    tx, ty, _, _, _, qz, qw = episode.low_dim[:, 3:10].T
    assert np.abs(x - tx).max() < 0.2  # a tenth of a second apart at most, at two units a second
    assert np.abs(y - ty).max() < 0.2
    assert np.abs(np.angle(np.exp(1j * (2 * np.arctan2(qz, qw) - theta)))).max() < 0.5
    assert np.abs(np.linalg.norm(episode.low_dim[:, 6:10], axis=1) - 1).max() < 1e-6
    assert (np.sum(episode.low_dim[1:, 6:10] * episode.low_dim[:-1, 6:10], axis=1) > 0).all()
    assert np.median(np.abs(x - tx)) < 1e-3
    assert np.linalg.norm(episode.low_dim[-1, 10:12]) < np.linalg.norm(episode.low_dim[:, 10:12], axis=1).max()
