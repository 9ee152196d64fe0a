"""The topics of a log, each under what it is good for in a task: cameras, states, commands, transforms, and what is of no use."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vilp_data.errors import LogError
from vilp_data.log_summary import SAMPLED, LogSummary, TopicSummary, summarise
from vilp_data.sources import IndexedLog, open_log
from vilp_data.topic_roles import TopicRole, role_of, words_of
from vilp_data.topic_times import times_in_index
from vilp_data.transforms import STATIC, links_of
from vilp_data.types import F64, I64, Message

PAUSE_S, PAUSE_PERIODS = 2.0, 20
TOOL_WORDS = ("tool", "tcp", "ee", "gripper", "hand", "flange", "wrist")


@dataclass(frozen=True)
class LogRoles:
    """What was found in a log. `doubles`: topic -> the one that shows the same; `pause_s`: a silence that parts demonstrations, None
    where there is none."""

    summary: LogSummary
    cameras: list[TopicRole]
    doubles: dict[str, str]
    states: list[TopicRole]
    commands: list[TopicRole]
    others: list[TopicRole]
    transforms: list[TopicRole]
    unused: list[TopicRole]
    pause_s: float | None

    def table(self, topic: str) -> TopicSummary:
        return next(found for found in self.summary.topics if found.name == topic)


def roles_in(path: Path) -> LogRoles:
    """The topics of the log at `path`, as far as its index and first messages tell. Raises what `open_log` raises."""
    summary = summarise(path)
    with open_log(path) as log:
        roles = [_role(log, topic) for topic in summary.topics if topic.n_messages != 0]
        doubles = _doubles([role for role in roles if role.kind == "camera"])
        cameras = [role for role in roles if role.kind == "camera" and role.topic not in doubles]
        states = [role for role in roles if role.kind == "state"]
        others = [role for role in roles if role.kind == "other"]
        if not cameras and not states and others:
            states, others = others[:1], others[1:]
        topics = [role.topic for role in (*cameras, *states)]
        times = times_in_index(log, topics)
        pause_s = _pause_s(list(times.values())) if len(times) == len(topics) else None
    return LogRoles(
        summary, cameras, doubles, states, [role for role in roles if role.kind == "command"], others,
        [role for role in roles if role.kind == "transforms" and not role.topic.endswith(STATIC)],
        [role for role in roles if role.kind == "unused"], pause_s if summary.n_episodes == 1 else None,
    )  # fmt: skip


def _role(log: IndexedLog, topic: TopicSummary) -> TopicRole:
    try:
        messages = log.first_messages(topic.name, SAMPLED)
    except LogError as error:
        return TopicRole(topic.name, "unused", f"{error.what}: {error.found}" if error.found else error.what)
    if not messages:
        return TopicRole(topic.name, "unused", "its first messages cannot be found")
    role = role_of(topic.name, messages)
    if role.kind not in ("unused", "transforms") and topic.n_messages is not None and topic.n_messages < 2:
        return TopicRole(topic.name, "unused", f"{role.why}, but one message only")
    if role.kind == "camera" and topic.rate_hz is None:
        return TopicRole(topic.name, "unused", f"{role.why}, but all at one time")
    if role.kind == "transforms" and role.reference_frames and not topic.name.endswith(STATIC):
        from_to, frames = _frame_pair(log, topic.name, messages)
        return replace(role, from_to=from_to, reference_frames=frames)
    return role


def _frame_pair(log: IndexedLog, topic: str, messages: Sequence[Message]) -> tuple[tuple[str, str], tuple[str, ...]]:
    """(from, to): the root of the tree, and of the frames without a child the one that is called like a tool, else the lowest; and
    every frame there is."""
    links = [link for message in messages for link in links_of(message, clock="log")]
    if any(known.name == topic + STATIC and known.message_count != 0 for known in log.topics()):
        static = log.first_messages(topic + STATIC, SAMPLED)
        links += [link for message in static for link in links_of(message, clock="log", static=True)]
    parent = {link.child: link.parent for link in links}
    leaves = sorted(set(parent) - set(parent.values())) or sorted(parent)

    def above(frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in parent and parent[chain[-1]] not in chain:
            chain.append(parent[chain[-1]])
        return chain

    def is_tool(frame: str) -> bool:
        return any(word.rstrip("0123456789") in TOOL_WORDS for word in words_of(frame))

    leaf = max(leaves, key=lambda frame: (is_tool(frame), len(above(frame)), frame))
    frames = {name for link in links for name in (link.parent, link.child)}
    return (above(leaf)[-1], leaf), tuple(sorted(frames))


def _doubles(cameras: Sequence[TopicRole]) -> dict[str, str]:
    """Topics that show what another one shows too (raw beside compressed), and which: the compressed one is smaller to read."""
    groups: dict[str, list[TopicRole]] = {}
    for role in cameras:
        base = re.sub(r"/(compressed|image_raw|image_rect_color|image_color|image|h264|theora|ffmpeg)$", "", role.topic)
        base = re.sub(r"/(image_raw|image_rect_color|image_color|image)$", "", base)
        groups.setdefault(f"{base} {role.picture.depth_unit if role.picture else None}", []).append(role)
    doubles = {}
    for roles in groups.values():
        best = max(roles, key=lambda role: (role.topic.endswith("/compressed"), role.topic))
        doubles.update({role.topic: best.topic for role in roles if role is not best})
    return doubles


def _pause_s(times: Sequence[I64]) -> float | None:
    """A silence on all topics at once that parts demonstrations: well above the usual interval; None where there is none."""
    if not times or sum(map(len, times)) < 3:
        return None
    stamps = np.unique(np.concatenate(times))
    gaps_s: F64 = np.diff(stamps) / 1e9
    pauses = gaps_s[gaps_s > max(PAUSE_S, PAUSE_PERIODS * float(np.median(gaps_s)))] if len(gaps_s) else gaps_s
    return float(f"{pauses.min() / 2:.2g}") if len(pauses) else None
