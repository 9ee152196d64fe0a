"""Message bodies into uint8 RGB frames, float vectors and header times. Pure: a message in, an array out.

Bodies may be objects with the schema's attributes (CDR, protobuf), dicts (JSON) or arrays (zarr); all are read the same way.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vilp_data.errors import DecodeError, nearest
from vilp_data.types import F64, U8, Message

# --- images ---------------------------------------------------------------------------------------------------------

RAW_IMAGES = frozenset(
    {"sensor_msgs/msg/Image", "sensor_msgs/Image", "foxglove.RawImage", "foxglove_msgs/msg/RawImage"}
)
COMPRESSED_IMAGES = frozenset(
    {
        "sensor_msgs/msg/CompressedImage",
        "sensor_msgs/CompressedImage",
        "foxglove.CompressedImage",
        "foxglove_msgs/msg/CompressedImage",
    }
)
CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}
WHOLE = 1e-3  # how far a float pixel may lie from a whole number

JPEG_START, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
PNG_BIT_DEPTH = 24  # its offset in a PNG file

# EXIF orientation is ignored: a robot's camera is mounted as it is mounted, and half the pipeline would not turn with it.
IMAGE_FLAGS = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION


def is_image(message: Message) -> bool:
    """Whether `decode_image` reads messages of this schema; of arrays, those shaped [H,W,3]."""
    if message.schema == "array":
        return np.ndim(message.body) == 3 and np.shape(message.body)[2] == 3
    return message.schema in RAW_IMAGES or message.schema in COMPRESSED_IMAGES


def decode_image(message: Message) -> U8:
    """The image in a message as uint8 [H,W,3], RGB, top row first.

    Raw images in rgb8, bgr8, rgba8, bgra8 (alpha dropped) and mono8 (repeated); JPEG and PNG of 8 bits, EXIF orientation ignored;
    arrays [H,W,3] of uint8, or of floats that hold whole numbers 0 to 255. Anything else is a DecodeError, never a guess."""
    if message.schema in COMPRESSED_IMAGES:
        return _compressed_image(message)
    if message.schema in RAW_IMAGES:
        return _raw_image(message)
    if message.schema == "array":
        return _array_image(message)
    known = sorted(RAW_IMAGES | COMPRESSED_IMAGES)
    raise _cannot(
        message,
        "messages of this schema are no images",
        message.schema or "(no schema)",
        f"images: {', '.join(known)}, array",
    )


def encoded_image(message: Message) -> tuple[bytes, str] | None:
    """A compressed image's bytes as they were recorded, and their media type (`image/jpeg`, `image/png`); None for any other message."""
    if message.schema not in COMPRESSED_IMAGES:
        return None
    data = _payload(message).tobytes()
    if data.startswith(JPEG_START):
        return data, "image/jpeg"
    return (data, "image/png") if data.startswith(PNG_START) else None


def image_encoding(message: Message) -> str:
    """How an image message holds its pixels, in its own words: `rgb8`, `jpeg`, `float32`."""
    if message.schema == "array":
        return str(np.asarray(message.body).dtype)
    return str(_member(message.body, "format" if message.schema in COMPRESSED_IMAGES else "encoding", ""))


def _raw_image(message: Message) -> U8:
    body = message.body
    encoding = str(_member(body, "encoding", ""))
    channels = CHANNELS.get(encoding)
    if channels is None:
        raise _cannot(
            message, f"image encoding {encoding!r} is not read", encoding, f"record one of: {', '.join(CHANNELS)}"
        )
    height, width = int(_member(body, "height", 0)), int(_member(body, "width", 0))
    row_bytes = width * channels
    step = int(_member(body, "step", 0)) or row_bytes
    data = _payload(message)
    # The last row may come without its padding.
    if min(height, width) < 1 or step < row_bytes or len(data) < step * (height - 1) + row_bytes:
        found = f"{height}x{width} {encoding}, step {step}, {len(data)} bytes"
        raise _cannot(
            message,
            "the image's size and its bytes do not fit",
            found,
            "the recorder wrote a damaged image; leave the topic out",
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, width, channels), (step, channels, 1), writeable=False)
    return _to_rgb(rows, encoding)


