"""Image messages into uint8 RGB frames. Pure: a message in, an array out."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vilp_data import limits
from vilp_data.decode.image_file import ImageFile, image_file
from vilp_data.decode.message_body import cannot_decode, member, shown, whole_number
from vilp_data.errors import DecodeError
from vilp_data.types import U8, Message

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
PLAIN = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
# One colour a pixel, named by the two upper rows of the mosaic's first corner; filled in from the neighbours.
MOSAICS = {
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}
SMALLEST_MOSAIC = 3  # OpenCV leaves a smaller one black
# Two bytes a pixel, colour shared by pairs (ITU-R BT.601, limited range); ROS 2 names each of the two orders twice.
PAIRED = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
}
CHANNELS = PLAIN | dict.fromkeys(MOSAICS, 1) | dict.fromkeys(PAIRED, 2)
GREY16 = frozenset({"mono16", "16UC1"})
FLOATS = "32FC1"
WHOLE = 1e-3  # how far a float pixel may lie from a whole number

Levels = tuple[int, int]
"""(black, white): the values of a 16-bit grey picture that become 0 and 255."""

# EXIF orientation is ignored: a robot's camera is mounted as it is mounted, and half the pipeline would not turn with it.
IMAGE_FLAGS = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
RECORD_OTHERWISE = "record JPEG (4:4:4, quality 95 or more), PNG or WebP"
NOT_A_PICTURE = (
    "a depth image, or a picture that does not say how bright white is: give the view `depth = { unit, near_m, far_m }` or "
    "`levels = [black, white]`, or leave the topic out"
)


def is_image(message: Message) -> bool:
    """Whether `decode_image` reads messages of this schema; of arrays, those shaped [H,W,3]."""
    if message.schema == "array":
        return np.ndim(message.body) == 3 and np.shape(message.body)[2] == 3
    return message.schema in RAW_IMAGES or message.schema in COMPRESSED_IMAGES


def decode_image(message: Message, *, levels: Levels | None = None, dark: bool = False) -> U8:
    """The image in a message as uint8 [H,W,3], RGB, top row first.

    Raw images in rgb8, bgr8, rgba8, bgra8 (alpha dropped), mono8 and 8UC1 (repeated), 8-bit Bayer mosaics (bilinear), YUV 4:2:2;
    JPEG, PNG and WebP (of colour PNGs of 16 bits the upper 8), EXIF orientation ignored; arrays [H,W,3] of uint8, or of floats
    that hold whole numbers 0 to 255. Grey of 16 bits (mono16, 16UC1, PNG) only with `levels`, and then nothing else.
    A float image without anything above 1 may be a dark one, or count from 0 to 1: it is read only if `dark` is set, by whoever sees
    to it that others of the topic are brighter. Anything else is a DecodeError, never a guess."""
    if message.schema in COMPRESSED_IMAGES:
        return _compressed_image(message, levels)
    if message.schema in RAW_IMAGES:
        return _raw_image(message, levels)
    if message.schema == "array" and levels is None:
        return _array_image(message, dark)
    if message.schema == "array":
        return _spread(message, array_pixels(message), levels)
    known = sorted(RAW_IMAGES | COMPRESSED_IMAGES)
    raise cannot_decode(
        message,
        "messages of this schema are no images",
        message.schema or "(no schema)",
        f"images: {', '.join(known)}, array",
    )


def encoded_image(message: Message) -> tuple[bytes, str] | None:
    """A compressed image's bytes as they were recorded, and their media type (`image/jpeg`, `image/png`); None for any other message.

    DecodeError where they are cut off, or no image file."""
    if message.schema not in COMPRESSED_IMAGES:
        return None
    data, head = whole_file(message)
    return None if head.kind == "webp" else (data, f"image/{head.kind}")  # few viewers read WebP


def image_encoding(message: Message) -> str:
    """How an image message holds its pixels, in its own words: `rgb8`, `jpeg`, `float32`."""
    if message.schema == "array":
        return str(np.asarray(message.body).dtype)
    return str(member(message.body, "format" if message.schema in COMPRESSED_IMAGES else "encoding", ""))


def _raw_image(message: Message, levels: Levels | None) -> U8:
    encoding = str(member(message.body, "encoding", ""))
    if levels is not None:
        return _spread(message, raw_pixels(message, dict.fromkeys(GREY16, np.dtype(np.uint16)))[..., 0], levels)
    if encoding not in CHANNELS:
        raise cannot_decode(message, f"image encoding {encoding!r} is not read", encoding, _way_out(encoding))
    return _to_rgb(message, raw_pixels(message, dict.fromkeys(CHANNELS, np.dtype(np.uint8))), encoding)


def raw_pixels(message: Message, dtypes: Mapping[str, np.dtype[Any]]) -> npt.NDArray[Any]:
    """[H,W,values a pixel] of a raw image in one of the encodings `dtypes`, as its type in this machine's byte order; a view of the
    message's bytes where it can be. DecodeError for another encoding, and where size and bytes do not fit."""
    body = message.body
    encoding = str(member(body, "encoding", ""))
    if encoding not in dtypes:
        found = f"encoding {encoding!r} where the view asks for one of: {', '.join(sorted(dtypes))}"
        raise cannot_decode(
            message, "the view's table does not fit its images", found, "take `depth` or `levels` out of it"
        )
    dtype, channels = dtypes[encoding], CHANNELS.get(encoding, 1)
    height, width, step = (whole_number(member(body, name, 0), message, name) for name in ("height", "width", "step"))
    row_bytes = width * channels * dtype.itemsize
    step = step or row_bytes
    data = payload(message)
    # The last row may come without its padding.
    if min(height, width) < 1 or step < row_bytes or len(data) < step * (height - 1) + row_bytes:
        found = f"{height}x{width} {encoding}, step {step}, {len(data)} bytes"
        raise cannot_decode(
            message,
            "the image's size and its bytes do not fit",
            found,
            "the recorder wrote a damaged image; leave the topic out",
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row_bytes), (step, 1), writeable=False)
    if dtype.itemsize == 1:
        shape, strides = (height, width, channels), (step, channels, 1)
        return np.lib.stride_tricks.as_strided(data, shape, strides, writeable=False)
    stored = dtype.newbyteorder(">") if member(body, "is_bigendian", 0) else dtype.newbyteorder("<")
    return np.ascontiguousarray(rows).view(stored).astype(dtype, copy=False)[..., None]


