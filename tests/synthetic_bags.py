"""The messages of a synthetic MCAP log as ROS bags of every kind, written by rosbags.

log = write_mcap(tmp_path / "run.mcap", n_frames=6)          # CDR
write_rosbag1(tmp_path / "run.bag", log, compression="lz4")
write_rosbag2(tmp_path / "run", log, storage="sqlite3", parts=3)
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mcap.reader import make_reader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from tests.synthetic import STORE, SyntheticLog

ROS1_STORE = get_typestore(Stores.ROS1_NOETIC)
BAG = "rosbag2_bagfile_information"


class Raw(NamedTuple):
    """A message of the source: `definition` is its type's text."""

    topic: str
    type: str
    definition: str
    log_time_ns: int
    data: bytes


def raw_messages(log: SyntheticLog) -> list[Raw]:
    with log.path.open("rb") as stream:
        return [
            Raw(channel.topic, schema.name, schema.data.decode(), message.log_time, message.data)
            for schema, channel, message in make_reader(stream).iter_messages()
        ]


def write_rosbag1(
    path: Path, log: SyntheticLog, *, compression: Literal["none", "bz2", "lz4"] = "none", chunk_bytes: int = 4000
) -> Path:
    """One ROS 1 bag with the log's messages, in chunks of about `chunk_bytes`."""
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression != "none":
        writer.set_compression(Rosbag1Writer.CompressionFormat[compression.upper()])
    with writer:
        connections: dict[str, Any] = {}
        for raw in raw_messages(log):
            if raw.topic not in connections:
                connections[raw.topic] = writer.add_connection(raw.topic, raw.type, typestore=ROS1_STORE)
            writer.write(connections[raw.topic], raw.log_time_ns, _as_ros1(raw))
    return path


def _as_ros1(raw: Raw) -> bytes:
    """The message in ROS 1's own serialisation; its header has one field more."""
    body = STORE.deserialize_cdr(raw.data, raw.type)
    return bytes(ROS1_STORE.serialize_ros1(_with_sequence(body), raw.type))


def _with_sequence(body: Any) -> Any:
    types = ROS1_STORE.types
    stamp = types["builtin_interfaces/msg/Time"](body.header.stamp.sec, body.header.stamp.nanosec)
    header = types["std_msgs/msg/Header"](0, stamp, body.header.frame_id)
    fields = {
        name: getattr(body, name) for name in type(body).__dataclass_fields__ if name not in ("header", "__msgtype__")
    }
    return types[body.__msgtype__](header=header, **fields)


def write_rosbag2(
    folder: Path,
    log: SyntheticLog,
    *,
    storage: Literal["sqlite3", "mcap"] = "sqlite3",
    compression: Literal["none", "file", "message"] = "none",
    parts: int = 1,
    custom: dict[str, str] | None = None,
) -> Path:
    """One ROS 2 bag, a folder, with the log's messages cut into `parts` files of as many messages each."""
    messages = raw_messages(log)
    size = -(-len(messages) // parts)
    if parts == 1:
        _write_part(folder, messages, storage, compression, custom)
        return folder
    described = []
    folder.mkdir(parents=True)
    for number in range(parts):
        part = folder.with_name(f"{folder.name}_{number}")
        _write_part(part, messages[number * size : (number + 1) * size], storage, compression, custom)
        (file,) = (file for file in part.iterdir() if file.name != "metadata.yaml")
        file.rename(folder / file.name)
        described.append(YAML(typ="safe").load(part / "metadata.yaml")[BAG])
        shutil.rmtree(part)
    YAML().dump({BAG: _joined(described)}, folder / "metadata.yaml")
    return folder


def _joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """What metadata.yaml says of a bag of several files; the topics are those of the last."""
    names = [name for part in parts for name in part["relative_file_paths"]]
    counted = {"message_count": sum(part["message_count"] for part in parts)}
    return (
        parts[-1]
        | counted
        | {"relative_file_paths": names, "files": [file for part in parts for file in part["files"]]}
    )


def with_files(metadata: str, names: list[str]) -> str:
    """A metadata.yaml that lists these files instead; nothing else is changed."""
    lines, skipping = [], False
    for line in metadata.splitlines():
        if skipping and line.lstrip().startswith("- "):
            continue
        skipping = line.strip() == "relative_file_paths:"
        lines.append(line)
        if skipping:
            lines += [f"  - {name}" for name in names]
    return "\n".join(lines) + "\n"


def _write_part(
    folder: Path, messages: list[Raw], storage: str, compression: str, custom: dict[str, str] | None
) -> None:
    writer = Rosbag2Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    for key, value in (custom or {}).items():
        writer.set_custom_data(key, value)
    with writer:
        connections: dict[str, Any] = {}
        for raw in messages:
            if raw.topic not in connections:
                connections[raw.topic] = writer.add_connection(raw.topic, raw.type, typestore=STORE)
            writer.write(connections[raw.topic], raw.log_time_ns, raw.data)
