"""ROS 1 bags, uncompressed or in bz2 or lz4. One file is one episode."""

from __future__ import annotations

from pathlib import Path

from mcap.records import Schema

from vilp_data.sources.channels import Channel
from vilp_data.sources.chunked_log import ChunkedLog
from vilp_data.sources.rosbag1_file import Rosbag1File


class Rosbag1Log(ChunkedLog[Rosbag1File]):
    """A `LogReader` over one bag. Opening reads the indexes only; LogError where the bag has none, or is cut off.

    Publish times are not recorded: they are the log times. Chunks carry no checksum but that of bz2 and lz4."""

    format = "rosbag1"

    def __init__(self, path: Path) -> None:
        file = Rosbag1File(path)
        channels = {
            number: Channel(
                said.topic, "ros1", Schema(id=number, data=said.definition, encoding="ros1msg", name=said.type)
            )
            for number, said in file.connections.items()
        }
        super().__init__(path, file, channels)
