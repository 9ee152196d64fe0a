"""Image messages into uint8 RGB frames. Pure: a message in, an array out."""

from __future__ import annotations

import base64
import binascii

import cv2
import numpy as np

from vilp_data.errors import DecodeError
from vilp_data.message_body import cannot_decode, member
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
DEPTH = frozenset({"16UC1", "mono16", "32FC1"})
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

    Raw images in rgb8, bgr8, rgba8, bgra8 (alpha dropped), mono8 and 8UC1 (repeated), 8-bit Bayer mosaics (bilinear), YUV 4:2:2;
    JPEG and PNG of 8 bits, EXIF orientation ignored; arrays [H,W,3] of uint8, or of floats that hold whole numbers 0 to 255.
    Anything else is a DecodeError, never a guess."""
    if message.schema in COMPRESSED_IMAGES:
        return _compressed_image(message)
    if message.schema in RAW_IMAGES:
        return _raw_image(message)
    if message.schema == "array":
        return _array_image(message)
    known = sorted(RAW_IMAGES | COMPRESSED_IMAGES)
    raise cannot_decode(
        message,
        "messages of this schema are no images",
        message.schema or "(no schema)",
        f"images: {', '.join(known)}, array",
    )


def encoded_image(message: Message) -> tuple[bytes, str] | None:
    """A compressed image's bytes as they were recorded, and their media type (`image/jpeg`, `image/png`); None for any other message.

    DecodeError where they are cut off, or neither JPEG nor PNG."""
    if message.schema not in COMPRESSED_IMAGES:
        return None
    data = _whole_file(message)
    return data.tobytes(), "image/jpeg" if data[:3].tobytes() == JPEG_START else "image/png"


def image_encoding(message: Message) -> str:
    """How an image message holds its pixels, in its own words: `rgb8`, `jpeg`, `float32`."""
    if message.schema == "array":
        return str(np.asarray(message.body).dtype)
    return str(member(message.body, "format" if message.schema in COMPRESSED_IMAGES else "encoding", ""))


def _raw_image(message: Message) -> U8:
    body = message.body
    encoding = str(member(body, "encoding", ""))
    channels = CHANNELS.get(encoding)
    if channels is None:
        raise cannot_decode(message, f"image encoding {encoding!r} is not read", encoding, _way_out(encoding))
    height, width = int(member(body, "height", 0)), int(member(body, "width", 0))
    row_bytes = width * channels
    step = int(member(body, "step", 0)) or row_bytes
    data = _payload(message)
    # The last row may come without its padding.
    if min(height, width) < 1 or step < row_bytes or len(data) < step * (height - 1) + row_bytes:
        found = f"{height}x{width} {encoding}, step {step}, {len(data)} bytes"
        raise cannot_decode(
            message,
            "the image's size and its bytes do not fit",
            found,
            "the recorder wrote a damaged image; leave the topic out",
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, width, channels), (step, channels, 1), writeable=False)
    return _to_rgb(message, rows, encoding)


def _way_out(encoding: str) -> str:
    """What to do about an encoding that is not read, in a log that is recorded already."""
    if encoding in DEPTH:
        return "a depth image or another measurement, not a picture: leave the topic out of the task's views"
    if encoding == "8UC3":
        return "8UC3 does not say whether red or blue comes first: rewrite the topic's `encoding` as rgb8 or bgr8"
    return f"convert the topic to one of: {', '.join(CHANNELS)}"


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


def _compressed_image(message: Message) -> U8:
    data = _whole_file(message)
    if data[: len(PNG_START)].tobytes() == PNG_START and len(data) > PNG_BIT_DEPTH and data[PNG_BIT_DEPTH] == 16:
        remedy = "leave the topic out of the task's views; images of 8 bits are read"
        raise cannot_decode(message, "a PNG of 16 bits a channel", "probably a depth image", remedy)
    image = cv2.imdecode(data, IMAGE_FLAGS)
    if image is None:
        raise _damaged(message, f"{len(data)} bytes, damaged")
    return np.asarray(image, np.uint8)


def _whole_file(message: Message) -> U8:
    """A compressed image's bytes as uint8 [n]: JPEG or PNG, with its end mark.

    Damage between the two ends shows in a PNG (it carries checksums), but a JPEG decoder fills in what it cannot read and
    says so on stderr alone; the log's own checksums must catch that."""
    data = _payload(message)
    head, tail = data[:32].tobytes(), data[-4096:].tobytes()
    if head.startswith(JPEG_START):
        whole = JPEG_END in tail or JPEG_END in data.tobytes()
    elif head.startswith(PNG_START):
        whole = PNG_END in tail
    else:
        found = f"format {image_encoding(message)!r}, beginning with {head[:8]!r}"
        remedy = "record JPEG (4:4:4, quality 95 or more) or PNG"
        raise cannot_decode(message, "a compressed image that is neither JPEG nor PNG", found, remedy)
    if not whole:
        raise _damaged(message, f"{len(data)} bytes, without its end mark")
    return data


def _damaged(message: Message, found: str) -> DecodeError:
    what = "a compressed image that is cut off or damaged"
    return cannot_decode(message, what, found, "leave the message out, or record it again")


def _array_image(message: Message) -> U8:
    pixels = np.asarray(message.body)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
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
    if 0.0 < high <= 1.0 and low >= 0.0:
        raise cannot_decode(
            message,
            "a float image in the range 0 to 1",
            f"values {low:g} to {high:g}",
            "store 0 to 255, rounded, as uint8 or float",
        )
    if not (low >= -WHOLE and high <= 255 + WHOLE and float(np.abs(pixels - whole).max()) <= WHOLE):
        remedy = "store whole numbers 0 to 255 (rounding here would hide a wrong scale)"
        raise cannot_decode(
            message, "a float image that does not hold whole numbers 0 to 255", f"values {low:g} to {high:g}", remedy
        )
    return np.asarray(whole, np.uint8)


def _payload(message: Message) -> U8:
    """The `data` field as uint8 [n]: bytes, an array, a list of numbers, or base64 in JSON."""
    data = member(message.body, "data", None)
    if isinstance(data, str):
        try:
            data = base64.b64decode(data, validate=True)
        except binascii.Error as error:
            raise cannot_decode(
                message, "image data that is not base64", str(error), "JSON images hold their bytes in base64"
            ) from error
    if isinstance(data, (bytes, bytearray, memoryview)):
        return np.frombuffer(data, np.uint8)
    if data is None or np.ndim(data) != 1:
        raise cannot_decode(message, "an image without data", type(data).__name__, "the message needs a field `data`")
    return np.ascontiguousarray(data, np.uint8)
