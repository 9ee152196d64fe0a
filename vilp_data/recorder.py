"""Write one episode as one MCAP file, the way a robot's recorder would.

Every topic has its own rate. A message carries two times: its header stamp, when the thing was measured or commanded, and its log
time, when the recorder received it, a few milliseconds later. The latencies are drawn from a seeded generator per topic, and nothing
reads a clock, so the same messages give the same bytes.

Images are `foxglove.CompressedImage` (protobuf, JPEG 4:4:4); everything else is ROS 2 CDR with its full message definition. Foxglove,
Rerun and rosbags' deserialisers read both without any of this package.
"""

from __future__ import annotations

import heapq
import zlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.typesys import Stores, get_typestore

from vilp_data.errors import UsageError
from vilp_data.shards import atomic_file
from vilp_data.types import EPISODE_RECORD, MADE_FROM_RECORD, U8

JPEG_QUALITY = 95
CHUNK_BYTES = 512 * 1024
_ROS = get_typestore(Stores.ROS2_HUMBLE)
_IMAGE_SCHEMA = "foxglove.CompressedImage"
_JPEG_OPTIONS = [
    cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]  # fmt: skip

Vector = Sequence[float] | npt.NDArray[Any]


@dataclass(frozen=True)
class Latency:
    """From header stamp to log time: `least_s` plus a uniform draw up to `jitter_s`. Keep their sum below the topic's period."""

    least_s: float = 0.0
    jitter_s: float = 0.0


NO_LATENCY = Latency()
CAMERA_LATENCY = Latency(0.012, 0.008)  # exposure, compression, transport
SENSOR_LATENCY = Latency(0.0008, 0.0008)


