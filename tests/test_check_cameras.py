"""Sampled pictures judged: black, blank, frozen; and what is none of it."""

from __future__ import annotations

import base64

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.synthetic import card_frame, colour_card, encode_image, psnr
from tests.video_packets import GROUP, encode, numbered_frames, parted, video_message
from vilp_data.check.cameras import COMPARED, FROZEN_S, FrameSample, camera_findings, sample_frame, thumbnails_of
from vilp_data.check.findings import Finding
from vilp_data.check.pictures import PictureReader, is_camera
from vilp_data.decode.video_packet import packet_of
from vilp_data.types import Message


def noisy(k: int) -> np.ndarray:
    noise = np.random.default_rng(k).integers(-3, 4, (48, 64, 3))
    return np.clip(card_frame(k).astype(np.int16) + noise, 0, 255).astype(np.uint8)


def samples(frames: list[np.ndarray]) -> list[FrameSample]:
    return [sample_frame(frame, k / 2) for k, frame in enumerate(frames)]


def judged(frames: list[np.ndarray], *, moved: bool | None = True) -> list[Finding]:
    return list(camera_findings("/camera", samples(frames), moved=lambda start_s, end_s: moved))


@given(st.integers(0, 30), st.sampled_from([True, False, None]))
def test_a_camera_that_sees_something_is_left_alone(n: int, moved: bool | None) -> None:
    assert judged([noisy(k) for k in range(n)], moved=moved) == []


@settings(max_examples=30)
@given(st.integers(0, 12), st.integers(1, 12), st.integers(0, 3))
def test_black_pictures_are_found_at_their_place(before: int, black: int, level: int) -> None:
    frames = [noisy(k) for k in range(before)] + [np.full((48, 64, 3), level, np.uint8)] * black + [noisy(99)]
    (found,) = judged(frames)
    assert (found.kind, found.severity) == ("black", "warning")
    assert (found.place.start_s, found.place.end_s) == (before / 2, (before + black - 1) / 2)


def test_a_camera_that_is_black_throughout_is_an_error() -> None:
    (found,) = judged([np.zeros((48, 64, 3), np.uint8)] * 6)
    assert (found.kind, found.severity) == ("black", "error")


def test_a_dark_room_is_not_black() -> None:
    assert judged([(noisy(k) // 8).astype(np.uint8) for k in range(6)]) == []


def test_one_colour_is_blank() -> None:
    (found,) = judged([np.full((48, 64, 3), (255, 255, 255), np.uint8)] * 6, moved=None)
    assert found.kind == "blank"


@settings(max_examples=30)
@given(st.integers(1, 10), st.integers(2, 14))
def test_a_picture_sent_again_and_again_is_found_while_the_robot_moves(before: int, again: int) -> None:
    frames = [noisy(k) for k in range(before)] + [noisy(1000)] * again + [noisy(2000)]
    found = judged(frames)
    if (again - 1) / 2 < FROZEN_S:
        assert found == []
    else:
        assert [(f.kind, f.severity) for f in found] == [("frozen", "warning")]
        assert (found[0].place.start_s, found[0].place.end_s) == (before / 2, (before + again - 1) / 2)


def test_a_still_scene_is_not_frozen() -> None:
    assert judged([noisy(5)] * 20, moved=False) == []
    assert judged([noisy(1), *[noisy(5)] * 20], moved=None) == []


def test_one_picture_throughout_is_an_error_where_the_robot_moves_and_a_warning_where_nothing_tells() -> None:
    assert [f.severity for f in judged([noisy(5)] * 20, moved=True)] == ["error"]
    assert [f.severity for f in judged([noisy(5)] * 20, moved=None)] == ["warning"]


def test_depth_of_one_channel_and_large_pictures_are_looked_at() -> None:
    seen = sample_frame(np.full((1080, 1920, 1), 90, np.uint8), 0.0)
    assert (seen.mean, seen.deviation, seen.thumbnail.shape) == (90.0, 0.0, (8, 8))


def test_thumbnails_are_spread_over_the_demonstration() -> None:
    small = thumbnails_of(samples([noisy(k) for k in range(20)]))
    assert small is not None
    assert small.shape == (COMPARED, 8, 8)
    assert thumbnails_of([]) is None
    alone = thumbnails_of(samples([noisy(0)]))
    assert alone is not None
    assert (alone == alone[0]).all()


def test_a_keyframe_whose_parameters_came_before_it_is_looked_at_and_one_without_any_is_not() -> None:
    keyframe = encode(numbered_frames(1), "h264")[0].data
    parameters = packet_of(video_message(keyframe, "h264")).parameters.values()
    alone, bare = (video_message(data, "h264") for data in parted(keyframe, parameters))
    reader = PictureReader()
    assert reader.read(bare) is None
    assert reader.read(alone) is None
    assert reader.read(bare) is not None


@pytest.mark.parametrize("name", ["h264", "av1"])
def test_of_compressed_video_the_keyframes_are_looked_at(name: str) -> None:
    reader = PictureReader()
    pictures = [
        reader.read(video_message(packet.data, name, number=number))
        for number, packet in enumerate(encode(numbered_frames(GROUP + 2), name))
    ]
    seen = [picture for picture in pictures if picture is not None]
    assert 0 < len(seen) < len(pictures)
    assert pictures[0] is not None
    assert len(seen) == 2
    assert sample_frame(seen[0], 0.0).deviation > 10


def test_depth_is_looked_at_relative_to_the_first_image() -> None:
    def message(metres: float) -> Message:
        depth = np.full((20, 30), metres, np.float32)
        body = {"height": 20, "width": 30, "encoding": "32FC1", "is_bigendian": 0, "step": 120, "data": depth.tobytes()}
        return Message("/depth", "sensor_msgs/msg/Image", 0, 0, body)

    reader = PictureReader()
    assert is_camera(message(2.0))
    levels = [picture.max() for metres in (2.0, 1.0, 0.0) if (picture := reader.read(message(metres))) is not None]
    assert levels == [255, 127, 0]


def test_a_large_jpeg_is_decoded_smaller_in_the_right_colours_and_told_by_its_own_size() -> None:
    card = colour_card(960, 1280)
    body = {"format": "jpeg", "data": base64.b64encode(encode_image(card, "jpeg")).decode()}
    reader = PictureReader()
    picture = reader.read(Message("/camera", "foxglove.CompressedImage", 0, 0, body))
    assert picture is not None
    assert picture.shape == (240, 320, 3)
    assert reader.image == "960x1280 jpeg"
    assert psnr(picture, card[2::4, 2::4]) > 25
