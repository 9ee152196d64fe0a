"""What a message's vector is where the task names no fields: the usual numbers of the schemas that robots write. Pure.

Poses and transforms are seven numbers, position then quaternion x y z w; twists, accelerations and wrenches six. Odometry is its pose
alone: its twist is the field `twist.twist`. Covariances, times and identifiers are never among the usual numbers, and of a
trajectory with several points nobody but the user knows which one is meant.
"""

from __future__ import annotations

ROTATION = ("x", "y", "z", "w")

PARTS_OF: dict[frozenset[str], tuple[str, ...]] = {
    frozenset(parts): parts
    for parts in (
        ("x", "y"), ("x", "y", "z"), ROTATION, ("x", "y", "theta"),
        ("position", "orientation"), ("translation", "rotation"), ("linear", "angular"), ("force", "torque"),
    )
}  # fmt: skip
"""Messages that are nothing but numbers, by their members: a path may end at one, and takes its numbers in this order."""

ONE_POINT = ("points[0].positions",)
"""A trajectory's only point. Of several, a task has to say which one is the command."""

_POSE = ("position", "orientation")
_TRANSFORM = ("translation", "rotation")
_TWIST = ("linear", "angular")
_WRENCH = ("force", "torque")
_XYZ = ("x", "y", "z")

_FIELDS: dict[str, tuple[str, ...]] = {
    "sensor_msgs/JointState": ("position",),
    "sensor_msgs/Joy": ("axes", "buttons"),
    "sensor_msgs/Imu": ("angular_velocity", "linear_acceleration"),
    "sensor_msgs/MagneticField": ("magnetic_field",),
    "sensor_msgs/NavSatFix": ("latitude", "longitude", "altitude"),
    "sensor_msgs/Range": ("range",),
    "sensor_msgs/Temperature": ("temperature",),
    "sensor_msgs/FluidPressure": ("fluid_pressure",),
    "sensor_msgs/Illuminance": ("illuminance",),
    "sensor_msgs/RelativeHumidity": ("relative_humidity",),
    "geometry_msgs/Pose": _POSE,
    "geometry_msgs/PoseStamped": ("pose",),
    "geometry_msgs/PoseWithCovariance": ("pose",),
    "geometry_msgs/PoseWithCovarianceStamped": ("pose.pose",),
    "geometry_msgs/Pose2D": ("x", "y", "theta"),
    "geometry_msgs/Transform": _TRANSFORM,
    "geometry_msgs/TransformStamped": ("transform",),
    "geometry_msgs/Twist": _TWIST,
    "geometry_msgs/TwistStamped": ("twist",),
    "geometry_msgs/TwistWithCovariance": ("twist",),
    "geometry_msgs/TwistWithCovarianceStamped": ("twist.twist",),
    "geometry_msgs/VelocityStamped": ("velocity",),
    "geometry_msgs/Accel": _TWIST,
    "geometry_msgs/AccelStamped": ("accel",),
    "geometry_msgs/AccelWithCovariance": ("accel",),
    "geometry_msgs/AccelWithCovarianceStamped": ("accel.accel",),
    "geometry_msgs/Wrench": _WRENCH,
    "geometry_msgs/WrenchStamped": ("wrench",),
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Point32": _XYZ,
    "geometry_msgs/PointStamped": ("point",),
    "geometry_msgs/Vector3": _XYZ,
    "geometry_msgs/Vector3Stamped": ("vector",),
    "geometry_msgs/Quaternion": ROTATION,
    "geometry_msgs/QuaternionStamped": ("quaternion",),
    "nav_msgs/Odometry": ("pose.pose",),
    "turtlesim/Pose": ("x", "y", "theta"),
    "trajectory_msgs/JointTrajectory": ONE_POINT,
    "trajectory_msgs/JointTrajectoryPoint": ("positions",),
    "control_msgs/GripperCommand": ("position",),
    "ackermann_msgs/AckermannDrive": ("steering_angle", "speed"),
    "ackermann_msgs/AckermannDriveStamped": ("drive.steering_angle", "drive.speed"),
    "foxglove.JointState": ("position",),
    "foxglove.JointStates": ("joints.position",),
    "foxglove.Pose": _POSE,
    "foxglove.PoseInFrame": ("pose",),
    "foxglove.Odometry": ("pose",),
    "foxglove.FrameTransform": _TRANSFORM,
    "foxglove.Point2": ("x", "y"),
    "foxglove.Point3": _XYZ,
    "foxglove.Point3InFrame": ("point",),
    "foxglove.Vector2": ("x", "y"),
    "foxglove.Vector3": _XYZ,
    "foxglove.Quaternion": ROTATION,
    "foxglove.LocationFix": ("latitude", "longitude", "altitude"),
    **{
        f"std_msgs/{kind}{shape}": ("data",)
        for kind in (
            "Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64", "Byte",
        )
        for shape in ("", "MultiArray")
    },
    "std_msgs/Bool": ("data",),
    "std_msgs/Char": ("data",),
}  # fmt: skip


def usual_fields(schema: str) -> tuple[str, ...] | None:
    """The usual fields of a schema, by any of its names: `geometry_msgs/msg/Pose`, `geometry_msgs/Pose`, `foxglove_msgs/msg/Pose`
    for `foxglove.Pose`. None for a schema that is not known."""
    name = schema.replace("/msg/", "/")
    return _FIELDS.get("foxglove." + name.removeprefix("foxglove_msgs/") if name.startswith("foxglove_msgs/") else name)