def _to_rgb(pixels: U8, encoding: str) -> U8:
    if encoding == "mono8":
        return np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels[..., 2::-1] if encoding.startswith("bgr") else pixels[..., :3])


def _compressed_image(message: Message) -> U8:
    data = _payload(message)
    head, tail = data[:32].tobytes(), data[-4096:].tobytes()
    if head.startswith(JPEG_START):
        whole = JPEG_END in tail or JPEG_END in data.tobytes()
    elif head.startswith(PNG_START):
        whole = PNG_END in tail
        if len(head) > PNG_BIT_DEPTH and head[PNG_BIT_DEPTH] == 16:
            raise _cannot(message, "a PNG of 16 bits a channel", "probably a depth image", "record images of 8 bits")
    else:
        found = f"format {image_encoding(message)!r}, beginning with {head[:8]!r}"
        raise _cannot(
            message,
            "a compressed image that is neither JPEG nor PNG",
            found,
            "record JPEG (4:4:4, quality 95 or more) or PNG",
        )
    image = cv2.imdecode(data, IMAGE_FLAGS) if whole else None
    if image is None:
        found = f"{len(data)} bytes, {'damaged' if whole else 'without its end mark'}"
        raise _cannot(
            message, "a compressed image that is cut off or damaged", found, "leave the message out, or record it again"
        )
    return np.asarray(image, np.uint8)


def _array_image(message: Message) -> U8:
    pixels = np.asarray(message.body)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        hint = "; channels come last" if pixels.ndim == 3 and pixels.shape[0] == 3 else ""
        raise _cannot(
            message, "an image array must be [height, width, 3]", f"shape {pixels.shape}", f"reshape it{hint}"
        )
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype.kind != "f":
        raise _cannot(message, "an image array must be uint8 or float", str(pixels.dtype), "store uint8")
    whole = np.rint(pixels)
    low, high = float(pixels.min()), float(pixels.max())
    if 0.0 < high <= 1.0 and low >= 0.0:
        raise _cannot(
            message,
            "a float image in the range 0 to 1",
            f"values {low:g} to {high:g}",
            "store 0 to 255, rounded, as uint8 or float",
        )
    if not (low >= -WHOLE and high <= 255 + WHOLE and float(np.abs(pixels - whole).max()) <= WHOLE):
        remedy = "store whole numbers 0 to 255 (rounding here would hide a wrong scale)"
        raise _cannot(
            message, "a float image that does not hold whole numbers 0 to 255", f"values {low:g} to {high:g}", remedy
        )
    return np.asarray(whole, np.uint8)


def _payload(message: Message) -> U8:
    """The `data` field as uint8 [n]: bytes, an array, a list of numbers, or base64 in JSON."""
    data = _member(message.body, "data", None)
    if isinstance(data, str):
        try:
            data = base64.b64decode(data, validate=True)
        except binascii.Error as error:
            raise _cannot(
                message, "image data that is not base64", str(error), "JSON images hold their bytes in base64"
            ) from error
    if isinstance(data, (bytes, bytearray, memoryview)):
        return np.frombuffer(data, np.uint8)
    if data is None or np.ndim(data) != 1:
        raise _cannot(message, "an image without data", type(data).__name__, "the message needs a field `data`")
    return np.ascontiguousarray(data, np.uint8)


# --- vectors --------------------------------------------------------------------------------------------------------

