"""Videos read back, by another reader than the one that wrote them."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import ColorRange, Colorspace

from tests.synthetic import card_frame, colour_card, psnr
from vilp_data.errors import StoreError, UsageError
from vilp_data.mp4 import write_mp4
from vilp_data.types import U8

CLOSE_DB = (
    32.0  # H.264 at 4:2:0 keeps the card above this; another matrix, range or channel order, a flip or a shift is below
)


def read_mp4(path: Path) -> U8:
    """RGB uint8 [n,H,W,3], by FFmpeg, told BT.709 and limited range as a player learns from the tags."""
    with av.open(path) as container:
        frames = [
            frame.reformat(
                format="rgb24",
                src_colorspace=frame.colorspace,
                src_color_range=frame.color_range,
                dst_color_range=ColorRange.JPEG,
            ).to_ndarray()
            for frame in container.decode(video=0)
        ]
    return np.stack(frames)


def test_frames_come_back_in_order_and_in_colour(tmp_path: Path) -> None:
    frames = np.stack([card_frame(i) for i in range(12)])
    write_mp4(tmp_path / "a.mp4", frames, fps=10, scale=2)
    back = read_mp4(tmp_path / "a.mp4")
    assert back.shape == (12, 96, 128, 3)
    for i, frame in enumerate(back):
        likeness = [psnr(frame[::2, ::2], other) for other in frames]
        assert int(np.argmax(likeness)) == i
        assert likeness[i] > CLOSE_DB


def test_flat_colours_are_exact_to_a_few_levels(tmp_path: Path) -> None:
    card = colour_card(64, 64)
    write_mp4(tmp_path / "a.mp4", card[None].repeat(3, axis=0), fps=5)
    back = read_mp4(tmp_path / "a.mp4")[1].astype(int)
    for row, column in ((4, 4), (4, -5), (-5, 4), (-5, -5), (32, 40)):
        assert np.abs(back[row, column] - card[row, column]).max() <= 4, (row, column)


def test_the_file_says_how_its_colours_are_meant(tmp_path: Path) -> None:
    write_mp4(tmp_path / "a.mp4", colour_card()[None], fps=12.5)
    with av.open(tmp_path / "a.mp4") as container:
        stream = container.streams.video[0]
        frame = next(container.decode(stream))
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate or 0) == 12.5
        assert frame.colorspace == Colorspace.ITU709
        assert frame.color_range == ColorRange.MPEG


def test_another_reader_sees_the_same_picture(tmp_path: Path) -> None:
    write_mp4(tmp_path / "a.mp4", colour_card()[None].repeat(2, axis=0), fps=10, scale=2)
    done, frame = cv2.VideoCapture(str(tmp_path / "a.mp4")).read()
    assert done
    assert psnr(frame[::2, ::2, ::-1], colour_card()) > 25  # it may ignore the tag and take another matrix: 2 % off


def test_odd_sides_are_filled_up_and_nothing_is_scaled(tmp_path: Path) -> None:
    card = colour_card(47, 63)
    write_mp4(tmp_path / "a.mp4", card[None], fps=10)
    back = read_mp4(tmp_path / "a.mp4")
    assert back.shape == (1, 48, 64, 3)
    for row, column in ((2, 2), (2, 60), (44, 2), (44, 60)):  # at the card's own places: nothing moved
        assert np.abs(back[0, row, column].astype(int) - card[row, column]).max() <= 4, (row, column)
    assert np.abs(back[0, 47].astype(int) - back[0, 46]).mean() < 4


def test_a_video_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mp4").write_bytes(b"the one before")
    with pytest.raises(UsageError, match="no frames"):
        write_mp4(tmp_path / "a.mp4", np.empty((0, 8, 8, 3), np.uint8), fps=10)

    def full(frame: U8) -> av.VideoFrame:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("vilp_data.mp4._yuv", full)
    with pytest.raises(StoreError, match="No space left"):
        write_mp4(tmp_path / "a.mp4", colour_card()[None], fps=10)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"the one before"
