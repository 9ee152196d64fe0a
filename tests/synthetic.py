"""Tiny logs with known content, for every test that needs one.

    log = write_mcap(tmp_path / "run.mcap", encoding="protobuf", cameras=("front", "side"))
    log.frames["front"]       what the pixels were before any codec: uint8 [n,H,W,3]
    task_spec(log)            a TaskSpec that reads it

Frames show an asymmetric colour card with a marker that moves, so that swapped channels, flips and shifts all show. The joints
say what time it is: `joints_at(t)` and `action_at(t)` give the vectors of a message sent t seconds after the start.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import zarr
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.typesys import Stores, get_typestore

from vilp_data.spec import TaskSpec
from vilp_data.types import F64, I64, U8

Encoding = Literal["cdr", "protobuf", "json"]
Codec = Literal["jpeg", "png", "raw"]

START_NS = 1_700_000_000_000_000_000
HEADER_LAG_NS = 4_000_000  # messages are stamped this long before the recorder logs them
JOINTS = ("shoulder", "elbow", "wrist")
JOINT_TOPIC = "/joint_states"
ACTION_TOPIC = "/action"

# --- pictures -------------------------------------------------------------------------------------------------------


def colour_card(height: int = 48, width: int = 64) -> U8:
    """uint8 [height,width,3] RGB: a different colour in every corner, a white bar off the centre. No flip, transpose, channel
    swap or shift leaves it as it is."""
    card = np.full((height, width, 3), (110, 120, 130), np.uint8)
    tall, wide = height // 4, width // 4
    card[:tall, :wide] = (230, 20, 20)
    card[:tall, -wide:] = (20, 200, 20)
    card[-tall:, :wide] = (20, 20, 230)
    card[-tall:, -wide:] = (230, 220, 20)
    card[height // 3 : height // 3 + tall // 2, width // 3 : width // 3 + wide // 2] = 255
    return card


def card_frame(index: int, height: int = 48, width: int = 64) -> U8:
    """The colour card with a black marker that moves right, two pixels a frame, in the lower half."""
    frame = colour_card(height, width)
    left = 2 * index % (width - 6)
    frame[height * 5 // 8 : height * 5 // 8 + 4, left : left + 6] = 0
    return frame


def psnr(one: U8, other: U8) -> float:
    """Peak signal to noise ratio in dB; infinite for equal images."""
    error = float(np.mean((one.astype(np.float64) - other.astype(np.float64)) ** 2))
    return float("inf") if error == 0 else 10 * np.log10(255**2 / error)


def encode_image(image: U8, codec: Literal["jpeg", "png"]) -> bytes:
    """RGB -> JPEG (quality 95, 4:4:4) or PNG."""
    jpeg = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, data = cv2.imencode(".jpg" if codec == "jpeg" else ".png", image[..., ::-1], jpeg if codec == "jpeg" else [])
    assert done
    return data.tobytes()


# --- MCAP -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SyntheticLog:
    """What was written. Times are header stamps in ns; log times lie HEADER_LAG_NS later."""

    path: Path
    frames: Mapping[str, U8]  # camera -> [n,H,W,3]
    frame_times_ns: Mapping[str, I64]  # camera -> [n]
    joint_times_ns: I64
    joints: F64  # [m,3]
    action_times_ns: I64
    actions: F64  # [k,2]; empty where there are none


def joints_at(t_s: float) -> list[float]:
    """Joint positions t seconds after the start, in the order of JOINTS."""
    return [t_s, float(np.sin(t_s)), -2 * t_s]


def action_at(t_s: float) -> list[float]:
    """The command sent t seconds after the start."""
    return [10 + t_s, float(np.cos(t_s))]


def image_topic(camera: str) -> str:
    return f"/camera/{camera}/image"


def write_mcap(
    path: Path,
    *,
    encoding: Encoding = "cdr",
    image_codec: Codec = "jpeg",
    cameras: Sequence[str] = ("front",),
    n_frames: int = 20,
    height: int = 48,
    width: int = 64,
    camera_hz: float = 10.0,
    joint_hz: float = 50.0,
    action_hz: float = 10.0,
    jitter_s: float = 0.0,
    with_actions: bool = True,
    tags: Mapping[str, str] | None = None,
    seed: int = 0,
    **writer_options: Any,
) -> SyntheticLog:
    """One episode of n_frames camera images: card frames on every camera, joint states, and commands unless told otherwise.

    `jitter_s` moves every stamp by up to that much either way; `tags` become the metadata record `episode`; `writer_options`
    go to mcap's Writer (chunk_size, compression, use_chunking, ...)."""
    rng = np.random.default_rng(seed)
    duration_s = n_frames / camera_hz

    def times(rate_hz: float) -> I64:
        count = round(duration_s * rate_hz)
        offsets_s = np.arange(count) / rate_hz + rng.uniform(-jitter_s, jitter_s, count)
        return np.sort(START_NS + np.rint(offsets_s.clip(0) * 1e9).astype(np.int64))

    def vectors(stamps: I64, at: Any, size: int) -> F64:
        return np.array([at((t - START_NS) / 1e9) for t in stamps.tolist()], np.float64).reshape(-1, size)

    frames = {
        camera: np.stack([card_frame(i + 3 * c, height, width) for i in range(n_frames)])
        for c, camera in enumerate(cameras)
    }
    frame_times = {camera: times(camera_hz) for camera in cameras}
    joint_times, action_times = times(joint_hz), times(action_hz) if with_actions else np.empty(0, np.int64)
    joints, actions = vectors(joint_times, joints_at, 3), vectors(action_times, action_at, 2)

    messages: list[tuple[int, str, Any]] = []
    for camera in cameras:
        messages += [
            (t, image_topic(camera), image)
            for t, image in zip(frame_times[camera].tolist(), frames[camera], strict=True)
        ]
    messages += [(t, JOINT_TOPIC, vector) for t, vector in zip(joint_times.tolist(), joints, strict=True)]
    messages += [(t, ACTION_TOPIC, vector) for t, vector in zip(action_times.tolist(), actions, strict=True)]
    _write(path, sorted(messages, key=lambda message: message[0]), encoding, image_codec, tags, writer_options)
    return SyntheticLog(path, frames, frame_times, joint_times, joints, action_times, actions)


