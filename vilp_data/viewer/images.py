"""What a log's cameras show, put on a canvas: pictures as they were recorded, video decoded, depth as distances."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from vilp_data.decode import is_image
from vilp_data.decode.depth import is_depth, is_grey16, measured_depth
from vilp_data.decode.images import decode_image, encoded_image
from vilp_data.decode.video import Frames, RgbReader, VideoDecoder
from vilp_data.decode.video_packet import is_video
from vilp_data.errors import DecodeError
from vilp_data.types import U8, Message
from vilp_data.viewer.canvas import Canvas, entity_of

SHOWN_QUALITY = 90
"""JPEG quality of a video's pictures: to be looked at only, and raw ones would fill the memory."""


class LogImages:
    """`draw` each image message of a log, in order; then `end`."""

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self._decoders: dict[str, VideoDecoder] = {}
        self._times: dict[str, list[int]] = {}
        self._rgb: dict[str, RgbReader] = {}

    def shows(self, message: Message) -> bool:
        return is_image(message) or is_video(message)

    def draw(self, message: Message) -> None:
        """Raises DecodeError for an image that cannot be read; a video's packets without a picture are told by `end`."""
        if is_video(message):
            self._draw_packet(message)
        elif is_depth(message) or is_grey16(message):
            self._canvas.depth_image(entity_of(message.topic), message.log_time_ns, *_as_png(message))
        else:
            encoded = encoded_image(message)
            if encoded is None:
                self._canvas.frames(
                    entity_of(message.topic), decode_image(message)[None], np.array([message.log_time_ns])
                )
            else:
                self._canvas.encoded_image(entity_of(message.topic), message.log_time_ns, *encoded)

    def end(self) -> Iterator[tuple[str, DecodeError]]:
        """Draw what decoders still hold; (topic, why) of each packet that gave no picture."""
        for topic, decoder in self._decoders.items():
            self._draw_frames(topic, decoder.rest())
            for error in decoder.lost.values():
                yield topic, error

    def _draw_packet(self, message: Message) -> None:
        topic = message.topic
        decoder, times = self._decoders.setdefault(topic, VideoDecoder()), self._times.setdefault(topic, [])
        times.append(message.log_time_ns)
        self._draw_frames(topic, decoder.feed(len(times) - 1, message))

    def _draw_frames(self, topic: str, frames: Frames) -> None:
        for number, frame in frames:
            if topic not in self._rgb:
                self._rgb[topic] = RgbReader()
            jpeg = _as_jpeg(self._rgb[topic].rgb(frame))
            self._canvas.encoded_image(entity_of(topic), self._times[topic][number], jpeg, "image/jpeg")


def _as_jpeg(rgb: U8) -> bytes:
    return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, SHOWN_QUALITY])[1].tobytes()


def _as_png(message: Message) -> tuple[bytes, float]:
    """A depth image as a PNG of 16 bits, and how many of its units make a metre: the numbers of a log are millimetres where they are
    whole, and metres where they are not, as ROS has it."""
    measured = measured_depth(message)
    if measured.dtype != np.uint16:
        measured = np.clip(np.nan_to_num(measured * 1000, nan=0, posinf=0, neginf=0), 0, 65535).astype(np.uint16)
    return cv2.imencode(".png", measured)[1].tobytes(), 1000.0
