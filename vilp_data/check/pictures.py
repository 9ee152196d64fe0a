"""One message of a camera into something to look at, whatever the camera: pictures, depth, packets of video. Pure."""

from __future__ import annotations

import cv2
import numpy as np

from vilp_data import decode
from vilp_data.decode.depth import is_depth, is_grey16, measured_depth
from vilp_data.decode.images import unpacked, whole_file
from vilp_data.decode.video import RgbReader, VideoDecoder
from vilp_data.decode.video_packet import describes, is_video, packet_of, video_codec
from vilp_data.types import U8, Message

DEPTH_PERCENTILE = 95
"""Of the first depth image: what is shown as white."""


REDUCED = ((8, cv2.IMREAD_REDUCED_COLOR_8), (4, cv2.IMREAD_REDUCED_COLOR_4), (2, cv2.IMREAD_REDUCED_COLOR_2))
"""A JPEG decodes at a half, a quarter or an eighth of its size for less: by what, and what OpenCV calls it."""

ENOUGH_ROWS = 160
"""A picture is not reduced below this: small ones of a check's page and everything that is judged need no more."""


class PictureReader:
    """Reads the sampled messages of one camera. Depth is shown relative to the first image, so that one that freezes still does.

    `image` tells what the camera sends: `480x640 jpeg`."""

    def __init__(self) -> None:
        self.image: str | None = None
        self._depth_top: float | None = None
        self._parameters: dict[int, bytes] = {}
        self._to_rgb: RgbReader | None = None

    def read(self, message: Message) -> U8 | None:
        """uint8 [h,w,3], or [h,w,1] for depth, perhaps smaller than it was sent; None for a packet of video that decoding cannot begin
        with. DecodeError as `decode` raises it."""
        if is_video(message):
            return self._noted(message, self._keyframe(message))
        if is_depth(message) or is_grey16(message):
            return self._noted(message, self._depth(message))
        if message.schema in decode.COMPRESSED_IMAGES:
            return self._reduced(message)
        return self._noted(message, decode.decode_image(message))

    def _reduced(self, message: Message) -> U8:
        data, head = whole_file(message)
        self.image = self.image or f"{head.height}x{head.width} {decode.image_encoding(message)}"
        for by, flag in REDUCED:
            if head.kind == "jpeg" and head.height >= by * ENOUGH_ROWS:
                pixels = unpacked(message, data, flag | cv2.IMREAD_IGNORE_ORIENTATION)
                return np.asarray(pixels[..., ::-1], np.uint8)
        return decode.decode_image(message)

    def _noted(self, message: Message, picture: U8 | None) -> U8 | None:
        if picture is not None and self.image is None:
            encoding = video_codec(message) if is_video(message) else decode.image_encoding(message)
            self.image = f"{picture.shape[0]}x{picture.shape[1]} {encoding}"
        return picture

    def _depth(self, message: Message) -> U8:
        measured = np.nan_to_num(measured_depth(message).astype(np.float32), posinf=0.0, neginf=0.0)
        if self._depth_top is None:
            self._depth_top = float(np.percentile(measured, DEPTH_PERCENTILE)) or 1.0
        return np.asarray(np.clip(measured * (255.0 / self._depth_top), 0, 255)[..., None], np.uint8)

    def _keyframe(self, message: Message) -> U8 | None:
        """Only keyframes are decoded: one stands alone, given the parameters that may have come before it, and decoding the packets
        between would cost as much as ingest."""
        packet = packet_of(message)
        self._parameters |= packet.parameters
        if not packet.keyframe or not describes(packet.codec, self._parameters):
            return None
        decoder = VideoDecoder(self._parameters)
        self._to_rgb = self._to_rgb or RgbReader()
        for _, frame in [*decoder.feed(0, message), *decoder.rest()]:
            return self._to_rgb.rgb(frame)
        raise decoder.lost[0]


def is_camera(message: Message) -> bool:
    """Whether `PictureReader` reads messages like this one."""
    return decode.is_image(message) or is_video(message) or is_depth(message)
