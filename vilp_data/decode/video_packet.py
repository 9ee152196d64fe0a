"""What a packet of compressed video says by itself, before anything is decoded: its codec, and whether decoding may begin with it. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from vilp_data.decode.images import COMPRESSED_IMAGES, payload
from vilp_data.decode.message_body import cannot_decode, member
from vilp_data.errors import DecodeError
from vilp_data.types import Message

VIDEO_PACKETS = frozenset(
    {
        "foxglove.CompressedVideo",
        "foxglove::CompressedVideo",
        "foxglove_msgs/msg/CompressedVideo",
        "foxglove_msgs/CompressedVideo",
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "ffmpeg_image_transport_msgs/FFMPEGPacket",
    }
)
# What formats are called, by what their names begin with (an encoder's name stands for what it writes).
_NAMES = {
    "h264": ("h264", "avc", "libx264", "x264", "libopenh264"),
    "hevc": ("h265", "hevc", "libx265", "x265"),
    "vp9": ("vp9", "libvpx-vp9"),
    "av1": ("av1", "libaom", "libsvtav1", "librav1e"),
}
_SEQUENCE = {"h264": 7, "hevc": 33}
_PARAMETERS = {"h264": (7, 8), "hevc": (32, 33, 34)}
_RECOVERY_POINT = 6  # a remark, H.264 D.1: what follows may be decoded from here on

Parameters = Mapping[int, bytes]
"""Kind of parameter set -> the latest of that kind, start codes included: what H.264 and H.265 must know of a stream."""


@dataclass(frozen=True)
class Packet:
    """One message's packet.

    picture     it shows one; False of parameters or remarks that travel by themselves
    keyframe    decoding may begin with it
    closed      and nothing after it needs what came before
    referred    pictures after it may need it
    parameters  those that it brings; {} for VP9 and AV1, whose keyframes say everything
    """

    codec: str
    data: bytes
    picture: bool
    keyframe: bool
    closed: bool
    referred: bool = True
    parameters: Parameters = field(default_factory=dict)

    @property
    def described(self) -> bool:
        """Whether a decoder that knows nothing of the stream learns enough from it."""
        return describes(self.codec, self.parameters)

    def after(self, parameters: Parameters) -> Packet:
        """The packet with those parameters before it that it does not bring itself."""
        missing = [parameters[kind] for kind in sorted(parameters) if kind not in self.parameters]
        return _packet_of_units(self.codec, b"".join([*missing, self.data])) if missing else self


def describes(codec: str, parameters: Parameters) -> bool:
    """Whether these are all that a decoder needs besides a keyframe."""
    return codec not in _SEQUENCE or _SEQUENCE[codec] in parameters


def is_video(message: Message) -> bool:
    """Whether a message is one packet of compressed video, as far as its schema or, for a compressed image, its format says."""
    return message.schema in VIDEO_PACKETS or (message.schema in COMPRESSED_IMAGES and _codec(message) is not None)


def video_codec(message: Message) -> str:
    """`h264`, `hevc`, `vp9` or `av1`. DecodeError for another format."""
    codec = _codec(message)
    if codec is None:
        found, remedy = repr(_format(message)), "record H.264 or H.265 (Annex B), VP9 or AV1"
        raise cannot_decode(message, "compressed video in a format that is not read", found, remedy)
    return codec


def packet_of(message: Message) -> Packet:
    """The packet in a message. DecodeError where it is none of its format."""
    codec, data = video_codec(message), payload(message).tobytes()
    if codec in _SEQUENCE:
        if not data.startswith((b"\0\0\1", b"\0\0\0\1")):
            remedy = "record Annex B packets (start codes, not lengths, before each unit)"
            raise cannot_decode(
                message, f"not a packet of {codec} in Annex B", f"begins with {data[:8].hex(' ')}", remedy
            )
        return _packet_of_units(codec, data)
    keyframe = _vp9_keyframe(data) if codec == "vp9" else _av1_sequence(data)
    return Packet(codec, data, True, keyframe, keyframe)


def holds_picture(message: Message) -> bool:
    """False for a packet of parameters or remarks alone, which is no image. What is no packet at all counts as an image, a damaged one."""
    try:
        return packet_of(message).picture
    except DecodeError:
        return True


def _codec(message: Message) -> str | None:
    said = _format(message).partition(";")[0].strip().lower()
    return next((codec for codec, names in _NAMES.items() if said.startswith(names)), None)


def _format(message: Message) -> str:
    return str(member(message.body, "format", "") or member(message.body, "encoding", ""))


# --- H.264 and H.265: units between start codes ------------------------------------------------------------------------------


def _packet_of_units(codec: str, data: bytes) -> Packet:
    """H.264: an instantaneous refresh (5) is a closed keyframe; a recovery point, or the sequence's parameters before a picture of its
    own (intra), let decoding begin at one that is not. H.265: random access pictures are keyframes, of which CRA (21) is open.
    Pictures that no other needs are those of reference number 0 in H.264; in H.265 those that are skipped after an open keyframe
    (8, 9), and even types below 16."""
    units = _units_to_first_slice(codec, data)
    parameters: dict[int, bytes] = {}
    for kind, at, end in units:
        if kind in _PARAMETERS[codec]:
            parameters[kind] = parameters.get(kind, b"") + b"\0\0\1" + data[at:end]
    last, at, _ = units[-1] if units else (-1, 0, 0)
    picture = _is_slice(codec, last)
    if codec == "h264":
        resumes = any(kind == 6 and data[at + 1] == _RECOVERY_POINT for kind, at, _ in units)
        keyframe = last == 5 or (picture and (resumes or (7 in parameters and _is_intra(data[at + 1 : at + 10]))))
        return Packet(codec, data, picture, keyframe, last == 5, picture and bool(data[at] >> 5 & 3), parameters)
    referred = picture and last not in (8, 9) and (last > 15 or last % 2 == 1)
    return Packet(codec, data, picture, 16 <= last <= 23, 16 <= last <= 20, referred, parameters)


def _units_to_first_slice(codec: str, data: bytes) -> list[tuple[int, int, int]]:
    """(kind, where its first byte is, where it ends) of a packet's units, up to its first slice of a picture."""
    units = []
    start = data.find(b"\0\0\1")
    while 0 <= start < len(data) - 4:
        head = data[start + 3]
        kind = head & 0x1F if codec == "h264" else head >> 1 & 0x3F
        following = -1 if _is_slice(codec, kind) else data.find(b"\0\0\1", start + 3)
        units.append((kind, start + 3, following if following >= 0 else len(data)))
        start = following
    return units


