"""The names that a log gives its numbers are kept from ingest to wherever the numbers are shown, and decide no key."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.export_datasets import demonstration, write
from tests.generated_episodes import generated_dataset
from tests.json_log import Said, image, joints, transform, write_json_log
from tests.lerobot_folders import CAMERA, write_v21
from tests.real_data import real_data
from tests.test_viewer import series_names
from vilp_data.check.dataset import check_dataset
from vilp_data.dataset_card import make_card
from vilp_data.decode import decode_vector
from vilp_data.decode.column_names import LONGEST_NAME, column_names
from vilp_data.decode.numeric_fields import numeric_paths
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import DecodeError
from vilp_data.export import export_dataset
from vilp_data.ingest import IngestReport, ingest_logs
from vilp_data.spec import TaskSpec, task_from_dict
from vilp_data.types import Message
from vilp_data.viewer import draw_episode
from vilp_data.viewer.generated import draw_generated
from vilp_data.viewer.generated_page import write_generated_page

XYZ = {"x": 1, "y": 2, "z": 3}
JOINTS = {"name": ["hip", "knee"], "position": [1.0, 2.0], "velocity": [3.0, 4.0]}
JOINT_STATE = "sensor_msgs/msg/JointState"


def message(body: Any, schema: str = "custom/msg/Thing") -> Message:
    return Message("/t", schema, 5, 5, body)


@pytest.mark.parametrize(
    ("body", "fields", "names", "expected"),
    [
        (JOINTS, [], [], ["hip", "knee"]),
        (JOINTS, ["position[1:2]"], [], ["knee"]),
        (JOINTS, ["position[1]"], [], ["knee"]),
        (JOINTS, ["msg.position[-1]"], [], ["knee"]),
        (JOINTS, ["position", "velocity"], [], ["position.hip", "position.knee", "velocity.hip", "velocity.knee"]),
        (JOINTS, [], ["knee", "hip"], ["knee", "hip"]),
        (JOINTS, ["position", "velocity"], ["knee"], ["position.knee", "velocity.knee"]),
        (JOINTS | {"name": []}, ["position[0:2]"], [], ["0", "1"]),
        (JOINTS | {"name": [7, None]}, ["position"], [], ["0", "1"]),
        (JOINTS | {"name": ["of one alone"]}, ["position[1]"], [], ["position[1]"]),
        ({"arm": JOINTS, "name": ["far", "away"]}, ["arm.velocity"], [], ["hip", "knee"]),
        ({"joint_names": ["hip", "knee"], "points": [{"positions": [5, 6]}]}, ["points[-1].positions"], [], ["hip", "knee"]),
        ({"joints": [{"name": "hip", "position": 1.0}, {"name": "knee", "position": 2.0}]}, ["joints.position"], [], ["hip", "knee"]),
        ({"pose": {"position": XYZ}}, ["pose.position.x", "pose.position.z"], [], ["x", "z"]),
        ({"pose": {"position": XYZ}}, ["pose.position"], [], ["x", "y", "z"]),
        ({"linear": XYZ, "angular": XYZ}, ["linear.x", "angular.x"], [], ["linear.x", "angular.x"]),
        ({"data": [[1, 2], [3, 4]]}, ["data"], [], ["0", "1", "2", "3"]),
    ],
)  # fmt: skip
def test_every_number_is_called_what_its_message_calls_it(
    body: Any, fields: list[str], names: list[str], expected: list[str]
) -> None:
    said = message(body, JOINT_STATE)
    assert list(column_names(said, fields, names)) == expected
    assert len(decode_vector(said, fields, names)) == len(expected)


@pytest.mark.parametrize(
    ("shape", "fields", "expected"),
    [
        ((4,), [], ["a", "b", "c", "d"]),
        ((4,), ["[1:3]", "[0]"], ["b", "c", "a"]),
        ((2, 2), ["[1]"], ["c", "d"]),
        ((2, 2), ["[1][0:1]"], ["c"]),
        ((3,), ["[1:3]"], ["1", "2"]),
    ],
)
def test_the_names_of_an_array_follow_what_is_picked_of_it(
    shape: tuple[int, ...], fields: list[str], expected: list[str]
) -> None:
    said = message(np.zeros(shape), "array")
    assert list(column_names(said, fields, (), ["a", "b", "c", "d"])) == expected


MEMBERS = st.sampled_from(["name", "position", "joints", "x", "y", "z", "w", "orientation", "joint_names"])
BODIES = st.recursive(
    st.one_of(st.floats(-9, 9), st.text(max_size=3), st.none(), st.lists(st.floats(-9, 9), max_size=3)),
    lambda inner: st.one_of(st.dictionaries(MEMBERS, inner, max_size=4), st.lists(inner, max_size=3)),
    max_leaves=12,
)


@given(body=st.dictionaries(MEMBERS, BODIES, max_size=5))
def test_whatever_a_message_holds_its_numbers_have_as_many_names(body: dict[str, Any]) -> None:
    for path in numeric_paths(body):
        said = message(body)
        try:
            vector = decode_vector(said, [path])
        except DecodeError:
            continue
        assert len(column_names(said, [path])) == len(vector)


def test_a_name_is_one_line_that_can_be_stored_and_read() -> None:
    said = message(np.zeros(2), "array")
    first, second = column_names(said, (), (), ["left\n\narm \ud800", "x" * 10_000])
    assert first == "left arm ?"
    assert second == "x" * LONGEST_NAME


# --- from the log to what is shown --------------------------------------------------------------------------------------


def whole(**overrides: Any) -> TaskSpec:
    """A task that takes whole features, and so knows nothing of their numbers."""
    table: dict[str, Any] = {
        "name": "two_joints", "rate_hz": 30.0,
        "views": {"top": {"topic": CAMERA, "clock": "log", "height": 32, "width": 160}},
        "low_dim": {"joints": {"topic": "observation.state", "clock": "log"}},
        "action": {"joints": {"topic": "action", "clock": "log"}},
    }  # fmt: skip
    return TaskSpec.model_validate(table | overrides)


def ingested(tmp_path: Path, spec: TaskSpec | None = None) -> EpisodeStore:
    log = write_v21(tmp_path / "log", lengths=(12, 9), images="image").path
    report = ingest_logs([log], tmp_path / "data", spec or whole(), workers=1)
    assert (len(report.written), report.failed) == (2, [])
    return EpisodeStore(tmp_path / "data")


def test_a_lerobot_log_s_names_reach_the_card_the_export_and_the_check(tmp_path: Path) -> None:
    store = ingested(tmp_path)
    card = make_card(store).markdown
    assert "| `low_dim[1]` | joints.two |" in card
    assert "| `action[0]` | joints.one |" in card
    export_dataset(store.root, tmp_path / "out", "lerobot", images="png")
    features = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    assert features["observation.state"]["names"] == ["joints.one", "joints.two"]
    assert features["action"]["names"] == ["joints.one"]
    told = json.dumps(check_dataset(store.root).as_dict())
    assert "low_dim[" not in told


def test_the_viewer_s_plots_bear_the_log_s_names(tmp_path: Path) -> None:
    store = ingested(tmp_path)
    rrd = draw_episode(store, store.index()[0].id, tmp_path / "a.rrd").rrd
    assert series_names(rrd, "low_dim/joints") == ["one", "two"]
    assert series_names(rrd, "action/joints") == ["one"]


def test_a_generated_episode_s_curves_bear_the_log_s_names(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path / "data")
    entry = replace(store.entry(made.episode), column_names={"action": {"hand": ["reach", "grip"]}})
    store.rewrite_entry(entry)
    store.write_index()
    table = store.spec().model_dump(mode="json", by_alias=True) | {"action": {"hand": {"topic": "/hand"}}}
    store.write_spec(task_from_dict(table, where="test"))
    rrd = draw_generated(store, made, tmp_path / "a.rrd").rrd
    assert series_names(rrd, "action/hand/predicted") == ["reach predicted", "grip predicted"]
    write_generated_page(tmp_path / "a.html", store, made)
    assert "hand grip" in (tmp_path / "a.html").read_text()


def test_an_index_range_of_a_feature_keeps_its_names(tmp_path: Path) -> None:
    part = {"topic": "observation.state", "clock": "log", "fields": ["[1:2]"]}
    store = ingested(tmp_path, whole(low_dim={"second": part}))
    assert "| `low_dim[0]` | second.two |" in make_card(store).markdown


def test_an_action_taken_from_a_state_has_the_state_s_names(tmp_path: Path) -> None:
    store = ingested(tmp_path, whole(action={"next": {"from": "joints"}}))
    assert "| `action[1]` | next.two |" in make_card(store).markdown


def test_joints_and_frames_of_a_ros_log_are_named(tmp_path: Path) -> None:
    said = [image(k / 10, index=k) for k in range(12)]
    said += [joints(k / 10, ["hip", "knee"], [k, -k]) for k in range(12)]
    said += [transform(k / 10, "base", "tool", float(k)) for k in range(12)]
    low_dim = {
        "leg": {"topic": "/joint_states"},
        "tool": {"topic": "/tf", "from_frame": "base", "to_frame": "tool"},
    }
    store, _ = ingested_json(tmp_path, said, low_dim=low_dim)
    assert store.index()[0].column_names["low_dim"] == {
        "leg": ["hip", "knee"],
        "tool": [f"translation.{axis}" for axis in "xyz"] + [f"rotation.{axis}" for axis in "xyzw"],
    }


def ingested_json(tmp_path: Path, *logs: list[Said], low_dim: dict[str, Any]) -> tuple[EpisodeStore, IngestReport]:
    paths = [write_json_log(tmp_path / f"{number}.mcap", said) for number, said in enumerate(logs)]
    views = {"front": {"topic": "/camera/front/image", "height": 48, "width": 64}}
    spec = TaskSpec.model_validate({"name": "x", "rate_hz": 10.0, "views": views, "low_dim": low_dim})
    report = ingest_logs(paths, tmp_path / "data", spec, workers=1)
    assert report.failed == []
    return EpisodeStore(tmp_path / "data"), report


def test_logs_that_name_a_column_differently_are_said_to(tmp_path: Path) -> None:
    def log(names: list[str], first: int) -> list[Said]:
        frames = [image(k / 10, index=k + first) for k in range(12)]
        return [*frames, *(joints(k / 10, names, [k, -k, 0.5]) for k in range(12))]

    logs = log(["hip", "knee", "toe"], 0), log(["knee", "hip", "toe"], 3)
    store, report = ingested_json(tmp_path, *logs, low_dim={"leg": {"topic": "/joint_states"}})
    assert any("low_dim.leg" in note and "differently" in note and "`names`" in note for note in report.notes)
    card = make_card(store).markdown
    assert "Logs name the numbers of low_dim.leg differently" in card
    assert "| `low_dim[0]` | leg.0 |" in card
    assert "| `low_dim[2]` | leg.toe |" in card


# --- what names must not change -----------------------------------------------------------------------------------------


def test_names_decide_no_key_and_no_content(tmp_path: Path) -> None:
    store = ingested(tmp_path)
    before = {entry.id: (entry.key, entry.content_sha256, entry.source_sha256) for entry in store.index()}
    info = tmp_path / "log/meta/info.json"
    info.write_text(info.read_text().replace('"two"', '"too"'))
    report = ingest_logs([tmp_path / "log"], tmp_path / "again", whole(), workers=1)
    again = EpisodeStore(tmp_path / "again")
    assert {entry.id: (entry.key, entry.content_sha256, entry.source_sha256) for entry in again.index()} == before
    assert again.index()[0].column_names != store.index()[0].column_names
    assert sorted(report.written) == sorted(before)
    assert ingest_logs([tmp_path / "log"], tmp_path / "data", whole(), workers=1).written == []


def test_what_the_task_says_already_is_not_said_again(tmp_path: Path) -> None:
    part = {"topic": "observation.state", "clock": "log", "fields": ["[0:2]"]}
    log = write_v21(tmp_path / "log", lengths=(12,), images="image").path
    info = log / "meta/info.json"
    info.write_text(info.read_text().replace('{"motors": ["one", "two"]}', "null"))
    spec = whole(low_dim={"joints": part}, action={})
    ingest_logs([log], tmp_path / "data", spec, workers=1)
    (entry,) = EpisodeStore(tmp_path / "data").index()
    assert entry.column_names == {}


def test_a_dataset_from_before_there_were_names_reads_as_it_did(tmp_path: Path) -> None:
    store = write(tmp_path, demonstration("old", 6))
    table = pq.read_table(store.index_path)
    pq.write_table(table.drop_columns(["column_names"]), store.index_path)
    (entry,) = store.index()
    assert entry.column_names == {}
    assert "| `low_dim[1]` | arm.1 |" in make_card(store).markdown


@pytest.mark.slow
def test_a_real_robot_s_joints_keep_their_names(tmp_path: Path) -> None:
    views = {"head": {"topic": "observation.images.cam_high", "clock": "log", "height": 24, "width": 32}}
    spec = whole(name="g1", rate_hz=None, views=views)
    ingest_logs([real_data("g1_inspire_lerobot")], tmp_path, spec, workers=1)
    card = make_card(EpisodeStore(tmp_path)).markdown
    assert "| `low_dim[0]` | joints.kLeftShoulderPitch |" in card
    assert "| `action[25]` | joints.kRightHandThumbRotation |" in card