# What a message's whole vector is, where the spec names no fields.
POSE = tuple(
    f"{part}"
    for part in (
        "position.x",
        "position.y",
        "position.z",
        "orientation.x",
        "orientation.y",
        "orientation.z",
        "orientation.w",
    )
)
TWIST = ("linear.x", "linear.y", "linear.z", "angular.x", "angular.y", "angular.z")
XYZ = ("x", "y", "z")
DEFAULT_FIELDS: dict[str, tuple[str, ...]] = {
    "sensor_msgs/msg/JointState": ("position",),
    "foxglove.JointStates": ("joints.position",),
    "foxglove.Pose": POSE,
    "foxglove.PoseInFrame": tuple(f"pose.{path}" for path in POSE),
    "geometry_msgs/msg/Pose": POSE,
    "geometry_msgs/msg/PoseStamped": tuple(f"pose.{path}" for path in POSE),
    "geometry_msgs/msg/Twist": TWIST,
    "geometry_msgs/msg/TwistStamped": tuple(f"twist.{path}" for path in TWIST),
    "geometry_msgs/msg/Point": XYZ,
    "geometry_msgs/msg/Vector3": XYZ,
    **{
        f"std_msgs/msg/{kind}": ("data",)
        for kind in ("Float32", "Float64", "Int32", "Int64", "Bool", "Float32MultiArray", "Float64MultiArray")
    },
}

_STEP = re.compile(r"\.?([A-Za-z_]\w*)|\[(\d+)(?::(\d+))?\]")


@dataclass(frozen=True, slots=True)
class _Member:
    name: str


Step = _Member | int | slice
VectorReader = Callable[[Message], F64]


def decode_vector(message: Message, fields: Sequence[str] = (), names: Sequence[str] = ()) -> F64:
    """The vector float64 [D] that `fields` and `names` pick out of a message, as `spec.VectorSpec` describes them.

    Each field is a path ("pose.position.x", "position[0:7]", "[0:2]" into a bare array); their values are concatenated. Without
    fields: the whole array, or the schema's usual ones. With `names`, each field is a list parallel to the message's `name`, and
    the values of those names are taken in that order. DecodeError where a field, index or name is not in the message."""
    return compile_fields(tuple(fields), tuple(names))(message)


@lru_cache(maxsize=256)
def compile_fields(fields: tuple[str, ...], names: tuple[str, ...] = ()) -> VectorReader:
    """`decode_vector` for one topic, its paths parsed once: message -> float64 [D]. DecodeError where a path is malformed."""
    paths = [(path, _parse_path(path)) for path in fields]
    orders: dict[tuple[str, ...], list[int]] = {}  # by the names that a message lists

    def read(message: Message) -> F64:
        chosen = paths or [(path, _parse_path(path)) for path in _default_fields(message)]
        parts = [_numbers(message, path, _follow(message, path, steps)) for path, steps in chosen]
        if names:
            published = _published_names(message)
            if published not in orders:
                orders[published] = _order(message, published, names)
            for number, (path, _) in enumerate(chosen):
                parts[number] = _reordered(message, path, parts[number], orders[published], len(published))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    return read


def _default_fields(message: Message) -> tuple[str, ...]:
    if isinstance(message.body, np.ndarray):
        return ("",)
    fields = DEFAULT_FIELDS.get(message.schema)
    if fields is None:
        known = ", ".join(_member_names(message.body))
        raise _cannot(
            message,
            "the task names no fields, and this schema has no usual ones",
            message.schema,
            f"fields here: {known}",
        )
    return fields


def _parse_path(path: str) -> tuple[Step, ...]:
    steps: list[Step] = []
    position = 0
    while position < len(path):
        match = _STEP.match(path, position)
        if (
            match is None
            or (match.group().startswith(".") and not steps)
            or (match.group(1) and steps and not match.group().startswith("."))
        ):
            remedy = 'paths look like "pose.position.x", "position[0:7]", "[0:2]"'
            raise DecodeError(f"field path {path!r} cannot be understood", found=path[position:], remedy=remedy)
        name, first, stop = match.groups()
        steps.append(_Member(name) if name else int(first) if stop is None else slice(int(first), int(stop)))
        position = match.end()
    return tuple(steps)


def _follow(message: Message, path: str, steps: tuple[Step, ...]) -> Any:
    value = message.body
    for step in steps:
        if isinstance(step, _Member):
            try:
                value = _get(value, step.name)
            except (AttributeError, KeyError):
                raise _cannot(
                    message, f"field {path!r}: no {step.name!r}", None, nearest(step.name, _member_names(value))
                ) from None
        else:
            value = _item(message, path, value, step)
    return value


