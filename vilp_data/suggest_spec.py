"""A task TOML for a log that nobody has described yet: `suggest_spec(path)` says what it would read, and why.

It is a beginning. What only the user knows, above all which topic is the action, stands there as a line to un-comment."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from vilp_data.errors import LogError, some_of
from vilp_data.log_roles import LogRoles, roles_in
from vilp_data.log_summary import header_gap
from vilp_data.model_size import common_size, cut_share
from vilp_data.task_toml import parse_task
from vilp_data.topic_roles import Picture, TopicRole, words_of

ONE_CLOCK_S = 1.0
"""Header stamps this near log time may stand beside topics that are read by log time."""

LONGEST_LIST = 16  # topics of no use that are named
FASTEST_HZ = 30.0  # for a task without cameras
DULL_WORDS = ("observation", "obs", "msg", "data")  # of a topic's name
SLOW_HZ = 5.0  # below it the usual stale_after_s would mask half of the steps
CAMERA_WORDS = {
    *(
        "camera",
        "cam",
        "image",
        "images",
        "img",
        "raw",
        "rect",
        "color",
        "colour",
        "rgb",
        "compressed",
        "compresseddepth",
        "data",
    ),
    *("sensor", "sensors", "observation", "observations", "obs", "video", "h264", "depth", "view", "topic"),
}
"""Words of a camera topic that do not tell one camera from another."""


def suggest_spec(path: Path, *, name: str | None = None) -> str:
    """The text of a task TOML for the log at `path`. Raises what `open_log` raises, and LogError where nothing in the log could be
    read by a task."""
    look = roles_in(path)
    if not look.cameras and not look.states and not look.others:
        found = "; ".join(f"{role.topic}: {role.why}" for role in look.unused[:3]) or "no messages"
        raise LogError(
            "no camera and no numbers that a task could read", where=path, found=found, remedy="name another log"
        )
    clocks = _clocks(look)
    names = _Names(role.topic for role in (*look.states, *look.others, *look.commands))
    low_dim, parts = _low_dim_lines(look, clocks, names)
    lines = [
        f"# A task for {path.name}, suggested by `vilp-data inspect --suggest-spec`.",
        "# Change what you know better; docs/task_toml.md has every key.",
        f'name = "{_plain(name or path.stem) or "task"}"',
        _rate_line(look),
        "",
        *low_dim,
        *_action_lines(look, clocks, names, parts),
        *_episodes_lines(look),
        *_view_lines(look, clocks, names),
        *_unused_lines(look),
    ]
    text = "\n".join(_printable(line) for line in lines).rstrip("\n") + "\n"
    parse_task(text, where=f"the task suggested for {path}")
    return text


# --- writing ------------------------------------------------------------------------------------------------------------


class _Names:
    """Names that were not given yet, for parts of low_dim and action whose topics these are, and for views."""

    def __init__(self, topics: Iterable[str]) -> None:
        self._given: set[str] = set()
        self._parts = _part_names(list(topics))

    def part(self, topic: str) -> str:
        return self.new(self._parts[topic])

    def new(self, wanted: str) -> str:
        base, number = _plain(wanted) or "part", 2
        name = base
        while name in self._given:
            name, number = f"{base}_{number}", number + 1
        self._given.add(name)
        return name


def _plain(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", text).strip("_-")


def _part_names(topics: Sequence[str]) -> dict[str, str]:
    """`/left/joint_states` is left_joint_states; words that say nothing are left out, and the last three are taken. Where several topics
    end alike, a name is of the words that they do not share, with the end behind them where even that does not tell them apart."""
    words = {topic: [word for word in words_of(topic) if word not in DULL_WORDS] for topic in topics}
    ends = {topic: "_".join(words[topic][-3:]) for topic in topics}
    alike: dict[str, list[str]] = {}
    for topic, end in ends.items():
        alike.setdefault(end, []).append(topic)
    names = dict(ends)
    for group in alike.values():
        shared = set.intersection(*(set(words[topic]) for topic in group)) if len(group) > 1 else set()
        names |= {
            topic: "_".join(w for w in words[topic] if w not in shared) or ends[topic] for topic in group if shared
        }
    given = Counter(names.values())
    return {topic: name if given[name] == 1 else f"{name}_{ends[topic]}" for topic, name in names.items()}


def _view_name(topic: str) -> str:
    words = words_of(topic)
    telling = [word for word in words if word not in CAMERA_WORDS]
    return (
        "_".join(telling[-2:])
        or "_".join(word for word in words if word in ("cam", "camera", "image", "img"))[:20]
        or "camera"
    )


def _printable(line: str) -> str:
    """A line of the file that stays one, whatever a log calls its topics."""
    return "".join(c if c.isprintable() else "?" for c in line)


def _toml(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _clocks(look: LogRoles) -> dict[str, tuple[str, str]]:
    """Topic -> its clock and the reason. Headers are better (the recorder's delay is not in them), but one task has one time."""
    roles = [*look.cameras, *look.states, *look.commands, *look.others, *look.transforms]
    lags = [role.header_lag_s for role in (*look.cameras, *look.states, *look.commands)]
    known = [lag for lag in lags if lag is not None]
    agree = bool(known) and len(known) == len(lags) and max(known) - min(known) <= ONE_CLOCK_S
    clocks = {}
    for role in roles:
        if role.header_lag_s is None:
            clocks[role.topic] = "log", "its header stamps tell no time" if role.stamped else ""
        elif abs(role.header_lag_s) <= ONE_CLOCK_S or agree:
            clocks[role.topic] = "header", ""
        else:
            clocks[role.topic] = (
                "log",
                f"{header_gap(role.header_lag_s)}, and not every topic has them",
            )
    return clocks


def _rate_line(look: LogRoles) -> str:
    summary = look.summary
    if summary.assumed_rate_hz is not None:
        return f"rate_hz = {summary.assumed_rate_hz:g}  # rows carry no time in this format: write the rate at which they were recorded"
    rates = {role.topic: look.table(role.topic).rate_hz for role in look.cameras}
    known = {topic: rate for topic, rate in rates.items() if rate}
    if known:
        slowest = min(known, key=lambda topic: known[topic])
        return (
            f"rate_hz = {_round(known[slowest]):g}  # that of the slowest camera, {slowest}; a lower one trains faster"
        )
    counted = [
        (look.table(role.topic).n_messages or 0) / summary.duration_s for role in look.states if summary.duration_s > 0
    ]
    rate_hz = min([FASTEST_HZ, *(rate for rate in counted if rate > 0)])
    return (
        f"rate_hz = {_round(rate_hz):g}  # there is no camera to take it from; models need one, ingest and check do not"
    )


def _round(rate_hz: float) -> float:
    return float(round(rate_hz)) if abs(rate_hz / max(round(rate_hz), 1) - 1) < 0.02 else float(f"{rate_hz:.3g}")


def _entry(
    look: LogRoles,
    role: TopicRole,
    clocks: dict[str, tuple[str, str]],
    group: Sequence[str] = (),
    *,
    held: bool = False,
) -> str:
    """The inline table of a vector. `held`: a command, which grows no staler."""
    items = {"topic": role.topic, "clock": clocks[role.topic][0]}
    text = ", ".join(f"{key} = {_toml(value)}" for key, value in items.items() if (key, value) != ("clock", "header"))
    if role.fields:
        text += f", fields = {_toml(list(role.fields))}"
    if group:
        text += f", names = {_toml(list(group))}"
    rate_hz = look.table(role.topic).rate_hz
    if not held and rate_hz is not None and rate_hz < SLOW_HZ:
        text += f", stale_after_s = {float(f'{2.5 / rate_hz:.2g}'):g}"
    return f"{{ {text} }}"


def _why(role: TopicRole, clocks: dict[str, tuple[str, str]]) -> str:
    clock = clocks[role.topic][1]
    return role.why + (f"; {clock}" if clock else "")


def _low_dim_lines(look: LogRoles, clocks: dict[str, tuple[str, str]], names: _Names) -> tuple[list[str], list[str]]:
    """The lines, and the names of the parts that are not commented out."""
    lines, given = [], []
    for role in (*look.states, *look.others[:LONGEST_LIST]):
        hidden = "" if role in look.states else "# "
        for group in role.name_groups or ((),):
            part = names.part(role.topic)
            lines.append(f"{hidden}low_dim.{part} = {_entry(look, role, clocks, group)}  # {_why(role, clocks)}")
            given += [] if hidden else [part]
    for role in look.transforms[:LONGEST_LIST]:
        if role.from_to is None:
            continue
        base, tool = role.from_to
        clock = "" if clocks[role.topic][0] == "header" else ', clock = "log"'
        pair = f"from_frame = {_toml(base)}, to_frame = {_toml(tool)}"
        shown = some_of(role.reference_frames, LONGEST_LIST)
        lines.append(
            f"# low_dim.{names.new(_plain(tool))} = {{ topic = {_toml(role.topic)}{clock}, {pair} }}  # frames: {shown}"
        )
    head = "# What a policy sees besides images; parts are concatenated in this order."
    return ([head, *lines, ""] if lines else []), given


def _action_lines(look: LogRoles, clocks: dict[str, tuple[str, str]], names: _Names, parts: Sequence[str]) -> list[str]:
    sure = len(look.commands) == 1
    lines = []
    for role in look.commands:
        hidden = "" if sure else "# "
        delta = ', kind = "delta"' if set(words_of(role.topic)) & {"delta", "dpos", "deltas"} else ""
        for group in role.name_groups or ((),):
            entry = _entry(look, role, clocks, group, held=True)[:-2] + delta + " }"
            lines.append(f"{hidden}action.{names.part(role.topic)} = {entry}  # {_why(role, clocks)}")
    for part in parts if not sure else ():
        lines.append(
            f'# action.{names.new(part + "_next")} = {{ from = "{part}", shift = 1 }}  # the state one step later'
        )
    if sure:
        head = "Only one topic is called like a command."
    elif look.commands:
        head = "Un-comment the topics that the robot obeyed; without any, episodes are only watched."
    elif lines:
        head = "No topic is called like a command: un-comment a line to take the state one step later for it, or"
        head += " episodes are only watched: nothing learns to act from them."
    else:
        head = "Nothing in this log says: its episodes are only watched."
    return [f"# What the robot was told to do. {head}", *lines, ""]


def _episodes_lines(look: LogRoles) -> list[str]:
    if (count := look.summary.n_episodes) > 1:
        n_whole = look.summary.n_whole
        whole = "" if n_whole in (None, count) else f"; the files of {n_whole} of them are all there"
        return [f"# The log's own {count} demonstrations are taken as they are{whole}.", ""]
    lines = []
    if look.pause_s is not None:
        lines.append(
            f'# episodes = {{ by = "gap", gap_s = {look.pause_s:g} }}  # the log pauses: one demonstration between two pauses'
        )
    for role in (*look.others, *look.states, *look.commands):
        if role.marks:
            lines.append(
                f'# episodes = {{ by = "topic", topic = {_toml(role.topic)} }}  # a demonstration while its value is true'
            )
    if not lines:
        return []
    return [
        "# One log, several demonstrations: un-comment one, then `vilp-data ingest LOG --task FILE --preview`.",
        *lines,
        "",
    ]


def _view_lines(look: LogRoles, clocks: dict[str, tuple[str, str]], names: _Names) -> list[str]:
    pictures = [(role, role.picture) for role in look.cameras if role.picture is not None]
    if not pictures:
        return []
    size = common_size([(picture.height, picture.width) for _, picture in pictures])
    lines = []
    for role, picture in pictures:
        clock, reason = clocks[role.topic]
        cut = cut_share(size.height, size.width, picture.height, picture.width)
        lines += [f"[views.{names.new(_view_name(role.topic))}]", f"topic = {_toml(role.topic)}  # {role.why}"]
        lines += [f"height = {size.height}", f"width = {size.width}"]
        lines += [f'fit = "crop"  # {cut:.0%} of the picture lies outside; "pad" keeps all of it'] if cut else []
        if clock != "header" and picture.reordered and role.header_lag_s is not None:
            lines.append(f"offset_s = {role.header_lag_s:.3f}  # {reason}, and by log time B frames are out of order")
        elif clock != "header":
            lines.append(f'clock = "{clock}"' + (f"  # {reason}" if reason else ""))
        if (rate_hz := look.table(role.topic).rate_hz) is not None and rate_hz < SLOW_HZ:
            lines.append(f"stale_after_s = {float(f'{2.5 / rate_hz:.2g}'):g}  # {rate_hz:.2g} images a second")
        lines += [*_number_lines(role.topic, picture), ""]
    return lines


def _number_lines(topic: str, picture: Picture) -> list[str]:
    """What the numbers of a camera without colours mean; of grey of 16 bits, which may be either, both lines, one commented out."""
    if picture.depth_unit is None:
        return []
    near, far = (number * (1e-3 if picture.depth_unit == "mm" else 1.0) for number in picture.near_far)
    near, far = float(f"{near:.2g}"), float(f"{far:.2g}")
    far = far if far > near else near + 1.0
    depth = f'depth = {{ unit = "{picture.depth_unit}", near_m = {near:g}, far_m = {far:g} }}  # the range of the first image'
    if not picture.grey16:
        return [depth]
    black = min(round(picture.near_far[0]), 65534)
    white = max(round(picture.near_far[1]), black + 1)
    levels = f"levels = [{black}, {white}]  # what becomes black and white: the range of the first image"
    if "depth" in words_of(topic):
        return [depth, f"# {levels}; instead of depth, if this is a picture"]
    return [levels, f"# {depth}; instead of levels, if this measures distance"]


def _unused_lines(look: LogRoles) -> list[str]:
    left = [*((topic, f"shows what {other} shows") for topic, other in look.doubles.items())]
    left += [(role.topic, role.why) for role in look.unused]
    left += [(role.topic, role.why) for role in look.others[LONGEST_LIST:]]
    if not left:
        return []
    lines = ["# Not used:", *(f"#   {topic}: {why}" for topic, why in left[:LONGEST_LIST])]
    return [*lines, f"#   and {len(left) - LONGEST_LIST} more"] if len(left) > LONGEST_LIST else lines
