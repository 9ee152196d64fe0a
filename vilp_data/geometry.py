"""One way to bring an image to the size a model sees, for ingest and for policies alike. Pure."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from vilp_data.errors import UsageError
from vilp_data.types import U8

Fit = Literal["crop", "pad", "stretch"]
ASPECT_TOLERANCE = 0.01
"""Relative change of aspect ratio that passes without being stated: what rounding to whole pixels makes."""


def fit_image(image: U8, height: int, width: int, fit: Fit | None) -> U8:
    """Resize uint8 [h,w,3] to [height,width,3] with an area filter (linear where the image grows).

    fit "crop" cuts the longer side evenly, "pad" adds black evenly, "stretch" changes the aspect ratio. None keeps all of the
    image and raises UsageError where that would change the aspect ratio. An image of the right size is returned as it is."""
    h, w = image.shape[:2]
    if (h, w) == (height, width):
        return image
    if fit is None and abs(w * height / (h * width) - 1) > ASPECT_TOLERANCE:
        raise UsageError(
            f"images of {w}x{h} do not fit {width}x{height} without a change of aspect ratio",
            remedy='state fit = "crop", "pad" or "stretch" for this view in the task TOML',
        )
    if fit == "crop":
        image = _cropped(image, height / width)
    elif fit == "pad":
        return _padded(image, height, width)
    return _resized(image, height, width)


def _cropped(image: U8, aspect: float) -> U8:
    h, w = image.shape[:2]
    keep_h, keep_w = min(h, round(w * aspect)), min(w, round(h / aspect))
    top, left = (h - keep_h) // 2, (w - keep_w) // 2
    return image[top : top + keep_h, left : left + keep_w]


def _padded(image: U8, height: int, width: int) -> U8:
    h, w = image.shape[:2]
    scale = min(height / h, width / w)
    inner_h, inner_w = min(height, max(1, round(h * scale))), min(width, max(1, round(w * scale)))
    out: U8 = np.zeros((height, width, image.shape[2]), np.uint8)
    top, left = (height - inner_h) // 2, (width - inner_w) // 2
    out[top : top + inner_h, left : left + inner_w] = _resized(image, inner_h, inner_w)
    return out


def _resized(image: U8, height: int, width: int) -> U8:
    h, w = image.shape[:2]
    shrinks = height <= h and width <= w
    out: U8 = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)  # type: ignore[assignment]
    return out