def _way_out(encoding: str) -> str:
    """What to do about an encoding that is not read, in a log that is recorded already."""
    if encoding in GREY16:
        return NOT_A_PICTURE
    if encoding == FLOATS:
        return "a depth image, not a picture: give the view `depth = { unit, near_m, far_m }`, or leave the topic out"
    if encoding == "8UC3":
        return "8UC3 does not say whether red or blue comes first: rewrite the topic's `encoding` as rgb8 or bgr8"
    return f"convert the topic to one of: {', '.join(CHANNELS)}"


def _spread(message: Message, grey: npt.NDArray[Any], levels: Levels | None) -> U8:
    """Grey uint16 [H,W] from `levels` to 0 .. 255, clipped and rounded, as uint8 [H,W,3]."""
    assert levels is not None
    if grey.dtype != np.uint16:
        remedy = "take `levels` out of the view's table: it is of grey pictures of 16 bits"
        raise cannot_decode(message, "levels for an image that is not grey of 16 bits", f"{grey.dtype}", remedy)
    black, white = levels
    scaled = np.clip((grey.astype(np.float32) - black) * (255 / (white - black)), 0, 255)
    return np.repeat(np.rint(scaled).astype(np.uint8)[..., None], 3, axis=2)


def _to_rgb(message: Message, pixels: U8, encoding: str) -> U8:
    """uint8 [H,W,3] of uint8 [H,W,channels] in one of CHANNELS."""
    height, width, channels = pixels.shape
    if encoding in MOSAICS:
        if min(height, width) < SMALLEST_MOSAIC:
            remedy = "the recorder wrote a damaged image; leave the topic out"
            raise cannot_decode(message, "a Bayer mosaic too small to fill in", f"{height}x{width}", remedy)
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), MOSAICS[encoding]), np.uint8)
    if encoding in PAIRED:
        if width % 2:
            remedy = "YUV 4:2:2 holds pairs of pixels: the width must be even"
            raise cannot_decode(message, "a YUV image of an odd width", f"{height}x{width} {encoding}", remedy)
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), PAIRED[encoding]), np.uint8)
    if channels == 1:
        return np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels[..., 2::-1] if encoding.startswith("bgr") else pixels[..., :3])


def _compressed_image(message: Message, levels: Levels | None) -> U8:
    data, head = whole_file(message)
    deep_grey = head.bits == 16 and head.grey
    if deep_grey and levels is None:
        found = f"{head.height}x{head.width}, probably a depth image"
        raise cannot_decode(message, "a grey PNG of 16 bits", found, NOT_A_PICTURE)
    if levels is not None:
        return _spread(message, unpacked(message, data, cv2.IMREAD_UNCHANGED), levels)
    return np.asarray(unpacked(message, data, IMAGE_FLAGS), np.uint8)