def _item(message: Message, path: str, value: Any, step: int | slice) -> Any:
    if isinstance(value, dict) or not hasattr(value, "__len__"):
        found = type(value).__name__
        raise _cannot(message, f"field {path!r}: only lists and arrays have items", found, "leave the brackets out")
    length = len(value)
    last = step.stop if isinstance(step, slice) else step + 1
    if last > length or (isinstance(step, slice) and step.start >= step.stop):
        raise _cannot(
            message, f"field {path!r} reaches outside its list", f"{length} values", f"use indices within [0:{length}]"
        )
    return value[step]


def _numbers(message: Message, path: str, value: Any) -> F64:
    if isinstance(value, float):  # the common case, and ten times faster than what follows
        return np.array([value])
    try:
        array: npt.NDArray[Any] = np.asarray(value)
    except ValueError:
        array = np.empty(0, object)
    if array.dtype.kind not in "fiub":
        inside = [f"{path}.{name}" if path else name for name in _member_names(value)]
        remedy = f"name its fields: {', '.join(inside)}" if inside else "choose a field that holds numbers"
        raise _cannot(message, f"field {path!r} holds no numbers", type(value).__name__, remedy)
    return array.astype(np.float64).ravel()


def _published_names(message: Message) -> tuple[str, ...]:
    joints = _member(message.body, "joints", None)
    return tuple(_member(message.body, "name", ()) if joints is None else _get(joints, "name"))


def _order(message: Message, published: tuple[str, ...], names: tuple[str, ...]) -> list[int]:
    if not published:
        remedy = "use indices: position[0:7]"
        raise _cannot(message, "the task picks by name, but the message has no list `name`", message.schema, remedy)
    for name in names:
        if name not in published:
            raise _cannot(message, f"no joint {name!r}", None, nearest(name, published))
    return [published.index(name) for name in names]


def _reordered(message: Message, path: str, part: F64, order: list[int], n_names: int) -> F64:
    if len(part) != n_names:
        found = f"{len(part)} values, {n_names} names"
        raise _cannot(message, f"field {path!r} is not parallel to `name`", found, "leave `names` or slices out")
    return part[order]


# --- time -----------------------------------------------------------------------------------------------------------


def header_time_ns(message: Message) -> int | None:
    """The time a message gives itself, in nanoseconds: ROS `header.stamp`, or `timestamp` as Foxglove's schemas have it; else None.

    A stamp of zero is returned as zero: many drivers leave it unset, and a simulator starts there."""
    body = message.body
    stamp = _member(_member(body, "header", None), "stamp", None)
    if stamp is None:
        stamp = _member(body, "timestamp", None)
        if (
            hasattr(body, "HasField")
            and stamp is not None
            and not (hasattr(stamp, "seconds") and body.HasField("timestamp"))
        ):
            return None  # protobuf: the field is unset, or a plain number
    seconds = _first_member(stamp, ("sec", "seconds"))
    nanoseconds = _first_member(stamp, ("nanosec", "nsec", "nanos"))
    if not isinstance(seconds, int) or not isinstance(nanoseconds, int):
        return None
    return seconds * 1_000_000_000 + nanoseconds


# --- both kinds of body ---------------------------------------------------------------------------------------------


def _member(value: Any, name: str, default: Any) -> Any:
    return value.get(name, default) if isinstance(value, dict) else getattr(value, name, default)


def _get(value: Any, name: str) -> Any:
    """A member by name; of a list of messages (foxglove.JointStates), that member of each. AttributeError or KeyError if absent."""
    if isinstance(value, dict):
        return value[name]
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_get(item, name) for item in value]
    return getattr(value, name)


def _first_member(value: Any, names: Iterable[str]) -> Any:
    return next((found for name in names if (found := _member(value, name, None)) is not None), None)


def _member_names(value: Any) -> list[str]:
    if isinstance(value, dict):
        return [str(key) for key in value]
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        return [field.name for field in descriptor.fields]
    return [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("__")]


def _cannot(message: Message, what: str, found: str | None, remedy: str) -> DecodeError:
    return DecodeError(what, where=f"{message.topic} at {message.log_time_ns} ns", found=found, remedy=remedy)
