"""What a topic of an unknown log is good for in a task: a camera, a state, a command, transforms, a marker; judged by a few messages."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from vilp_data.decode import decode_image, decode_vector, header_time_ns, image_encoding, is_image
from vilp_data.decode.depth import is_depth, is_grey16, measured_depth
from vilp_data.decode.numeric_fields import numeric_paths
from vilp_data.decode.usual_fields import usual_fields
from vilp_data.decode.vectors import published_names
from vilp_data.decode.video import VideoDecoder
from vilp_data.decode.video_packet import is_video, video_codec
from vilp_data.errors import VilpDataError
from vilp_data.transforms import links_of
from vilp_data.types import Message

Kind = Literal["camera", "state", "command", "other", "transforms", "unused"]

COMMAND_WORDS = {
    *(
        "action",
        "actions",
        "cmd",
        "command",
        "commands",
        "commanded",
        "target",
        "targets",
        "goal",
        "desired",
        "setpoint",
        "teleop",
    ),
    *("servo", "leader", "reference", "trajectory"),
}
NEVER_WORDS = {
    *(
        "rosout",
        "diagnostics",
        "parameter",
        "events",
        "info",
        "calibration",
        "timestamp",
        "timestamps",
        "time",
        "clock",
        "index",
        "next",
    ),
    *("reward", "rewards", "done", "dones", "success", "feedback", "status", "result", "stats", "statistics"),
}
SIMULATOR_WORDS = {"sim", "states", "simulator"}
MARKER_WORDS = {
    "episode",
    "recording",
    "record",
    "trigger",
    "active",
    "running",
    "start",
    "stop",
    "enable",
    "enabled",
    "task",
}
TRANSFORMS = re.compile(
    r"(^|/)(tf2_msgs/msg/TFMessage|tf/msg/tfMessage|tf2_msgs/TFMessage|tf/tfMessage)$|FrameTransforms?$"
)
STATE_SCHEMAS = re.compile(r"JointStates?$|Pose\w*$|Odometry$|Transform\w*$|^array$|GripperState$|MultiArray$")

LONGEST_VECTOR = 64
MOST_FIELDS = 12
JUMP_NS = 1_000_000_000


@dataclass(frozen=True)
class Picture:
    """A camera's images. `depth_unit`: of one that measures distance, with the range of its first image in that unit. `grey16`: of one
    that may as well be a picture, so that the unit and the range are those of its numbers if it is none. `reordered`: video with
    B frames."""

    height: int
    width: int
    encoding: str
    depth_unit: str | None = None
    near_far: tuple[float, float] = (0.0, 0.0)
    grey16: bool = False
    reordered: bool = False


@dataclass(frozen=True)
class TopicRole:
    """A topic and what it is good for. `fields` and `names` as a task would state them; `why`: the reason, in words.

    stamped        its messages carry stamps of their own
    header_lag_s   log time minus header stamp; None where the stamps cannot be used
    name_groups    joints by publisher, where several share the topic
    reference_frames  of transforms: those that its first messages name; from_to: two of them that a robot is likely to be about
    """

    topic: str
    kind: Kind
    why: str
    picture: Picture | None = None
    size: int = 0
    fields: tuple[str, ...] = ()
    name_groups: tuple[tuple[str, ...], ...] = ()
    stamped: bool = False
    header_lag_s: float | None = None
    marks: bool = False
    reference_frames: tuple[str, ...] = ()
    from_to: tuple[str, str] | None = None


def role_of(topic: str, messages: list[Message]) -> TopicRole:
    """The role of a topic by its name and its first messages, at least one."""
    first = messages[0]
    stamped, lag_s = header_time_ns(first) is not None, _header_lag_s(messages)
    try:
        if TRANSFORMS.search(first.schema):
            links = [link for message in messages for link in links_of(message, clock="log")]
            frames = tuple(sorted({name for link in links for name in (link.parent, link.child)}))
            return TopicRole(
                topic, "transforms", "transforms", stamped=True, header_lag_s=_tf_lag_s(messages),
                reference_frames=frames,
            )  # fmt: skip
        if is_image(first) or is_video(first) or is_depth(first):
            picture = _picture(messages)
            why = f"{picture.height}x{picture.width} {picture.encoding}"
            return TopicRole(topic, "camera", why, picture, stamped=stamped, header_lag_s=lag_s)
        return replace(_vector_role(topic, messages), stamped=stamped, header_lag_s=lag_s)
    except VilpDataError as error:
        return TopicRole(topic, "unused", f"{error.what}: {error.found}" if error.found else error.what)


def words_of(topic: str) -> list[str]:
    """The words of a topic's name, lower case: `/leftArm/joint_states` is left, arm, joint, states."""
    spaced = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", topic)
    return [word.lower() for word in re.split(r"[^A-Za-z0-9]+", spaced) if word]