def _is_slice(codec: str, kind: int) -> bool:
    return 1 <= kind <= 5 if codec == "h264" else 0 <= kind < 32


def _is_intra(header: bytes) -> bool:
    """Whether a slice of H.264 needs no other picture: the second number of its header is its type, 2, 4, 7 or 9 for those."""
    bits = "".join(f"{byte:08b}" for byte in header)
    at = kind = 0
    for _ in range(2):  # Exp-Golomb: as many zeros as bits follow the first one
        zeros = max(bits.find("1", at), at) - at
        kind, at = int(bits[at : at + 2 * zeros + 1] or "0", 2) - 1, at + 2 * zeros + 1
    return kind in (2, 4, 7, 9)


# --- VP9 and AV1 ---------------------------------------------------------------------------------------------------------------


def _vp9_keyframe(data: bytes) -> bool:
    """The uncompressed header's first bits: marker (2), profile (2, and a reserved one for 3), show existing, frame type (0: key)."""
    if not data or data[0] >> 6 != 2:
        return False
    bits = data[0] << 2 & 0xFF  # past the marker
    profile_3 = bits >> 6 == 3
    at = 5 if profile_3 else 4
    show_existing, kind = data[0] >> (7 - at) & 1, data[0] >> (6 - at) & 1
    return not show_existing and not kind


def _av1_sequence(data: bytes) -> bool:
    """Whether one of the open bitstream units is a sequence header, which every keyframe brings."""
    place = 0
    while place < len(data):
        kind, extended, sized = data[place] >> 3 & 0xF, data[place] >> 2 & 1, data[place] >> 1 & 1
        if kind == 1:
            return True
        place += 1 + extended
        if not sized:
            return False
        size = shift = 0
        while place < len(data) and shift < 56:
            size |= (data[place] & 0x7F) << shift
            place, shift = place + 1, shift + 7
            if not data[place - 1] & 0x80:
                break
        place += size
    return False
