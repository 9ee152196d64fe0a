"""MCAP logs whose cameras are compressed video or depth, with joints and commands beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message as Protobuf
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

from tests.synthetic import START_NS
from tests.video_packets import Encoded, video_message
from vilp_data.spec import TaskSpec

VIDEO, DEPTH, JOINTS = "/camera/video", "/camera/depth", "/joints"
RATE_HZ = 10
PERIOD_NS = 10**9 // RATE_HZ


class Row(NamedTuple):
    """A message, logged at `time_ns` and stamped so unless told otherwise."""

    time_ns: int
    topic: str
    body: Protobuf
    stamp_ns: int | None = None


def write_log(path: Path, rows: Sequence[Row], **options: Any) -> Path:
    """Messages as one MCAP file, in order of log time."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=options.pop("chunk_size", 4000), **options)
        writer.start()
        channels: dict[str, int] = {}
        for time_ns, topic, body, stamp_ns in sorted(rows, key=lambda row: row.time_ns):
            if topic not in channels:
                descriptors = build_file_descriptor_set(type(body)).SerializeToString()
                schema = writer.register_schema(body.DESCRIPTOR.full_name, "protobuf", descriptors)
                channels[topic] = writer.register_channel(topic, "protobuf", schema)
            body.timestamp.FromNanoseconds(time_ns if stamp_ns is None else stamp_ns)  # type: ignore[attr-defined]
            writer.add_message(channels[topic], time_ns, body.SerializeToString(), time_ns)
        writer.finish()
    return path


def joints(count: int, *, rate_hz: int = RATE_HZ, first_s: float = 0.0) -> list[Row]:
    """Joint `t` says how many seconds after the start it was, and `first_s` more."""
    times = [START_NS + i * 10**9 // rate_hz for i in range(count)]
    said = [first_s + (t - START_NS) / 1e9 for t in times]
    return [
        Row(t, JOINTS, JointStates(joints=[{"name": "t", "position": at}])) for t, at in zip(times, said, strict=True)
    ]


def write_video(path: Path, sent: Sequence[Encoded], name: str, **options: Any) -> Path:
    """A log of one video at RATE_HZ: the packet that shows frame i is stamped i periods after the start, and logged as it was sent."""
    rows = [
        Row(
            START_NS + number * PERIOD_NS,
            VIDEO,
            video_message(packet.data, name).body,
            START_NS + packet.shows * PERIOD_NS,
        )
        for number, packet in enumerate(sent)
    ]
    return write_log(path, [*rows, *joints(len(sent))], **options)


def write_depth(
    path: Path, images: Sequence[npt.NDArray[Any]], encoding: str, *, topic: str = DEPTH, **options: Any
) -> Path:
    """A log of raw depth images [H,W] at RATE_HZ."""
    rows = []
    for number, image in enumerate(images):
        height, width = image.shape
        data = np.ascontiguousarray(image).astype(image.dtype.newbyteorder("<")).tobytes()
        step = width * image.dtype.itemsize
        body = RawImage(height=height, width=width, encoding=encoding, step=step, data=data, frame_id="depth")
        rows.append(Row(START_NS + number * PERIOD_NS, topic, body))
    return write_log(path, [*rows, *joints(len(images))], **options)


def spec_of(topic: str, *, rate_hz: float | None = RATE_HZ, **view: Any) -> TaskSpec:
    """A task of one view, `camera`, with the joints as low_dim and, one step ahead, as action."""
    table: dict[str, Any] = {
        "name": "camera",
        "rate_hz": rate_hz,
        "views": {"camera": {"topic": topic, "height": 64, "width": 96} | view},
        "low_dim": {"joints": {"topic": JOINTS, "names": ["t"]}},
        "action": {"next": {"from": "joints", "shift": 1}},
    }
    return TaskSpec.model_validate(table)
