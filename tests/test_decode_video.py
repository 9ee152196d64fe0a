"""Compressed video: every frame comes with the message that it came from, in its own colours, or is counted as lost."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from av.video.reformatter import ColorRange, Colorspace

from tests.synthetic import colour_card
from tests.video_packets import ENCODERS, GROUP, Encoded, encode, number_of, numbered_frames, parted, video_message
from vilp_data.decode.video import BEFORE_KEYFRAME, LATE, RgbReader, VideoDecoder
from vilp_data.decode.video_packet import is_video, packet_of, video_codec
from vilp_data.errors import DecodeError
from vilp_data.types import U8, Message

FRAMES = 30
NAMES = sorted(ENCODERS)
WITHOUT_REORDERING = ["h264", "h265", "vp9", "av1"]


@cache
def packets(name: str) -> tuple[Encoded, ...]:
    return tuple(encode(numbered_frames(FRAMES), name))


def decoded(messages: Sequence[Message], *, first: int = 0) -> tuple[dict[int, U8], VideoDecoder]:
    """(number of the message -> its picture), and the decoder."""
    decoder, rgb, found = VideoDecoder(), RgbReader(), {}
    for number, message in enumerate(messages, start=first):
        found |= {n: rgb.rgb(frame) for n, frame in decoder.feed(number, message)}
    found |= {n: rgb.rgb(frame) for n, frame in decoder.rest()}
    return found, decoder


def messages_of(name: str, sent: Sequence[Encoded]) -> list[Message]:
    return [video_message(packet.data, name, number=number) for number, packet in enumerate(sent)]


def without_parameters(name: str, sent: Encoded) -> tuple[Message, Message]:
    """A keyframe's packet as two messages: its parameters, and the rest."""
    kept = packet_of(video_message(sent.data, name)).parameters.values()
    return tuple(video_message(data, name) for data in parted(sent.data, kept))  # type: ignore[return-value]


@pytest.mark.parametrize("name", NAMES)
def test_every_packet_gives_the_frame_that_was_put_into_it(name: str) -> None:
    sent = packets(name)
    assert sorted(packet.shows for packet in sent) == list(range(FRAMES))
    found, decoder = decoded(messages_of(name, sent))
    assert {number: number_of(frame) for number, frame in found.items()} == {n: p.shows for n, p in enumerate(sent)}
    assert decoder.lost == {}


@pytest.mark.parametrize("name", ["h264 with B frames", "h265 with B frames"])
def test_the_check_would_see_frames_taken_in_the_order_they_come_out(name: str) -> None:
    assert [packet.shows for packet in packets(name)] != list(range(FRAMES))


@pytest.mark.parametrize("first", [-7, 0, 1000])
def test_messages_may_be_numbered_from_anywhere(first: int) -> None:
    sent = packets("h264")
    found, _ = decoded(messages_of("h264", sent), first=first)
    assert {number: number_of(frame) for number, frame in found.items()} == {first + n: n for n in range(FRAMES)}


@pytest.mark.parametrize("name", WITHOUT_REORDERING)
def test_frames_before_the_first_keyframe_are_lost_and_none_is_shifted(name: str) -> None:
    sent = packets(name)[5:]
    first = next(n for n, packet in enumerate(sent) if packet.keyframe)
    found, decoder = decoded(messages_of(name, sent))
    assert {number: number_of(frame) for number, frame in found.items()} == {
        n: p.shows for n, p in enumerate(sent) if n >= first
    }
    assert sorted(decoder.lost) == list(range(first))
    assert all(error.found == BEFORE_KEYFRAME for error in decoder.lost.values())


@pytest.mark.parametrize("name", NAMES)
def test_a_packet_says_itself_whether_decoding_may_begin_with_it(name: str) -> None:
    for number, sent in enumerate(packets(name)):
        assert packet_of(video_message(sent.data, name, number=number)).keyframe == sent.keyframe, number


