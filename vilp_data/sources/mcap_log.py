"""MCAP logs: ROS 1 and ROS 2 messages, Foxglove protobuf and JSON. One file is one episode."""

from __future__ import annotations

from pathlib import Path

from vilp_data.sources.channels import Channel
from vilp_data.sources.chunked_log import ChunkedLog
from vilp_data.sources.mcap_file import McapFile


class McapLog(ChunkedLog[McapFile]):
    """A `LogReader` over one MCAP file. Opening reads the index only; LogError where the file is cut off or its index damaged.

    `named` is the path that errors name, where the file is an inflated copy of another."""

    format = "mcap"

    def __init__(self, path: Path, *, named: Path | None = None) -> None:
        file = McapFile(path, named=named or path)
        schemas = file.index.schemas
        channels = {
            channel_id: Channel(channel.topic, channel.message_encoding, schemas.get(channel.schema_id))
            for channel_id, channel in file.index.channels.items()
        }
        super().__init__(named or path, file, channels)

    def metadata(self) -> dict[str, dict[str, str]]:
        return self._file.metadata()