def unpacked(message: Message, data: bytes, flags: int) -> npt.NDArray[Any]:
    """The pixels of an image file, as OpenCV's `flags` ask for them; DecodeError where it is damaged."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise _damaged(message, f"{len(data)} bytes: {str(error).splitlines()[-1]}") from error
    if image is None:
        raise _damaged(message, f"{len(data)} bytes, damaged")
    return image


def whole_file(message: Message) -> tuple[bytes, ImageFile]:
    """A compressed image's bytes and what their head says: JPEG, PNG or WebP with its end, of a size that may be allocated."""
    data = payload(message).tobytes()
    head = image_file(data)
    if head is None:
        found = f"format {image_encoding(message)!r}, beginning with {data[:8]!r}"
        raise cannot_decode(
            message, "a compressed image that is neither JPEG nor PNG nor WebP", found, RECORD_OTHERWISE
        )
    if not head.whole:
        raise _damaged(message, f"{len(data)} bytes, without its end")
    require_size(message, head.height, head.width)
    return data, head


def require_size(message: Message, height: int, width: int) -> None:
    """DecodeError before an image is unpacked that would fill the memory: a few kB can claim billions of pixels."""
    if height * width > limits.IMAGE_PIXELS:
        found = f"{height}x{width} where {limits.IMAGE_PIXELS:,} pixels are allowed"
        remedy = f"probably damaged; if not, set VILP_MAX_IMAGE_PIXELS={height * width}"
        raise cannot_decode(message, "an image larger than any camera takes", found, remedy)


def _damaged(message: Message, found: str) -> DecodeError:
    what = "a compressed image that is cut off or damaged"
    return cannot_decode(message, what, found, "leave the message out, or record it again")


def array_pixels(message: Message) -> npt.NDArray[Any]:
    """An array of one channel, [H,W] or [H,W,1], as [H,W]."""
    pixels = np.asarray(message.body)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        return pixels[..., 0]
    if pixels.ndim != 2 or not pixels.size:
        remedy = "take `depth` or `levels` out of the view's table"
        raise cannot_decode(message, "an array that is not of one channel", f"shape {pixels.shape}", remedy)
    return pixels


def _array_image(message: Message, dark: bool) -> U8:
    pixels = np.asarray(message.body)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
        hint = "; channels come last" if pixels.ndim == 3 and pixels.shape[0] == 3 else ""
        raise cannot_decode(
            message, "an image array must be [height, width, 3]", f"shape {pixels.shape}", f"reshape it{hint}"
        )
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype.kind != "f":
        raise cannot_decode(message, "an image array must be uint8 or float", str(pixels.dtype), "store uint8")
    whole = np.rint(pixels)
    low, high = float(pixels.min()), float(pixels.max())
    is_whole = low >= -WHOLE and high <= 255 + WHOLE and float(np.abs(pixels - whole).max()) <= WHOLE
    if 0.0 < high <= 1.0 and low >= 0.0 and not (dark and is_whole):
        raise range_of_one(message.topic, f"at {message.log_time_ns} ns, values {low:g} to {high:g}")
    if not is_whole:
        remedy = "store whole numbers 0 to 255 (rounding here would hide a wrong scale)"
        raise cannot_decode(
            message, "a float image that does not hold whole numbers 0 to 255", f"values {low:g} to {high:g}", remedy
        )
    return np.asarray(whole, np.uint8)


def range_of_one(topic: str, found: str) -> DecodeError:
    """The error for float images that seem to count from 0 to 1."""
    remedy = "store 0 to 255, rounded, as uint8 or float"
    return DecodeError("a float image in the range 0 to 1", where=topic, found=found, remedy=remedy)


def payload(message: Message) -> U8:
    """The `data` field as uint8 [n]: bytes, an array, a list of whole numbers 0 to 255, or base64 in JSON."""
    data = member(message.body, "data", None)
    if isinstance(data, str):
        try:
            data = base64.b64decode(data, validate=True)
        except ValueError as error:  # also of text that is not ASCII
            raise cannot_decode(
                message, "image data that is not base64", str(error), "JSON images hold their bytes in base64"
            ) from error
    if isinstance(data, (bytes, bytearray, memoryview)):
        return np.frombuffer(data, np.uint8)
    if data is None or isinstance(data, (dict, bool, int, float)):
        raise cannot_decode(message, "an image without data", type(data).__name__, "the message needs a field `data`")
    return _bytes_of(data, message)


def _bytes_of(numbers: Any, message: Message) -> U8:
    """A list or array of numbers as uint8 [n]; DecodeError where one of them is no byte, rather than what casting makes of it."""
    try:
        array = np.asarray(numbers)
        with np.errstate(invalid="ignore"):
            in_bytes = array.astype(np.uint8, copy=False)
        is_bytes = array.ndim == 1 and (array.dtype == np.uint8 or np.array_equal(in_bytes, array))
    except (TypeError, ValueError, OverflowError):  # text, lists of several lengths, integers beyond 64 bits
        is_bytes = False
    if not is_bytes:
        remedy = "the message's `data` must be bytes, or whole numbers 0 to 255"
        raise cannot_decode(message, "image data that is no bytes", shown(numbers), remedy)
    return np.ascontiguousarray(in_bytes)
