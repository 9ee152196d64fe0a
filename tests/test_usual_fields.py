"""Every message that robots write gives its vector without being asked for fields, by any name of its type, or says which it has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from rosbags.typesys import Stores, get_typestore

from vilp_data.decode.usual_fields import usual_fields
from vilp_data.decode.vectors import concerns, decode_vector, rotation_columns
from vilp_data.errors import DecodeError
from vilp_data.types import Message

STORE = get_typestore(Stores.ROS2_HUMBLE)
N_ELEMENTS = 3


def filled(type_name: str, counter: list[float]) -> Any:
    """A ROS message whose numbers count up from 1 in the order of its definition, lists with N_ELEMENTS of them."""

    def value(kind: int, detail: Any) -> Any:
        if kind == 2:  # a message
            return filled(detail, counter)
        if kind == 1:
            name = detail[0]
            if name == "string":
                return "x"
            counter[0] += 1
            return bool(counter[0]) if name == "bool" else counter[0] if "float" in name else int(counter[0])
        inner, size = detail
        items = [value(*inner) for _ in range(size or N_ELEMENTS)]
        return items if inner[0] == 2 or inner[1][0] == "string" else np.array(items)

    fields = STORE.fielddefs[type_name][1]
    return STORE.types[type_name](**{name: value(int(node[0]), node[1]) for name, node in fields})


def message(schema: str, body: Any) -> Message:
    return Message("/t", schema, 5, 5, body)


@pytest.mark.parametrize(
    ("type_name", "size"),
    [
        ("sensor_msgs/msg/JointState", 3), ("geometry_msgs/msg/Pose", 7), ("geometry_msgs/msg/PoseStamped", 7),
        ("geometry_msgs/msg/PoseWithCovariance", 7), ("geometry_msgs/msg/PoseWithCovarianceStamped", 7),
        ("nav_msgs/msg/Odometry", 7), ("geometry_msgs/msg/Pose2D", 3), ("geometry_msgs/msg/TransformStamped", 7),
        ("geometry_msgs/msg/Twist", 6), ("geometry_msgs/msg/TwistStamped", 6), ("geometry_msgs/msg/TwistWithCovarianceStamped", 6),
        ("geometry_msgs/msg/Wrench", 6), ("geometry_msgs/msg/WrenchStamped", 6), ("geometry_msgs/msg/AccelStamped", 6),
        ("geometry_msgs/msg/PointStamped", 3), ("geometry_msgs/msg/Vector3Stamped", 3), ("geometry_msgs/msg/QuaternionStamped", 4),
        ("sensor_msgs/msg/Imu", 6), ("sensor_msgs/msg/Joy", 6), ("trajectory_msgs/msg/JointTrajectoryPoint", 3),
        ("std_msgs/msg/Float32MultiArray", 3), ("std_msgs/msg/Float64", 1), ("std_msgs/msg/Int16MultiArray", 3), ("std_msgs/msg/Bool", 1),
        ("std_msgs/msg/UInt8MultiArray", 3),
    ],
)  # fmt: skip
def test_the_usual_types_of_ros_have_a_vector(type_name: str, size: int) -> None:
    body = filled(type_name, [0.0])
    vector = decode_vector(message(type_name, body))
    assert vector.dtype == np.float64
    assert len(vector) == size
    ros1 = type_name.replace("/msg/", "/")
    assert decode_vector(message(ros1, body)).tolist() == vector.tolist()


def test_a_pose_is_position_then_quaternion_xyzw_and_a_covariance_is_no_part_of_it() -> None:
    odometry = filled("nav_msgs/msg/Odometry", [0.0])
    pose, twist = odometry.pose.pose, odometry.twist.twist
    expected = [pose.position.x, pose.position.y, pose.position.z]
    expected += [pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w]
    assert decode_vector(message("nav_msgs/msg/Odometry", odometry)).tolist() == expected
    speeds = [twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y, twist.angular.z]
    assert decode_vector(
        message("nav_msgs/msg/Odometry", odometry), ["twist.twist", "pose.pose.position"]
    ).tolist() == [
        *speeds,
        *expected[:3],
    ]


def test_protobuf_poses_read_the_same() -> None:
    pose = {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0, "y": 0, "z": 0.6, "w": 0.8}}
    for schema, body in (("foxglove.PoseInFrame", PoseInFrame(pose=pose)), ("foxglove.Odometry", Odometry(pose=pose))):
        assert decode_vector(message(schema, body)).tolist() == [1, 2, 3, 0, 0, 0.6, 0.8]
    assert usual_fields("foxglove_msgs/msg/PoseInFrame") == usual_fields("foxglove.PoseInFrame")


BODY = {
    "position": [1.0, 2.0, 3.0],
    "rows": [[4.0, 5.0], [6.0, 7.0]],
    "deep": {"speed": {"x": 8, "y": 9, "z": 10}},
    "on": True,
}


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("position[0:2]", [1, 2]), ("msg.position[0:2]", [1, 2]), ("msg.deep.speed", [8, 9, 10]), ("rows", [4, 5, 6, 7]),
        ("rows[1]", [6, 7]), ("rows[1][0]", [6]), ("deep.speed.y", [9]), ("on", [1]),
    ],
)  # fmt: skip
def test_any_number_is_found_by_its_path_with_or_without_msg(path: str, expected: list[float]) -> None:
    assert decode_vector(message("own/Type", BODY), [path]).tolist() == expected


def test_msg_is_a_field_where_a_message_has_one() -> None:
    assert decode_vector(message("own/Type", {"msg": {"a": 5}, "a": 6}), ["msg.a"]).tolist() == [5]


def test_a_bare_array_may_be_called_msg() -> None:
    assert decode_vector(message("array", np.arange(4.0)), ["msg[1:3]"]).tolist() == [1, 2]


@pytest.mark.parametrize(("path", "expected"), [("rows[-1]", [6, 7]), ("rows[-2][-1]", [5]), ("position[-3]", [1])])
def test_lists_are_counted_from_their_end_too(path: str, expected: list[float]) -> None:
    assert decode_vector(message("own/Type", BODY), [path]).tolist() == expected


@pytest.mark.parametrize("path", ["rows[-3]", "rows[2]", "position[1:1]", "position[-2:3]", "position[0:4]"])
def test_a_path_that_reaches_outside_its_list_is_refused(path: str) -> None:
    with pytest.raises(DecodeError, match="reaches outside its list"):
        decode_vector(message("own/Type", BODY), [path])


def test_of_a_trajectory_with_several_points_the_task_names_the_command() -> None:
    points = [SimpleNamespace(positions=np.array([float(k), 9.0])) for k in range(3)]
    body = SimpleNamespace(joint_names=["a", "b"], points=points)
    trajectory = message("trajectory_msgs/msg/JointTrajectory", body)
    with pytest.raises(DecodeError, match=r"which point of a trajectory(.|\n)*points\[-1\]\.positions"):
        decode_vector(trajectory)
    assert decode_vector(trajectory, ["points[-1].positions"]).tolist() == [2, 9]
    assert decode_vector(trajectory, ["points[0].positions"], ["b", "a"]).tolist() == [9, 0]


@pytest.mark.parametrize("nothing", [None, "x", {}, 10**400])
def test_a_number_that_is_none_is_refused_with_its_path(nothing: Any) -> None:
    pose = {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0, "y": 0, "z": nothing, "w": 1}}
    with pytest.raises(DecodeError, match="'pose'"):
        decode_vector(message("geometry_msgs/msg/PoseStamped", {"pose": pose}))


@pytest.mark.parametrize(
    ("fields", "columns"),
    [
        (["pose"], [3]), (["pose.orientation"], [0]), (["speed", "poses"], [4, 11]), (["pose.position"], []), (["quad"], []),
        (["pose.orientation.x", "pose.orientation.y", "pose.orientation.z", "pose.orientation.w"], [0]),
        (["pose.orientation.w", "pose.orientation.x", "pose.orientation.y", "pose.orientation.z"], []),
        ([f"quad[{k}]" for k in range(4)], []),
    ],
)  # fmt: skip
def test_rotations_are_found_where_a_vector_holds_them(fields: list[str], columns: list[int]) -> None:
    pose = {"position": dict.fromkeys("xyz", 1.0), "orientation": dict.fromkeys("xyzw", 0.5)}
    body = {"pose": pose, "poses": [pose, pose], "speed": 3.0, "quad": [0.5] * 4}
    assert list(rotation_columns(message("own/Type", body), fields)) == columns


def test_a_list_of_points_is_all_their_numbers() -> None:
    body = {"points": [{"x": 1, "y": 2, "z": 3}, {"x": 4, "y": 5, "z": 6}]}
    assert decode_vector(message("own/Type", body), ["points"]).tolist() == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("fields", [[], ["deep.sped"], ["nothing"]])
def test_errors_list_the_fields_that_hold_numbers(fields: list[str]) -> None:
    with pytest.raises(DecodeError) as refused:
        decode_vector(message("own/Type", BODY), fields)
    assert "position[0:3]" in str(refused.value)
    assert "deep.speed" in str(refused.value)


def test_a_message_of_other_joints_does_not_concern_a_vector_of_named_ones() -> None:
    arm = message("sensor_msgs/msg/JointState", {"name": ["elbow", "wrist"], "position": [1.0, 2.0]})
    assert concerns(arm, ["wrist"])
    assert concerns(arm, [])
    assert not concerns(arm, ["finger"])
    unnamed = message("sensor_msgs/msg/JointState", {"name": [], "position": [1.0]})
    assert concerns(unnamed, ["finger"])  # and reading it says that it has no names


def test_trajectories_pick_by_their_joint_names() -> None:
    body = SimpleNamespace(joint_names=["a", "b"], points=[SimpleNamespace(positions=np.array([1.0, 2.0]))])
    assert decode_vector(message("trajectory_msgs/msg/JointTrajectory", body), [], ["b", "a"]).tolist() == [2, 1]
