"""Which topics tell a robot what to do and which say what it does: by the task, else by their names. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from vilp_data.plots import COMMAND_WORDS, STATE_WORDS
from vilp_data.spec import TaskSpec

MORE_STATE_WORDS = ("odom", "tcp", "arm", "hand", "body")
NEVER = ("sim", "states", "env", "tf", "rosout", "diagnostics", "camera_info", "event", "events", "param")
"""Parts of names of topics that say nothing of a robot: a simulator's own state (`states` in robomimic's files), logs, calibration."""


@dataclass(frozen=True)
class Roles:
    """`commands` and `states`, topics in the order they are to be taken in."""

    commands: tuple[str, ...] = ()
    states: tuple[str, ...] = ()

    def judged(self, topic: str) -> bool:
        """Whether a topic's numbers are judged: those of a robot. A counter or a calibration has good reasons to stand still."""
        return topic in self.commands or topic in self.states


def roles_of(spec: TaskSpec) -> Roles:
    """The topics that a task calls action and low_dim."""
    commands = [part.topic for part in spec.action.values() if part.topic is not None]
    states = [part.topic for part in spec.low_dim.values()]
    return Roles(tuple(dict.fromkeys(commands)), tuple(dict.fromkeys(topic for topic in states if topic is not None)))


def guessed_roles(topics: Iterable[str]) -> Roles:
    """By names: `action`, `cmd`, … are commands; `joint`, `pose`, `state`, … states."""
    commands, states = [], []
    for topic in sorted(topics):
        parts = [part for part in topic.lower().replace(".", "/").split("/") if part]
        if any(part in NEVER for part in parts):
            continue
        if any(word in topic.lower() for word in COMMAND_WORDS):
            commands.append(topic)
        elif any(word in topic.lower() for word in (*STATE_WORDS, *MORE_STATE_WORDS)):
            states.append(topic)
    return Roles(tuple(commands), tuple(states))
