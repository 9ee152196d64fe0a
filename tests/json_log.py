"""Small MCAP logs of JSON messages with whatever topics a test needs."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from mcap.writer import CompressionType, Writer

from tests.synthetic import card_frame, encode_image

S = 1_000_000_000
START_NS = 1_700_000_000 * S


class Said(NamedTuple):
    """A message: seconds after START_NS, topic, schema, body. Its header, where the body has none, says the same time."""

    t_s: float
    topic: str
    schema: str
    body: dict[str, Any]


def stamp(t_s: float) -> dict[str, int]:
    return {"sec": (START_NS + round(t_s * S)) // S, "nsec": (START_NS + round(t_s * S)) % S}


def write_json_log(path: Path, said: Iterable[Said], *, chunk_size: int = 50_000) -> Path:
    """An MCAP file of these messages, in order of time."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, chunk_size=chunk_size)
        writer.start(library="json log")
        channels: dict[tuple[str, str], int] = {}
        for message in sorted(said, key=lambda message: message.t_s):
            key = message.topic, message.schema
            if key not in channels:
                schema_id = writer.register_schema(message.schema, "jsonschema", b'{"type": "object"}')
                channels[key] = writer.register_channel(message.topic, "json", schema_id)
            time_ns = START_NS + round(message.t_s * S)
            writer.add_message(channels[key], time_ns, json.dumps(message.body).encode(), time_ns)
        writer.finish()
    return path


def image(t_s: float, topic: str = "/camera/front/image", *, index: int = 0, height: int = 48, width: int = 64) -> Said:
    """A colour card as PNG, its marker where `index` says."""
    data = base64.b64encode(encode_image(card_frame(index, height, width), "png")).decode()
    return Said(t_s, topic, "foxglove.CompressedImage", {"timestamp": stamp(t_s), "format": "png", "data": data})


def joints(t_s: float, names: list[str], positions: list[float], topic: str = "/joint_states") -> Said:
    body = {"header": {"stamp": stamp(t_s)}, "name": names, "position": positions}
    return Said(t_s, topic, "sensor_msgs/msg/JointState", body)


def number(t_s: float, value: Any, topic: str) -> Said:
    """A std_msgs number, which has no header."""
    kind = "Bool" if isinstance(value, bool) else "String" if isinstance(value, str) else "Float64"
    return Said(t_s, topic, f"std_msgs/msg/{kind}", {"data": value})


def transform(t_s: float, parent: str, child: str, x: float, topic: str = "/tf") -> Said:
    item = {
        "header": {"stamp": stamp(t_s), "frame_id": parent},
        "child_frame_id": child,
        "transform": {
            "translation": {"x": x, "y": 0.0, "z": 0.0},
            "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
    }
    return Said(t_s, topic, "tf2_msgs/msg/TFMessage", {"transforms": [item]})
