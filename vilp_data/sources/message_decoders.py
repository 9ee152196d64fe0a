"""Serialised messages of a log into Python objects: ROS 1, ROS 2 (CDR), protobuf, JSON. Their types come from the log's own schemas.

FlatBuffers, CBOR and MessagePack are not read: topics in them are listed, and refused only where they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache, partial
from typing import Any

import zstandard
from google.protobuf.message import DecodeError as ProtobufDecodeError
from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from vilp_data import limits
from vilp_data.errors import LogError, reason
from vilp_data.sources.inflate import LARGEST_WINDOW
from vilp_data.sources.json_messages import read_json
from vilp_data.sources.ros_definitions import refuse_unreasonable

Decoder = Callable[[bytes], Any]

# What a decoder raises for bytes that do not fit their schema.
MALFORMED = (
    SerdeError, TypesysError, ProtobufDecodeError, McapError, zstandard.ZstdError,
    ValueError, KeyError, TypeError, IndexError, AssertionError, RecursionError, MemoryError, OverflowError,
)  # fmt: skip

ROS_ENCODINGS = ("ros1", "cdr")
READABLE = "ROS 1 and ROS 2 (CDR) messages with ros1msg, ros2msg or ros2idl schemas, protobuf, JSON"
UNDEFINED = "the log carries no definition of it, and it is no stock type of ROS"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
BEFORE_DEFINITIONS = "humble"
"""The last ROS 2 whose recorders wrote no definitions into SQLite bags: what a bag without any is taken for."""


class MessageError(LogError):
    """One message whose bytes do not fit their schema, in a log that is whole. `where` names the log and the topic."""


def decoder_for(message_encoding: str, schema: Schema | None, *, where: str, distro: str = "") -> Decoder:
    """A function from a message's bytes to an object with the schema's attributes (ROS, protobuf) or a dict (JSON).

    A ROS schema without text is looked up among the types that ship with ROS: 1, or 2 of the release `distro` (`humble`). LogError
    where the encoding is none of READABLE, or the schema cannot be understood; `where` names the topic in it."""
    if message_encoding == "json":
        return read_json
    try:
        if schema is not None:
            limits.check("the topic's schema", "DEFINITION_BYTES", len(schema.data), where=where)
            if message_encoding in ROS_ENCODINGS:
                return _ros_decoder(message_encoding, schema, distro)
            if message_encoding == "protobuf":
                decoder: Decoder | None = DecoderFactory().decoder_for(message_encoding, schema)
                if decoder is not None:
                    return decoder
    except MALFORMED as error:
        found = _reason(error)
        found += f" (schema {schema.name!r}, {schema.encoding or 'no definition'})" if schema else ""
        raise LogError(
            "the topic's schema cannot be understood", where=where, found=found, remedy=f"readable: {READABLE}"
        ) from error
    found = f"messages in {message_encoding!r}"
    found += f", schema {schema.name!r} in {schema.encoding!r}" if schema else ", no schema"
    raise LogError(
        "the topic's messages are in an encoding that is not read",
        where=where,
        found=found,
        remedy=f"leave the topic out of the task, or convert it; readable: {READABLE}",
    )


def ros_name(name: str) -> str:
    """`pkg/Type`, as ROS 1 and some recorders write it, is `pkg/msg/Type`: the one form that the rest of the pipeline sees."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


def _reason(error: BaseException) -> str:
    if isinstance(error, RecursionError):
        return "types that contain themselves, or nest too deep"
    if isinstance(error, KeyError):
        return f"it refers to {error.args[0] if error.args else '?'}, which it does not define"
    return reason(error)


# --- ROS ------------------------------------------------------------------------------------------------------------


def _ros_decoder(message_encoding: str, schema: Schema, distro: str) -> Decoder:
    name, text = ros_name(schema.name), schema.data.decode("utf-8")
    read = _read_ros1 if message_encoding == "ros1" else _read_cdr
    if not text.strip():  # recorders that cannot find a definition leave its text empty
        stock = _stock_types("ros1" if message_encoding == "ros1" else distro, name)
        if stock is not None:
            return partial(read, stock, name)
        if not schema.encoding:
            raise ValueError(UNDEFINED)
        read = partial(_read_undefined, read)
    store = _defined_types(schema.encoding, name, text, message_encoding)
    store.get_msgdef(name)  # fails now, rather than at the first message, when a type is missing
    return partial(read, store, name)


def _read_undefined(read: Callable[[Typestore, str, bytes], Any], store: Typestore, name: str, data: bytes) -> Any:
    """A message of a type without a definition: one that has no members, or else it cannot be read."""
    try:
        return read(store, name, data)
    except SerdeError:
        raise ValueError(UNDEFINED) from None


def _read_ros1(store: Typestore, name: str, data: bytes) -> Any:
    return store.deserialize_ros1(data, name)


def _read_cdr(store: Typestore, name: str, data: bytes) -> Any:
    """A CDR message; one that rosbag2 compressed by itself is inflated first. CDR begins with a zero byte, so neither passes for the
    other, and a part of a bag stands without the metadata.yaml that says so."""
    if data.startswith(ZSTD_MAGIC):
        data = _inflated_message(data)
    return store.deserialize_cdr(data, name)


def _inflated_message(packed: bytes) -> bytes:
    size = zstandard.frame_content_size(packed)
    if size > limits.RECORD_BYTES:
        raise ValueError(f"a message of {size:,} bytes, where {limits.RECORD_BYTES:,} are allowed")
    largest = size if size > 0 else min(limits.RECORD_BYTES, 1000 * len(packed) + (1 << 20))
    return zstandard.ZstdDecompressor(max_window_size=LARGEST_WINDOW).decompress(packed, max_output_size=largest)


@lru_cache(maxsize=512)
def _defined_types(schema_encoding: str, name: str, text: str, message_encoding: str) -> Typestore:
    """The types that a schema's text defines. Kept, since logs of one robot have the same ones."""
    if schema_encoding in ("ros1msg", "ros2msg"):
        types = get_types_from_msg(text, name)
    elif schema_encoding in ("ros2idl", "omgidl"):
        types = get_types_from_idl(text)
    else:
        raise ValueError(f"unknown schema encoding {schema_encoding!r}")
    refuse_unreasonable(types, empty_takes_bytes=message_encoding == "cdr")
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def _stock_types(distro: str, name: str) -> Typestore | None:
    """The message types of a ROS release, or of the latest where that one lacks `name` or is not known; None where both do."""
    first = Stores.ROS1_NOETIC if distro == "ros1" else _release(distro)
    for release in (first, Stores.LATEST):
        if release is not None and name in (store := _stock(release)).fielddefs:
            return store
    return None


def stock_definition(distro: str, name: str) -> str:
    """The text of a ROS 2 type that a log of this release does not define, as `decoder_for` takes it; "" where no release has it."""
    store = _stock_types(distro, ros_name(name))
    return "" if store is None else str(store.generate_msgdef(ros_name(name), ros_version=2)[0])


def _release(distro: str) -> Stores | None:
    return Stores.__members__.get(f"ROS2_{distro.upper()}")


@cache
def _stock(release: Stores) -> Typestore:
    return get_typestore(release)
