"""Message bodies into uint8 RGB frames, float vectors and header times: the one door to all three. Pure.

Bodies may be objects with the schema's attributes (CDR, protobuf), dicts (JSON) or arrays (zarr); all are read the same way.
"""

from __future__ import annotations

from vilp_data.decode.images import COMPRESSED_IMAGES, RAW_IMAGES, decode_image, encoded_image, image_encoding, is_image
from vilp_data.decode.message_body import first_member, member
from vilp_data.decode.vectors import compile_fields, decode_vector
from vilp_data.types import Message

__all__ = [
    "COMPRESSED_IMAGES",
    "EARLIEST_WALL_NS",
    "RAW_IMAGES",
    "compile_fields",
    "decode_image",
    "decode_vector",
    "encoded_image",
    "header_time_ns",
    "image_encoding",
    "is_image",
    "is_wall_clock",
]

EARLIEST_WALL_NS = 946_684_800 * 10**9
"""The year 2000. Earlier stamps are simulated time, or come from a clock that was never set."""

FARTHEST_NS = 1 << 62
"""A century and a half from 1970. Stamps beyond are garbage."""


def is_wall_clock(time_ns: int) -> bool:
    """Whether a time is one of the wall clock, as far as its value tells."""
    return time_ns >= EARLIEST_WALL_NS


def header_time_ns(message: Message) -> int | None:
    """The time a message gives itself, in nanoseconds: ROS `header.stamp`, or `timestamp` as Foxglove's schemas have it; else None.

    A stamp of zero is returned as zero: many drivers leave it unset, and a simulator starts there. One that lies centuries away is
    none: it would not even fit the integers that times are kept in."""
    body = message.body
    stamp = member(member(body, "header", None), "stamp", None)
    if stamp is None:
        stamp = member(body, "timestamp", None)
        if (
            hasattr(body, "HasField")
            and stamp is not None
            and not (hasattr(stamp, "seconds") and body.HasField("timestamp"))
        ):
            return None  # protobuf: the field is unset, or a plain number
    if stamp is None:
        return None
    seconds = first_member(stamp, ("sec", "seconds"))
    nanoseconds = first_member(stamp, ("nanosec", "nsec", "nanos"))
    if not isinstance(seconds, int) or not isinstance(nanoseconds, int):
        return None
    time_ns = seconds * 1_000_000_000 + nanoseconds
    return time_ns if abs(time_ns) < FARTHEST_NS else None
