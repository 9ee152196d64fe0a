"""Serialised messages of a log into Python objects: ROS 2 CDR, protobuf, JSON. The types come from the schemas in the log itself."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from typing import Any

from google.protobuf.message import DecodeError as ProtobufDecodeError
from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from vilp_data.errors import LogError

Decoder = Callable[[bytes], Any]

# What a decoder raises for bytes that do not fit their schema.
MALFORMED = (
    SerdeError,
    TypesysError,
    ProtobufDecodeError,
    McapError,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    AssertionError,
)


class MessageError(LogError):
    """One message whose bytes do not fit their schema, in a log that is whole. `where` names the log and the topic."""


READABLE = "CDR with ros2msg or ros2idl schemas, protobuf, JSON"


def decoder_for(message_encoding: str, schema: Schema | None, *, where: str) -> Decoder:
    """A function from a message's bytes to an object with the schema's attributes (CDR, protobuf) or a dict (JSON).

    LogError where the encoding is none of the three, or the schema cannot be understood; `where` names the topic in it."""
    if message_encoding == "json":
        return json.loads
    try:
        if message_encoding == "cdr" and schema is not None:
            return _cdr_decoder(schema)
        if message_encoding == "protobuf" and schema is not None:
            decoder: Decoder | None = DecoderFactory().decoder_for(message_encoding, schema)
            if decoder is not None:
                return decoder
    except MALFORMED as error:
        reason = str(error).partition("\n")[0].rstrip(":") or repr(error)
        found = f"{reason} (schema {schema.name!r}, {schema.encoding})" if schema else reason
        raise LogError(
            "the topic's schema cannot be understood", where=where, found=found, remedy=f"readable: {READABLE}"
        ) from error
    found = (
        f"messages in {message_encoding!r}, schema {schema.name!r} in {schema.encoding!r}"
        if schema
        else f"{message_encoding!r}, no schema"
    )
    raise LogError(
        "the topic's messages are in an encoding that is not read",
        where=where,
        found=found,
        remedy=f"readable: {READABLE}",
    )


def _cdr_decoder(schema: Schema) -> Decoder:
    name = _full_name(schema.name)
    text = schema.data.decode("utf-8")
    if not text.strip() and name in _stock_types().fielddefs:
        return _reader_of(_stock_types(), name)  # recorders that cannot find a definition leave its text empty
    store = get_typestore(Stores.EMPTY)
    if schema.encoding == "ros2msg":
        store.register(get_types_from_msg(text, name))
    elif schema.encoding in ("ros2idl", "omgidl"):
        store.register(get_types_from_idl(text))
    else:
        raise ValueError("unknown schema encoding")
    return _reader_of(store, name)


def _reader_of(store: Typestore, name: str) -> Decoder:
    store.get_msgdef(name)  # fails now, rather than at the first message, when a type is missing

    def decode(data: bytes) -> Any:
        return store.deserialize_cdr(data, name)

    return decode


@cache
def _stock_types() -> Typestore:
    """The message types that ship with ROS 2."""
    return get_typestore(Stores.LATEST)


def _full_name(name: str) -> str:
    """`pkg/Type`, as some recorders write it, is `pkg/msg/Type`."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name