@pytest.mark.parametrize("name", ["h264", "av1"])
def test_frames_made_of_a_torn_one_are_lost_up_to_the_next_keyframe(name: str) -> None:
    sent = list(packets(name))
    keys = [n for n, packet in enumerate(sent) if packet.keyframe]
    torn = keys[1] + 3
    sent[torn] = Encoded(sent[torn].shows, sent[torn].data[: len(sent[torn].data) // 2], False)
    found, decoder = decoded(messages_of(name, sent))
    assert sorted(decoder.lost) == list(range(torn, keys[2]))
    assert all(str(10**9 + n * 10**8) in str(error.where) for n, error in decoder.lost.items())
    assert {n: number_of(frame) for n, frame in found.items()} == {n: n for n in range(FRAMES) if n not in decoder.lost}


def test_a_lost_frame_that_no_other_refers_to_costs_only_itself() -> None:
    name = "h264 with B frames"
    sent = list(packets(name))
    number = next(n for n, p in enumerate(sent) if n > GROUP and not packet_of(video_message(p.data, name)).referred)
    sent[number] = Encoded(sent[number].shows, sent[number].data[:12], False)
    found, decoder = decoded(messages_of(name, sent))
    assert list(decoder.lost) == [number]
    assert sorted(found) == [n for n in range(FRAMES) if n != number]


@pytest.mark.parametrize("name", ["h264 with B frames", "h265 with B frames"])
def test_frames_come_in_the_order_in_which_they_are_shown(name: str) -> None:
    found, _ = decoded(messages_of(name, packets(name)))
    assert [number_of(frame) for frame in found.values()] == list(range(FRAMES))


def test_b_frames_made_of_a_lost_picture_are_lost_though_they_are_shown_before_it() -> None:
    """A picture is cut within its data: the decoder tells only with its frame, when those made of it are shown already."""
    name = "h264 with B frames"
    sent = list(packets(name))
    torn = next(n for n, p in enumerate(sent) if n > GROUP + 1 and not p.keyframe and p.shows > n)
    sent[torn] = Encoded(sent[torn].shows, sent[torn].data[: len(sent[torn].data) // 2], False)
    found, decoder = decoded(messages_of(name, sent))
    following = next(n for n, p in enumerate(sent) if n > torn and p.keyframe)
    assert sorted(decoder.lost) == list(range(torn, following))
    assert sorted(found) == [n for n in range(FRAMES) if not torn <= n < following]


@pytest.mark.parametrize("name", ["h264", "h265"])
def test_parameters_that_travel_alone_are_no_picture_and_lose_none(name: str) -> None:
    sent = packets(name)
    alone, bare = without_parameters(name, sent[0])
    for message, picture in ((alone, False), (bare, True)):
        packet = packet_of(message)
        assert packet.picture is picture
        assert packet.keyframe is picture
        assert packet.described is not picture
    in_mid_group = messages_of(name, sent)
    in_mid_group.insert(GROUP + 5, alone)
    found, decoder = decoded([alone, bare, *in_mid_group[1:]])
    assert decoder.lost == {}
    assert [number_of(frame) for frame in found.values()] == list(range(FRAMES))


@pytest.mark.parametrize("name", ["h264", "h265"])
def test_a_decoder_that_is_given_the_parameters_begins_at_a_keyframe_without_them(name: str) -> None:
    first = packets(name)[0]
    _, bare = without_parameters(name, first)
    found, decoder = decoded([bare])
    assert not found
    assert list(decoder.lost) == [0]
    decoder = VideoDecoder(packet_of(video_message(first.data, name)).parameters)
    frames = [*decoder.feed(0, bare), *decoder.rest()]
    assert [number for number, _ in frames] == [0]


def test_nothing_but_what_is_lost_is_kept_of_a_long_stream() -> None:
    messages, decoder = messages_of("h264", packets("h264")), VideoDecoder()
    shown = 0
    for number in range(40 * FRAMES):
        shown += sum(1 for _ in decoder.feed(number, messages[number % FRAMES]))
    assert shown > 39 * FRAMES
    assert decoder.lost == {}
    kept = [value for value in vars(decoder).values() if hasattr(value, "__len__") and not isinstance(value, str)]
    assert kept
    assert max(map(len, kept)) <= LATE + 1


# --- colour -----------------------------------------------------------------------------------------------------------------

CORNERS = [(4, 4), (4, -5), (-5, 4), (-5, -5)]
COLOUR_BOUND = 5  # of 255: what 4:2:0 at high quality costs inside a plain patch
FINE = {
    "h264": {"qp": "4"},
    "h265": {"x265-params": "bframes=0:open-gop=0:qp=4"},
    "vp9": {"crf": "4", "b": "0"},
    "av1": {"crf": "4"},
}


def corner_error(card: U8, frame: U8) -> int:
    """The largest error in the middle of the card's four corners."""
    return max(int(np.abs(frame[y, x].astype(int) - card[y, x]).max()) for y, x in CORNERS)


def shown(name: str, matrix: Colorspace | None, *, full_range: bool) -> tuple[U8, U8]:
    card = colour_card(64, 96)
    sent = encode([card], name, matrix=matrix, full_range=full_range, quality=FINE[name])
    found, _ = decoded(messages_of(name, sent))
    return card, found[0]


@pytest.mark.parametrize("full_range", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize("matrix", [Colorspace.ITU601, Colorspace.ITU709], ids=["BT.601", "BT.709"])
@pytest.mark.parametrize("name", WITHOUT_REORDERING)
def test_the_colour_card_comes_back_by_the_streams_own_flags(name: str, matrix: Colorspace, full_range: bool) -> None:
    card, frame = shown(name, matrix, full_range=full_range)
    assert corner_error(card, frame) <= COLOUR_BOUND
    for mistaken in (frame[..., ::-1], frame[::-1], frame[:, ::-1]):
        assert corner_error(card, mistaken) > 100


@pytest.mark.parametrize(("matrix", "full_range"), [(Colorspace.ITU709, False), (Colorspace.ITU601, True)])
def test_the_bound_would_see_a_wrong_matrix_and_a_wrong_range(matrix: Colorspace, full_range: bool) -> None:
    card = colour_card(64, 96)
    sent = encode([card], "h264", matrix=matrix, full_range=full_range, quality=FINE["h264"])
    decoder = VideoDecoder()
    ((_, frame), *_) = [*decoder.feed(0, video_message(sent[0].data, "h264")), *decoder.rest()]
    assert corner_error(card, RgbReader().rgb(frame)) <= COLOUR_BOUND
    frame.colorspace, frame.color_range = Colorspace.ITU601.value, ColorRange.MPEG.value
    if frame.format.name == "yuvj420p":
        frame = frame.from_ndarray(frame.to_ndarray(), format="yuv420p")
    assert corner_error(card, RgbReader().rgb(frame)) > 2 * COLOUR_BOUND


def test_a_stream_that_describes_no_colours_is_taken_as_bt601_of_limited_range() -> None:
    card, frame = shown("h264", None, full_range=False)
    assert corner_error(card, frame) <= COLOUR_BOUND


# --- what a message calls itself ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("schema", "field", "said", "codec"),
    [
        ("foxglove.CompressedVideo", "format", "h265", "hevc"),
        ("foxglove_msgs/msg/CompressedVideo", "format", "vp9", "vp9"),
        ("foxglove_msgs/CompressedVideo", "format", "av1", "av1"),
        ("sensor_msgs/msg/CompressedImage", "format", "h264", "h264"),
        ("sensor_msgs/CompressedImage", "format", "H265", "hevc"),
        ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "encoding", "hevc;yuv420p;bgr8;bgr8", "hevc"),
        ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "encoding", "h264_nvenc", "h264"),
        ("ffmpeg_image_transport_msgs/FFMPEGPacket", "encoding", "libx264", "h264"),
    ],
)
def test_packets_are_known_by_schema_and_format(schema: str, field: str, said: str, codec: str) -> None:
    message = Message("/video", schema, 1, 1, SimpleNamespace(data=b"\0\0\1\x67", **{field: said}))
    assert is_video(message)
    assert video_codec(message) == codec


@pytest.mark.parametrize("said", ["jpeg", "rgb8; jpeg compressed bgr8", "16UC1; compressedDepth png", ""])
def test_compressed_images_are_no_video(said: str) -> None:
    assert not is_video(Message("/t", "sensor_msgs/msg/CompressedImage", 1, 1, SimpleNamespace(format=said, data=b"")))


@pytest.mark.parametrize(
    ("data", "said", "says"),
    [
        (b"\0\0\0\x1e\x65", "h264", "Annex B"),
        (b"", "h265", "Annex B"),
        (b"\0\0\1\x67", "theora", "theora"),
    ],
)
def test_what_is_no_packet_of_its_format_is_refused_in_words(data: bytes, said: str, says: str) -> None:
    message = Message("/video", "foxglove.CompressedVideo", 1, 1, SimpleNamespace(data=data, format=said))
    with pytest.raises(DecodeError, match=says):
        packet_of(message)
    found, decoder = decoded([message])
    assert not found
    assert list(decoder.lost) == [0]


@pytest.mark.parametrize("codec", ["h264", "h265", "vp9", "av1"])
def test_noise_is_lost_and_ends_nothing(codec: str) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (40, 300), dtype=np.uint8)
    start = b"\0\0\1\x65" if codec == "h264" else b"\0\0\1\x26\x01" if codec == "h265" else b""
    messages = [video_message(start + row.tobytes(), codec, number=n) for n, row in enumerate(noise)]
    found, decoder = decoded(messages)
    assert sorted(set(decoder.lost) | set(found)) == list(range(len(messages)))