def _write(
    path: Path,
    messages: list[tuple[int, str, Any]],
    encoding: Encoding,
    codec: Codec,
    tags: Mapping[str, str] | None,
    options: dict[str, Any],
) -> None:
    make = {"cdr": _cdr, "protobuf": _protobuf, "json": _json}[encoding]
    options = {"compression": CompressionType.ZSTD, "chunk_size": 20_000} | options
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2" if encoding == "cdr" else "", library="synthetic")
        if tags is not None:
            writer.add_metadata("episode", dict(tags))
        channels: dict[str, int] = {}
        for sequence, (stamp, topic, value) in enumerate(messages):
            schema_name, schema_encoding, schema_data, data = make(stamp, topic, value, codec)
            if topic not in channels:
                schema_id = writer.register_schema(schema_name, schema_encoding, schema_data)
                channels[topic] = writer.register_channel(topic, encoding, schema_id)
            writer.add_message(channels[topic], stamp + HEADER_LAG_NS, data, stamp + HEADER_LAG_NS // 2, sequence)
        writer.finish()


def _joint_names(topic: str) -> tuple[str, ...]:
    return JOINTS if topic == JOINT_TOPIC else ("x", "y")


STORE = get_typestore(Stores.ROS2_HUMBLE)


def _cdr(stamp: int, topic: str, value: Any, codec: Codec) -> tuple[str, str, bytes, bytes]:
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    header = types["std_msgs/msg/Header"](stamp=time, frame_id="base")
    if value.ndim == 1:
        name, none = "sensor_msgs/msg/JointState", np.empty(0)
        body = types[name](header=header, name=list(_joint_names(topic)), position=value, velocity=none, effort=none)
    elif codec == "raw":
        name = "sensor_msgs/msg/Image"
        height, width, _ = value.shape
        pixels = value.reshape(-1)
        body = types[name](
            header=header, height=height, width=width, encoding="rgb8", is_bigendian=0, step=3 * width, data=pixels
        )
    else:
        name = "sensor_msgs/msg/CompressedImage"
        body = types[name](header=header, format=codec, data=np.frombuffer(encode_image(value, codec), np.uint8))
    definition = STORE.generate_msgdef(name, ros_version=2)[0]
    return name, "ros2msg", definition.encode(), bytes(STORE.serialize_cdr(body, name))


def _protobuf(stamp: int, topic: str, value: Any, codec: Codec) -> tuple[str, str, bytes, bytes]:
    timestamp = Timestamp(seconds=stamp // 10**9, nanos=stamp % 10**9)
    body: Any
    if value.ndim == 1:
        joints = [
            {"name": name, "position": position}
            for name, position in zip(_joint_names(topic), value.tolist(), strict=True)
        ]
        body = JointStates(timestamp=timestamp, joints=joints)
    elif codec == "raw":
        height, width, _ = value.shape
        body = RawImage(
            timestamp=timestamp, height=height, width=width, encoding="rgb8", step=3 * width, data=value.tobytes()
        )
    else:
        body = CompressedImage(timestamp=timestamp, frame_id=topic, format=codec, data=encode_image(value, codec))
    schema = build_file_descriptor_set(type(body)).SerializeToString()
    return body.DESCRIPTOR.full_name, "protobuf", schema, body.SerializeToString()


def _json(stamp: int, topic: str, value: Any, codec: Codec) -> tuple[str, str, bytes, bytes]:
    time = {"sec": stamp // 10**9, "nsec": stamp % 10**9}
    if value.ndim == 1:
        name = "sensor_msgs/msg/JointState"
        body = {"header": {"stamp": time}, "name": list(_joint_names(topic)), "position": value.tolist()}
    elif codec == "raw":
        name = "foxglove.RawImage"
        height, width, _ = value.shape
        data = base64.b64encode(value.tobytes()).decode()
        body = {
            "timestamp": time,
            "height": height,
            "width": width,
            "encoding": "rgb8",
            "step": 3 * width,
            "data": data,
        }
    else:
        name = "foxglove.CompressedImage"
        body = {"timestamp": time, "format": codec, "data": base64.b64encode(encode_image(value, codec)).decode()}
    return name, "jsonschema", b'{"type": "object"}', json.dumps(body).encode()


def task_spec(log: SyntheticLog, *, rate_hz: float | None = 10.0, **overrides: Any) -> TaskSpec:
    """A task that reads every camera, the joints and, where there are any, the actions of a synthetic log at its own sizes."""
    table: dict[str, Any] = {
        "name": "synthetic",
        "rate_hz": rate_hz,
        "views": {
            camera: {"topic": image_topic(camera), "height": f.shape[1], "width": f.shape[2]}
            for camera, f in log.frames.items()
        },
        "low_dim": {"joints": {"topic": JOINT_TOPIC, "names": list(JOINTS)}},
    }
    if len(log.actions):
        table["action"] = {"target": {"topic": ACTION_TOPIC}}
    return TaskSpec.model_validate(table | overrides)


# --- zarr -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SyntheticZarr:
    """What was written: rows of all episodes one after the other."""

    path: Path
    episode_ends: I64
    img: U8  # [rows,H,W,3]
    state: F64  # [rows,5], float32 on disk
    action: F64  # [rows,2], float32 on disk


def write_zarr(
    path: Path,
    *,
    episode_lengths: Sequence[int] = (12, 9, 5),
    height: int = 32,
    width: int = 32,
    image_dtype: str = "float32",
    chunk_rows: int = 7,
) -> SyntheticZarr:
    """A store in the diffusion-policy layout (zarr v2): data/img, data/state, data/action, meta/episode_ends. Row i's state is
    [i, i/10, -i, 0, 1], its action [i + 0.5, 2 i]."""
    ends = np.cumsum(episode_lengths).astype(np.int64)
    rows = np.arange(ends[-1], dtype=np.float64)
    img = np.stack([card_frame(i, height, width) for i in range(len(rows))])
    state = np.stack([rows, rows / 10, -rows, 0 * rows, 0 * rows + 1], axis=1)
    action = np.stack([rows + 0.5, 2 * rows], axis=1)
    root = zarr.create_group(path, zarr_format=2)
    data, meta = root.create_group("data"), root.create_group("meta")
    arrays = {"img": img.astype(image_dtype), "state": state.astype(np.float32), "action": action.astype(np.float32)}
    for name, array in arrays.items():
        data.create_array(name, data=array, chunks=(chunk_rows, *array.shape[1:]), config={"write_empty_chunks": True})
    meta.create_array("episode_ends", data=ends)
    return SyntheticZarr(path, ends, img, state, action)


def zarr_task_spec(*, height: int = 32, width: int = 32, rate_hz: float = 10.0, **overrides: Any) -> TaskSpec:
    """A task that reads a synthetic zarr store."""
    table: dict[str, Any] = {
        "name": "synthetic-zarr",
        "rate_hz": rate_hz,
        "views": {"top": {"topic": "img", "clock": "log", "height": height, "width": width}},
        "low_dim": {"agent": {"topic": "state", "clock": "log", "fields": ["[0:2]"]}},
        "action": {"target": {"topic": "action", "clock": "log"}},
        "state": {"topic": "state", "clock": "log"},
    }
    return TaskSpec.model_validate(table | overrides)