def _picture(messages: list[Message]) -> Picture:
    first = messages[0]
    if not is_video(first) and (is_depth(first) or is_grey16(first)):
        numbers = measured_depth(first)
        read = numbers[np.isfinite(numbers) & (numbers > 0)].astype(np.float64)
        near, far = np.quantile(read, [0.02, 0.98]).tolist() if len(read) else (0.0, 0.0)
        unit = "m" if numbers.dtype.kind == "f" else "mm"
        height, width = numbers.shape[:2]
        return Picture(height, width, image_encoding(first), unit, (near, far), grey16=not is_depth(first))
    if is_video(first):
        return _video_picture(messages)
    height, width, _ = decode_image(first).shape
    return Picture(height, width, image_encoding(first))


def _video_picture(messages: list[Message]) -> Picture:
    decoder, codec = VideoDecoder(), video_codec(messages[0])
    fed = [decoder.feed(number, message) for number, message in enumerate(messages)]
    shown = [(number, frame.height, frame.width) for frames in (*fed, decoder.rest()) for number, frame in frames]
    if not shown:
        raise next(
            iter(decoder.lost.values()), VilpDataError("no picture in its first packets", where=messages[0].topic)
        )
    numbers = [number for number, _, _ in shown]
    _, height, width = shown[0]
    return Picture(height, width, codec, reordered=numbers != sorted(numbers))


def _vector_role(topic: str, messages: list[Message]) -> TopicRole:
    first, words = messages[0], set(words_of(topic))
    if words & NEVER_WORDS:
        return TopicRole(topic, "unused", "its name says that it is no state of the robot")
    known = first.schema == "array" or usual_fields(first.schema) is not None
    fields = () if known else tuple(numeric_paths(first.body))
    if not known and not fields:
        return TopicRole(topic, "unused", f"{first.schema or 'it'} holds no numbers")
    if (
        fields == ()
        and first.schema != "array"
        and usual_fields(first.schema) == ("position",)
        and not len(decode_vector(first))
    ):
        fields = ("velocity",)
    groups = tuple(dict.fromkeys(names for message in messages if (names := published_names(message))))
    sizes = {
        len(decode_vector(message, fields)) for message in messages if published_names(message) in (*groups[:1], ())
    }
    if len(sizes) != 1 or not 0 < (size := sizes.pop()) <= LONGEST_VECTOR or len(fields) > MOST_FIELDS:
        return TopicRole(topic, "unused", f"its messages hold {sorted(sizes) or size} numbers: name the fields to take")
    marks = size == 1 and (bool(words & MARKER_WORDS) or first.schema.endswith("/Bool"))
    kind, why = _kind(first, words, known, size)
    return TopicRole(topic, kind, why, size=size, fields=fields, name_groups=groups, marks=marks)


def _kind(first: Message, words: set[str], known: bool, size: int) -> tuple[Kind, str]:
    many = f"{size} number{'s' if size > 1 else ''}"
    if named := sorted(words & COMMAND_WORDS):
        return "command", f'its name says "{named[0]}"; {many}'
    if _of_a_simulator(first.schema, words):
        return "other", f"{many}; a simulator's own state is nothing that a robot could see"
    if not known:
        return "other", f"{many} of a type of its own, {first.schema}"
    plain = first.schema == "array" and np.ndim(first.body) != 1
    if STATE_SCHEMAS.search(first.schema) and not plain and size > (1 if first.schema == "array" else 0):
        return "state", many if first.schema == "array" else f"{first.schema}, {many}"
    return "other", f"{first.schema}, {many}"


def _of_a_simulator(schema: str, words: set[str]) -> bool:
    """Whether an array holds a simulated world: "states" is enough where a table calls it that, but not of a robot's message."""
    if schema == "array":
        return bool(words & SIMULATOR_WORDS)
    return schema.endswith("MultiArray") and bool(words & (SIMULATOR_WORDS - {"states"}))


def _header_lag_s(messages: list[Message]) -> float | None:
    """Log time minus header stamp, the median; None where stamps are missing, unset, constant, or jump back."""
    return _lag_s([(header_time_ns(message), message.log_time_ns) for message in messages])


def _tf_lag_s(messages: list[Message]) -> float | None:
    try:
        pairs = [
            (link.stamp_ns, message.log_time_ns) for message in messages for link in links_of(message, clock="header")
        ]
    except VilpDataError:
        return None
    return _lag_s([*pairs])


def _lag_s(pairs: list[tuple[int | None, int]]) -> float | None:
    stamps = [stamp for stamp, _ in pairs if stamp]
    if len(stamps) < len(pairs) or (len(stamps) > 1 and len(set(stamps)) == 1):
        return None
    if len(stamps) > 1 and int(np.diff(stamps).min()) < -JUMP_NS:
        return None
    return float(np.median([log - stamp for stamp, log in pairs if stamp is not None])) / 1e9
