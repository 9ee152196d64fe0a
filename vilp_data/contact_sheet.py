"""Pictures of many frames at once: rows of images under captions, uint8 RGB."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from vilp_data.types import U8

ERROR_GAIN = 4
"""Error images are this much brighter than the error, to be seen at all."""

SCALE = 2
CAPTION_HEIGHT = 18
LABEL_WIDTH = 96


def error_image(real: U8, other: U8) -> U8:
    """Absolute difference, ERROR_GAIN times as bright and clipped: uint8 of the same shape."""
    difference = np.abs(real.astype(np.int16) - other.astype(np.int16))
    error: U8 = np.clip(ERROR_GAIN * difference, 0, 255).astype(np.uint8)
    return error


def as_rgb(frames: U8) -> U8:
    """uint8 [...,3] of [...,3], or of one channel, [...,1], as grey."""
    return frames if frames.shape[-1] == 3 else np.repeat(frames, 3, axis=-1)


def captioned(text: str, image: U8) -> U8:
    """The image, [H,W,3] or [H,W,1], under a line of white text on black."""
    image = as_rgb(image)
    return np.concatenate([_text(text, CAPTION_HEIGHT, image.shape[1]), image])


def stacked(images: Sequence[U8]) -> U8:
    """One below the other, filled up with black to the widest: uint8 [H,W,3]."""
    width = max(image.shape[1] for image in images)
    return np.concatenate([np.pad(image, ((0, 0), (0, width - image.shape[1]), (0, 0))) for image in images])


def grid(rows: Mapping[str, Sequence[U8 | None]], columns: Sequence[str], *, scale: int = SCALE) -> U8:
    """Named rows of frames of one size, [H,W,3] or [H,W,1], a column a time; None stays black."""
    shape = next((*frame.shape[:2], 3) for row in rows.values() for frame in row if frame is not None)
    blank = np.zeros(shape, np.uint8)
    height, width = scale * shape[0], scale * shape[1]
    head = np.concatenate(
        [_text("", CAPTION_HEIGHT, LABEL_WIDTH), *(_text(c, CAPTION_HEIGHT, width) for c in columns)], 1
    )
    lines = [head]
    for label, row in rows.items():
        cells = [blank if frame is None else as_rgb(frame) for frame in row]
        images = np.concatenate(cells, axis=1).repeat(scale, axis=0).repeat(scale, axis=1)
        lines.append(np.concatenate([_text(label, height, LABEL_WIDTH), images], axis=1))
    return np.concatenate(lines)


def to_png(image: U8) -> bytes:
    """Encode RGB uint8 [H,W,3]."""
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes()


def jpeg_uri(image: U8, *, quality: int) -> str:
    """An image uint8 [H,W,3] RGB, or [H,W,1], as a JPEG in the page itself. `quality` 0 … 100."""
    pixels = image[..., ::-1] if image.shape[2] == 3 else image
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done, "a uint8 image can always be encoded"
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _text(text: str, height: int, width: int) -> U8:
    """One line of white text in the middle of a black strip."""
    strip = np.zeros((height, width, 3), np.uint8)
    cv2.putText(strip, text, (4, height // 2 + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return strip