class EpisodeRecorder:
    """Writes messages to an MCAP file that appears, whole, when the block ends without an exception.

        with EpisodeRecorder(path, metadata={"task": "hanoi"}) as log:
            log.image("/camera/front/image", stamp_ns, rgb)
            log.metadata["success"] = "true"

    `metadata` becomes the metadata record `episode`, the episode's tags, and may be added to until the block ends; `made_from` becomes the
    record `made_from`, which no dataset stores: by it a recorder knows its finished logs again. `seed` draws the latencies. Stamps
    are integer nanoseconds and may come in any order within `reorder_s`: messages are written in order of log time.
    StoreError where the file cannot be written.
    """

    def __init__(
        self, path: Path, *, metadata: Mapping[str, str], made_from: Mapping[str, str] | None = None, seed: int = 0,
        reorder_s: float = 0.5,
    ) -> None:  # fmt: skip
        self.metadata = dict(metadata)
        self._made_from = made_from
        self._path = path
        self._seed = seed
        self._reorder_ns = round(reorder_s * 1e9)
        self._stack = ExitStack()
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, _Channel] = {}
        self._pending: list[tuple[int, int, int, _Outgoing]] = []
        self._newest_ns = 0
        self._writer: Writer

    def __enter__(self) -> Self:
        file = self._stack.enter_context(atomic_file(self._path))
        self._writer = Writer(
            file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True
        )
        self._writer.start(profile="", library=f"vilp {version('vilp')}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack.pop_all() as stack:
            if error is not None:
                stack.__exit__(kind, error, trace)  # the temporary file goes, and the exception goes on
                return
            self._write_pending(None)
            self._writer.add_metadata(EPISODE_RECORD, {name: self.metadata[name] for name in sorted(self.metadata)})
            if self._made_from is not None:
                self._writer.add_metadata(MADE_FROM_RECORD, dict(self._made_from))
            self._writer.finish()

    # --- one method for each kind of message ---

    def image(
        self, topic: str, stamp_ns: int, rgb: U8, *, frame_id: str = "", latency: Latency = CAMERA_LATENCY
    ) -> None:
        """uint8 [H,W,3] RGB, top row first, as JPEG."""
        if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
            raise UsageError("an image is uint8 [H,W,3] RGB", where=topic, found=f"{rgb.dtype} {rgb.shape}")
        data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), _JPEG_OPTIONS)[1].tobytes()
        message = CompressedImage(frame_id=frame_id or topic, data=data, format="jpeg")
        message.timestamp.FromNanoseconds(stamp_ns)
        self._send(topic, _IMAGE_SCHEMA, stamp_ns, message.SerializeToString(deterministic=True), latency)

    def joint_state(
        self, topic: str, stamp_ns: int, names: Sequence[str], position: Vector, velocity: Vector = (), *,
        latency: Latency = SENSOR_LATENCY,
    ) -> None:  # fmt: skip
        """sensor_msgs/msg/JointState: positions in rad or m (or a gripper's command), velocities per second or none."""
        fields = {"name": list(names), "position": _f64(position), "velocity": _f64(velocity), "effort": _f64(())}
        self._send_ros(topic, "sensor_msgs/msg/JointState", stamp_ns, {"header": _header(stamp_ns), **fields}, latency)

    def pose(
        self,
        topic: str,
        stamp_ns: int,
        position: Vector,
        quaternion_xyzw: Vector,
        *,
        frame_id: str,
        latency: Latency = SENSOR_LATENCY,
    ) -> None:
        """geometry_msgs/msg/PoseStamped: metres and a unit quaternion in `frame_id`."""
        pose = _ros(
            "geometry_msgs/msg/Pose", position=_xyz("Point", position), orientation=_quaternion(quaternion_xyzw)
        )
        fields = {"header": _header(stamp_ns, frame_id), "pose": pose}
        self._send_ros(topic, "geometry_msgs/msg/PoseStamped", stamp_ns, fields, latency)

    def twist(
        self,
        topic: str,
        stamp_ns: int,
        linear: Vector,
        angular: Vector,
        *,
        frame_id: str,
        latency: Latency = SENSOR_LATENCY,
    ) -> None:
        """geometry_msgs/msg/TwistStamped, in `frame_id`."""
        twist = _ros("geometry_msgs/msg/Twist", linear=_xyz("Vector3", linear), angular=_xyz("Vector3", angular))
        fields = {"header": _header(stamp_ns, frame_id), "twist": twist}
        self._send_ros(topic, "geometry_msgs/msg/TwistStamped", stamp_ns, fields, latency)

    def vector(self, topic: str, stamp_ns: int, data: Vector, *, latency: Latency = NO_LATENCY) -> None:
        """std_msgs/msg/Float64MultiArray. It has no header: its log time is its time, so by default it has no latency."""
        layout = _ros("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        self._send_ros(
            topic, "std_msgs/msg/Float64MultiArray", stamp_ns, {"layout": layout, "data": _f64(data)}, latency
        )

    # --- the file ---

    def _send_ros(self, topic: str, schema: str, stamp_ns: int, fields: Mapping[str, Any], latency: Latency) -> None:
        data = _ROS.serialize_cdr(_ros(schema, **fields), schema)
        self._send(topic, schema, stamp_ns, bytes(data), latency)

    def _send(self, topic: str, schema: str, stamp_ns: int, data: bytes, latency: Latency) -> None:
        channel = self._channel(topic, schema)
        log_time_ns = stamp_ns + channel.delay_ns(latency)
        outgoing = _Outgoing(channel.id, stamp_ns, channel.count, data)
        heapq.heappush(self._pending, (log_time_ns, channel.id, channel.count, outgoing))
        channel.count += 1
        self._newest_ns = max(self._newest_ns, log_time_ns)
        self._write_pending(self._newest_ns - self._reorder_ns)

    def _write_pending(self, before_ns: int | None) -> None:
        """Write what is due: log times before `before_ns`, or everything."""
        while self._pending and (before_ns is None or self._pending[0][0] < before_ns):
            log_time_ns, channel_id, sequence, message = heapq.heappop(self._pending)
            self._writer.add_message(
                channel_id, log_time_ns, message.data, publish_time=message.publish_time_ns, sequence=sequence
            )

    def _channel(self, topic: str, schema: str) -> _Channel:
        if topic not in self._channels:
            encoding = "protobuf" if schema == _IMAGE_SCHEMA else "cdr"
            identity = self._writer.register_channel(topic, encoding, self._schema(schema))
            delays = np.random.Generator(np.random.Philox(key=[self._seed, zlib.crc32(topic.encode())]))
            self._channels[topic] = _Channel(identity, schema, delays)
        channel = self._channels[topic]
        if channel.schema != schema:
            raise UsageError(
                "a topic carries one kind of message", where=topic, found=f"{channel.schema}, then {schema}"
            )
        return channel

    def _schema(self, name: str) -> int:
        if name not in self._schemas:
            if name == _IMAGE_SCHEMA:
                encoding, definition = (
                    "protobuf",
                    build_file_descriptor_set(CompressedImage).SerializeToString(deterministic=True),
                )
            else:
                encoding, definition = "ros2msg", _ROS.generate_msgdef(name, ros_version=2)[0].encode()
            self._schemas[name] = self._writer.register_schema(name, encoding, definition)
        return self._schemas[name]


@dataclass(frozen=True)
class _Outgoing:
    channel_id: int
    publish_time_ns: int
    sequence: int
    data: bytes


@dataclass
class _Channel:
    id: int
    schema: str
    delays: np.random.Generator
    count: int = 0

    def delay_ns(self, latency: Latency) -> int:
        return round((latency.least_s + latency.jitter_s * self.delays.random()) * 1e9)


def _ros(schema: str, **fields: Any) -> Any:
    return _ROS.types[schema](**fields)


def _header(stamp_ns: int, frame_id: str = "") -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return _ros(
        "std_msgs/msg/Header",
        stamp=_ros("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds),
        frame_id=frame_id,
    )


def _xyz(kind: str, values: Vector) -> Any:
    x, y, z = map(float, values)
    return _ros(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _quaternion(xyzw: Vector) -> Any:
    x, y, z, w = map(float, xyzw)
    return _ros("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _f64(values: Vector) -> npt.NDArray[np.float64]:
    return np.ascontiguousarray(values, np.float64)
