"""Depth images into metres, and metres into the levels that are stored. Pure: a message in, an array out.

What counts as a reading follows REP 117 and 118: NaN, 0 and negative numbers are none; +inf is farther than the camera can tell,
-inf nearer. Readings outside [near_m, far_m] are clipped to it, since a far wall is still known to be there; where there is no
reading the stored level is 0, and nothing else is 0.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vilp_data.decode.image_file import PNG_START, image_file
from vilp_data.decode.images import (
    COMPRESSED_IMAGES,
    FLOATS,
    GREY16,
    RAW_IMAGES,
    array_pixels,
    image_encoding,
    payload,
    raw_pixels,
    require_size,
    unpacked,
    whole_file,
)
from vilp_data.decode.message_body import cannot_decode
from vilp_data.decode.rvl import unpack_rvl
from vilp_data.errors import DecodeError
from vilp_data.spec import DepthSpec
from vilp_data.types import F32, U8, Message

METRES = {"mm": 1e-3, "m": 1.0}
LEVELS = 254
"""Steps between the level of near_m, 1, and that of far_m, 255."""

RAW_DEPTH: dict[str, np.dtype[Any]] = {**dict.fromkeys(GREY16, np.dtype(np.uint16)), FLOATS: np.dtype(np.float32)}
MEASURES = ("16UC1", FLOATS)
COMPRESSED_DEPTH = "compressedDepth"
_HEAD = struct.Struct("<iff")  # the transport's own head: a format number, then the two numbers of its inverse coding


def is_depth(message: Message) -> bool:
    """Whether a message surely measures, by what it says of itself: an encoding that no picture has."""
    encoding = image_encoding(message)
    if message.schema in RAW_IMAGES:
        return encoding in MEASURES
    return message.schema in COMPRESSED_IMAGES and (COMPRESSED_DEPTH in encoding or encoding.startswith(MEASURES))


def is_grey16(message: Message) -> bool:
    """Whether a message holds grey of 16 bits that may be either, depth or a picture (thermal, infrared): mono16, or a PNG that does
    not say."""
    if message.schema in RAW_IMAGES:
        return image_encoding(message) == "mono16"
    if message.schema not in COMPRESSED_IMAGES or is_depth(message):
        return False
    try:
        head = image_file(payload(message).tobytes())
    except DecodeError:
        return False
    return head is not None and head.bits == 16 and head.grey


def decode_depth(message: Message, depth: DepthSpec) -> F32:
    """Metres, float32 [H,W], clipped to [near_m, far_m]; NaN where there is no reading.

    Raw images in 16UC1, mono16 or 32FC1, PNG of 16 bits, ROS's compressedDepth (PNG and RVL, of 16UC1 or 32FC1), arrays [H,W] or
    [H,W,1] of uint16 or floats. Anything else is a DecodeError."""
    measured = measured_depth(message)
    none = np.isnan(measured) if measured.dtype.kind == "f" else np.zeros(measured.shape, np.bool_)
    none |= (measured <= 0) & (measured != -np.inf)
    metres = np.clip(measured.astype(np.float32) * np.float32(METRES[depth.unit]), depth.near_m, depth.far_m)
    metres[none] = np.nan
    return np.asarray(metres, np.float32)


def depth_levels(metres: F32, depth: DepthSpec) -> U8:
    """What is stored of metres [H,W] in [near_m, far_m]: uint8 [H,W,1], 1 at near_m to 255 at far_m, 0 for NaN."""
    share = (metres - np.float32(depth.near_m)) / np.float32(depth.far_m - depth.near_m)
    levels = np.where(np.isnan(metres), 0, 1 + np.rint(np.clip(np.nan_to_num(share), 0, 1) * LEVELS))
    return levels.astype(np.uint8)[..., None]


def level_metres(levels: U8, depth: DepthSpec) -> F32:
    """The inverse of `depth_levels`, up to its rounding: float32 of the same shape, NaN for 0."""
    metres = depth.near_m + (levels.astype(np.float32) - 1) * np.float32((depth.far_m - depth.near_m) / LEVELS)
    return np.where(levels == 0, np.float32(np.nan), metres).astype(np.float32)


def measured_depth(message: Message) -> npt.NDArray[Any]:
    """The numbers as they were recorded, whatever their unit: uint16 or float32 [H,W]."""
    if message.schema in RAW_IMAGES:
        return raw_pixels(message, RAW_DEPTH)[..., 0]
    if message.schema in COMPRESSED_IMAGES:
        return _compressed_depth(message) if COMPRESSED_DEPTH in image_encoding(message) else _depth_png(message)
    if message.schema != "array":
        remedy = "take `depth` out of the view's table"
        raise cannot_decode(message, "messages of this schema are no depth images", message.schema, remedy)
    numbers = array_pixels(message)
    if numbers.dtype == np.uint16 or numbers.dtype.kind == "f":
        return numbers if numbers.dtype == np.uint16 else numbers.astype(np.float32, copy=False)
    remedy = "store uint16 or floats"
    raise cannot_decode(message, "a depth array must be uint16 or float", str(numbers.dtype), remedy)


def _depth_png(message: Message) -> npt.NDArray[Any]:
    data, _ = whole_file(message)
    return _of_16_bits(message, unpacked(message, data, cv2.IMREAD_UNCHANGED))


def _compressed_depth(message: Message) -> npt.NDArray[Any]:
    """ROS's compressedDepth transport: its head, then a PNG or RVL of uint16, which for floats holds inverse distances."""
    encoding, data = image_encoding(message), payload(message).tobytes()
    if len(data) <= _HEAD.size:
        raise _damaged(message, f"{len(data)} bytes")
    _, slope, offset = _HEAD.unpack_from(data)
    packed = data[_HEAD.size :]
    stored = _of_16_bits(
        message, _from_png(message, packed) if packed.startswith(PNG_START) else _from_rvl(message, packed)
    )
    if not encoding.startswith("32FC1"):
        return stored
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.float32(slope) / (stored.astype(np.float32) - np.float32(offset))
    return np.where(stored == 0, np.float32(np.nan), metres).astype(np.float32)


def _from_png(message: Message, packed: bytes) -> npt.NDArray[Any]:
    head = image_file(packed)
    if head is None or not head.whole:
        raise _damaged(message, f"{len(packed)} bytes of PNG, without its end")
    require_size(message, head.height, head.width)
    return unpacked(message, packed, cv2.IMREAD_UNCHANGED)


def _from_rvl(message: Message, packed: bytes) -> npt.NDArray[Any]:
    if "rvl" not in image_encoding(message).lower():
        found = f"format {image_encoding(message)!r}, then {packed[:8]!r}"
        raise cannot_decode(message, "compressed depth that is neither PNG nor RVL", found, "leave the topic out")
    width, height = struct.unpack_from("<II", packed) if len(packed) >= 8 else (0, 0)
    require_size(message, height, width)
    try:
        return unpack_rvl(packed[8:], height * width).reshape(height, width)
    except ValueError as error:
        raise _damaged(message, f"RVL of {height}x{width}: {error}") from error


def _of_16_bits(message: Message, pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if pixels.ndim != 2 or pixels.dtype != np.uint16 or not pixels.size:
        found = f"{pixels.dtype} of shape {pixels.shape}"
        remedy = "depth is one channel of 16 bits: take `depth` out of the view's table, or name the depth topic"
        raise cannot_decode(message, "an image that holds no depth", found, remedy)
    return pixels


def _damaged(message: Message, found: str) -> Exception:
    what = "a compressed depth image that is cut off or damaged"
    return cannot_decode(message, what, found, "leave the message out, or record it again")
