"""When the messages of topics came: from a log's index, where that tells all of them, else by reading the log; no message is decoded."""

from __future__ import annotations

from array import array
from collections.abc import Iterable

import numpy as np

from vilp_data.cut_identity import HoldsMessages
from vilp_data.sources import IndexedLog
from vilp_data.types import I64


def times_in_index(log: IndexedLog, topics: Iterable[str]) -> dict[str, I64]:
    """Topic -> log times int64 [n] in file order, of those topics whose every message the index tells."""
    counts = {topic.name: topic.message_count for topic in log.topics()}
    times, complete = log.message_times()
    return {
        topic: times.get(topic, np.zeros(0, np.int64))
        for topic in topics
        if complete and len(times.get(topic, ())) == counts.get(topic, -1)
    }


def times_of(log: IndexedLog, topics: Iterable[str]) -> I64:
    """Log times int64 [n] of every message of these topics, all of which the log has, in no order."""
    topics = list(topics)
    told = times_in_index(log, topics)
    read = array("q")
    if untold := [topic for topic in topics if topic not in told]:
        messages = log.raw_messages(untold) if isinstance(log, HoldsMessages) else log.messages(untold)
        read.extend(message.log_time_ns for message in messages)
    return np.concatenate([*told.values(), np.array(read, np.int64)])
