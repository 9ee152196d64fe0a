"""The names that a log gives its numbers are kept from ingest to wherever the numbers are shown, and decide no key."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.column_logs import ingested, ingested_json, whole
from tests.export_datasets import demonstration, write
from tests.generated_episodes import generated_dataset
from tests.json_log import image, joints, transform
from tests.lerobot_folders import write_v21
from tests.real_data import real_data
from tests.test_viewer import series_names
from vilp_data.dataset_card import make_card
from vilp_data.decode import decode_vector
from vilp_data.decode.column_names import ColumnNames
from vilp_data.decode.numeric_fields import numeric_paths
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import DecodeError
from vilp_data.export import export_dataset
from vilp_data.ingest import ingest_logs
from vilp_data.short_names import LONGEST_NAME
from vilp_data.task_toml import task_from_dict
from vilp_data.types import Message
from vilp_data.viewer import draw_episode
from vilp_data.viewer.generated import draw_generated
from vilp_data.viewer.generated_page import write_generated_page

XYZ = {"x": 1, "y": 2, "z": 3}
JOINTS = {"name": ["hip", "knee"], "position": [1.0, 2.0], "velocity": [3.0, 4.0]}
JOINT_STATE = "sensor_msgs/msg/JointState"


def message(body: Any, schema: str = "custom/msg/Thing") -> Message:
    return Message("/t", schema, 5, 5, body)


def named(said: Message, fields: Sequence[str] = (), topic_names: Sequence[str] = ()) -> list[str]:
    """What one message alone calls its numbers."""
    names = ColumnNames(fields, topic_names)
    names.add(said, len(decode_vector(said, fields)))
    return list(names.names)


HANDS = [{"name": "hip", "position": 1.0}, {"name": "knee", "position": 2.0}]


@pytest.mark.parametrize(
    ("body", "fields", "expected"),
    [
        (JOINTS, [], ["hip", "knee"]),
        (JOINTS, ["position[1:2]"], ["knee"]),
        (JOINTS, ["position[1]"], ["knee"]),
        (JOINTS, ["msg.position[-1]"], ["knee"]),
        (JOINTS, ["msg.position[0:2]"], ["hip", "knee"]),
        (JOINTS, ["[1:2]"], ["knee"]),
        (JOINTS, ["position", "velocity"], ["position.hip", "position.knee", "velocity.hip", "velocity.knee"]),
        (JOINTS | {"name": []}, [], ["", ""]),
        (JOINTS | {"name": []}, ["position"], ["", ""]),
        (JOINTS | {"name": [7, None]}, ["position"], ["", ""]),
        (JOINTS | {"name": ["same", "same"]}, ["position"], ["", ""]),
        ({"name": ["same", "same", "toe"], "position": [1, 2, 3]}, ["position"], ["", "", "toe"]),
        (JOINTS | {"name": ["left\x1b", "left\ud800"]}, ["position"], ["", ""]),
        (JOINTS | {"name": ["1", "0"]}, ["position[0:2]"], ["1", "0"]),
        ({"arm": JOINTS, "name": ["far", "away"]}, ["arm.velocity"], ["hip", "knee"]),
        ({"name": ["far", "away"], "arm": {"force": [1, 2]}}, ["arm.force"], ["", ""]),
        ({"joint_names": ["hip", "knee"], "points": [{"positions": [5, 6]}]}, ["points[-1].positions"], ["hip", "knee"]),
        ({"name": ["one", "two"], "robots": [{"at": [5, 6]}, {"at": [7, 8]}]}, ["robots[0].at"], ["", ""]),
        ({"joints": HANDS}, ["joints.position"], ["hip", "knee"]),
        ({"joints": HANDS}, ["joints[1:2].position"], ["knee"]),
        ({"joints": HANDS}, ["joints.position[1]"], ["knee"]),
        ({"joints": HANDS}, ["joints[0].position", "joints[1].position"], ["hip.position", "knee.position"]),
        ({"joints": [*HANDS, {"name": "", "position": 3}]}, ["joints.position"], ["hip", "knee", ""]),
        ({"pose": {"position": XYZ}}, ["pose.position"], ["x", "y", "z"]),
        ({"pose": {"position": XYZ, "orientation": XYZ | {"w": 4}}}, ["pose.position", "pose.orientation"],
         [*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw")]),
        ({"name": ["box", "cup"], "pose": [XYZ, XYZ]}, ["pose"], [f"{name}.{axis}" for name in ("box", "cup") for axis in "xyz"]),
        ({"poses": [XYZ, XYZ, XYZ]}, ["poses[1:3]"], [f"{place}.{axis}" for place in (1, 2) for axis in "xyz"]),
        ({"poses": [XYZ, XYZ, XYZ]}, ["poses[2:3]"], ["x", "y", "z"]),
        ({"data": [[1, 2], [3, 4]]}, ["data"], ["", "", "", ""]),
        ({"t": [[[1, 2]]]}, ["t[0][0]"], ["", ""]),
    ],
)  # fmt: skip
def test_every_number_is_called_what_its_message_calls_it(body: Any, fields: list[str], expected: list[str]) -> None:
    assert named(message(body, JOINT_STATE), fields) == expected


@pytest.mark.parametrize(
    "fields", [["pose.position.x", "pose.position.z"], ["position[0:2]"], ["speed", "position[1]"]]
)
def test_a_message_that_names_no_more_than_the_task_does_names_nothing(fields: list[str]) -> None:
    assert named(message({"pose": {"position": XYZ}, "position": [1, 2], "speed": 3}), fields) == []


@pytest.mark.parametrize(
    ("shape", "fields", "expected"),
    [
        ((4,), [], ["a", "b", "c", "d"]),
        ((4,), ["[1:3]", "[0]"], ["b", "c", "a"]),
        ((4,), ["msg[2:4]"], ["c", "d"]),
        ((2, 2), ["[1]"], ["c", "d"]),
        ((2, 2), ["[1][0:1]"], ["c"]),
        ((3,), ["[1:3]"], []),
        ((3,), [], ["", "", ""]),
    ],
)
def test_the_names_of_an_array_follow_what_is_picked_of_it(
    shape: tuple[int, ...], fields: list[str], expected: list[str]
) -> None:
    assert named(message(np.zeros(shape), "array"), fields, ["a", "b", "c", "d"]) == expected


# Each number says in its digits what it is of: 100 times its list, 10 times its item, and its axis.
LISTS = {"position": 100, "effort": 200}
THING = {
    "name": ["hip", "knee", "toe"],
    **{name: [of + 10 * item for item in range(3)] for name, of in LISTS.items()},
    "short": [300.0, 310.0],
    "rows": [[400, 401], [410, 411]],
    "points": [{"x": 500 + 10 * item, "y": 501 + 10 * item} for item in range(4)],
    "joints": [{"name": name, "angle": 600 + 10 * item} for item, name in enumerate(["hip", "knee", "toe"])],
    "pose": {"position": {"x": 700, "y": 701, "z": 702}, "orientation": {"x": 710, "y": 711, "z": 712, "w": 713}},
}
BRACKETS = st.one_of(
    st.integers(-4, 3).map(lambda place: f"[{place}]"),
    st.tuples(st.integers(0, 3), st.integers(1, 4)).map(lambda ends: f"[{ends[0]}:{ends[1]}]"),
)
ITEMS = st.lists(BRACKETS, max_size=2).map("".join)
PATHS = st.builds(
    "{}{}{}{}{}".format,
    st.sampled_from(["", "msg."]),
    st.sampled_from([*LISTS, "short", "rows", "points", "joints", "pose", "pose.position", "pose.orientation"]),
    ITEMS,
    st.sampled_from(["", ".angle", ".x"]),
    ITEMS,
)


@given(fields=st.lists(PATHS, min_size=1, max_size=3))
def test_no_number_is_called_what_another_is(fields: list[str]) -> None:
    said = message(THING)
    try:
        numbers = decode_vector(said, fields).astype(int).tolist()
    except DecodeError:
        return
    names = named(said, fields) or [""] * len(numbers)
    assert len(names) == len(numbers)
    told = [name for name in names if name]
    assert len(set(told)) == len(told)
    for name, number in zip(names, numbers, strict=True):
        for token in name.split(".") if name else ():
            if token in THING["name"]:
                assert THING["name"][number // 10 % 10] == token
                assert number // 100 in (1, 2, 6)
            elif token in ("x", "y", "z", "w"):
                assert "xyzw"[number % 10] == token
                assert number // 100 in (5, 7)
            elif token.isdigit():
                assert (number // 100, number // 10 % 10) == (5, int(token))
            else:
                assert token in ("angle", "joints", "points", "pose", "position", "orientation", "effort")


MEMBERS = st.sampled_from(["name", "position", "joints", "x", "y", "z", "w", "orientation", "joint_names"])
BODIES = st.recursive(
    st.one_of(st.floats(-9, 9), st.text(max_size=3), st.none(), st.lists(st.floats(-9, 9), max_size=3)),
    lambda inner: st.one_of(st.dictionaries(MEMBERS, inner, max_size=4), st.lists(inner, max_size=3)),
    max_leaves=12,
)


@given(body=st.dictionaries(MEMBERS, BODIES, max_size=5))
def test_whatever_a_message_holds_its_numbers_have_as_many_names(body: dict[str, Any]) -> None:
    for path in (*numeric_paths(body), *body):
        said = message(body)
        try:
            vector = decode_vector(said, [path])
        except DecodeError:
            continue
        assert len(named(said, [path])) in (0, len(vector))


def test_a_name_is_one_line_that_can_be_stored_and_read() -> None:
    names = named(
        message(np.zeros(4), "array"), (), ["left\n\narm \ud800", "x" * 10_000, "\x1b[31mred\x07", "\u202e\x00"]
    )
    assert names == ["left arm", "x" * LONGEST_NAME, "[31mred", ""]


# --- messages that say otherwise ------------------------------------------------------------------------------------------


@dataclass
class _State:
    name: list[str]
    position: Any


@dataclass
class _Arm(_State):
    velocity: Any


def told_by(*messages: Message, fields: Sequence[str] = ()) -> ColumnNames:
    names = ColumnNames(fields)
    for said in messages:
        names.add(said, len(decode_vector(said, fields)))
    return names


@pytest.mark.parametrize("kind", [dict, _State])
def test_an_order_that_changes_from_message_to_message_names_nothing(kind: Any) -> None:
    one, other = kind(name=["hip", "knee"], position=[1.0, 2.0]), kind(name=["knee", "hip"], position=[2.0, 1.0])
    same = told_by(*[message(one, JOINT_STATE)] * 3)
    assert (same.names, same.differ) == (("hip", "knee"), False)
    both = told_by(*(message(body, JOINT_STATE) for body in (one, one, other, one)))
    assert (both.names, both.differ) == (("", ""), True)


def test_lists_that_share_their_length_out_otherwise_name_nothing() -> None:
    one = {"joints": {"name": ["a", "b"], "now": [1.0, 2.0]}, "rest": {"name": ["c"], "now": [3.0]}}
    other = {"joints": one["rest"], "rest": one["joints"]}
    found = told_by(message(one), message(other), fields=["joints.now", "rest.now"])
    assert (found.names, found.differ) == (("", "", ""), True)


def test_typed_lists_that_share_their_length_out_otherwise_name_nothing() -> None:
    one, other = _Arm(["a", "b"], [1.0, 2.0], [3.0]), _Arm(["a", "b"], [1.0], [2.0, 3.0])
    found = told_by(message(one), message(one), message(other), fields=["position", "velocity"])
    assert (found.names, found.differ) == (("", "", ""), True)


def test_names_that_are_not_as_many_as_the_numbers_read_name_none() -> None:
    names = ColumnNames()
    names.add(message(JOINTS, JOINT_STATE), 3)
    assert names.names == ()


def test_a_message_of_another_type_is_looked_at_anew() -> None:
    typed, plain = _State(["hip", "knee"], [1.0, 2.0]), {"position": {"x": 1.0, "y": 2.0}}
    found = told_by(message(typed, JOINT_STATE), message(typed, JOINT_STATE), message(plain, JOINT_STATE))
    assert found.differ


def test_a_typed_message_is_looked_at_again_where_its_list_grows_before_an_index() -> None:
    one, other = _State(["a", "b"], np.array([1.0, 2.0])), _State(["a", "b", "c"], np.array([1.0, 2.0, 3.0]))
    found = told_by(message(one), message(one), message(other), fields=["position[-1]"])
    assert found.differ


# --- from the log to what is shown --------------------------------------------------------------------------------------


def test_a_lerobot_log_s_names_reach_the_card_the_export_and_the_check(tmp_path: Path) -> None:
    store = ingested(tmp_path)
    card = make_card(store).markdown
    assert "| `low_dim[1]` | `joints.two` |" in card
    assert "| `action[0]` | `joints.one` |" in card
    export_dataset(store.root, tmp_path / "out", "lerobot", images="png")
    features = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    assert features["observation.state"]["names"] == ["joints.one", "joints.two"]
    assert features["action"]["names"] == ["joints.one"]


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
    assert "| `low_dim[0]` | `second.two` |" in make_card(store).markdown


def test_an_action_taken_from_a_state_has_the_state_s_names(tmp_path: Path) -> None:
    store = ingested(tmp_path, whole(action={"next": {"from": "joints"}}))
    assert "| `action[1]` | `next.two` |" in make_card(store).markdown


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
    assert "| `low_dim[1]` | `arm.1` |" in make_card(store).markdown


@pytest.mark.slow
def test_a_real_robot_s_joints_keep_their_names(tmp_path: Path) -> None:
    views = {"head": {"topic": "observation.images.cam_high", "clock": "log", "height": 24, "width": 32}}
    spec = whole(name="g1", rate_hz=None, views=views)
    ingest_logs([real_data("g1_inspire_lerobot")], tmp_path, spec, workers=1)
    card = make_card(EpisodeStore(tmp_path)).markdown
    assert "| `low_dim[0]` | `joints.kLeftShoulderPitch` |" in card
    assert "| `action[25]` | `joints.kRightHandThumbRotation` |" in card
