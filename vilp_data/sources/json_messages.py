"""JSON messages into dicts and lists, none of them nested deeper than what walks a message's members can follow."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from vilp_data import limits


def read_json(data: bytes) -> Any:
    """The message; ValueError where it is no JSON, or nests deeper than limits.JSON_DEPTH."""
    marks = np.frombuffer(data, np.uint8)
    opening = (marks == ord("[")) | (marks == ord("{"))
    # Brackets inside strings count too, so this is never too few; only where it is too many does the message itself tell.
    if int(opening.sum()) > limits.JSON_DEPTH:
        closing = (marks == ord("]")) | (marks == ord("}"))
        most = int(np.cumsum(opening.astype(np.int32) - closing).max())
        suspect = most > limits.JSON_DEPTH or b'"' in data
    else:
        suspect = False
    message = json.loads(data)
    if suspect and _is_deeper(message, limits.JSON_DEPTH):
        raise ValueError(f"lists and objects nested more than {limits.JSON_DEPTH} deep (VILP_MAX_JSON_DEPTH)")
    return message


def _is_deeper(message: Any, depth: int) -> bool:
    level = [message]
    for _ in range(depth + 1):
        level = [
            inner
            for value in level
            if isinstance(value, list | dict)
            for inner in (value.values() if isinstance(value, dict) else value)
            if isinstance(inner, list | dict)
        ]
        if not level:
            return False
    return True
