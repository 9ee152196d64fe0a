"""Logs to be damaged, and what is in them: for the tests of salvage."""

from __future__ import annotations

import random
import sqlite3
import struct
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from vilp_data.errors import LogError
from vilp_data.salvage import salvage_log
from vilp_data.salvage_report import SalvageReport

LAYOUTS: dict[str, dict[str, Any]] = {
    "none": {"compression": CompressionType.NONE, "chunk_size": 6000},
    "lz4": {"compression": CompressionType.LZ4, "chunk_size": 6000},
    "zstd": {"compression": CompressionType.ZSTD, "chunk_size": 6000},
    "one lz4 chunk": {"compression": CompressionType.LZ4, "chunk_size": 1 << 30},
    "one zstd chunk": {"compression": CompressionType.ZSTD, "chunk_size": 1 << 30},
    "unchunked": {"use_chunking": False},
}


class Sent(NamedTuple):
    topic: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


def write_log(path: Path, *, n: int = 150, size: int = 200, extras: bool = True, **options: Any) -> list[Sent]:
    """An MCAP of `n` messages on three topics, half noise and half not, with an attachment and a metadata record in the middle."""
    rng = random.Random(0)
    sent = []
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("a profile", "test")
        schema = writer.register_schema("Thing", "jsonschema", b'{"type": "object"}')
        channels = [writer.register_channel(f"/topic{i}", "json", schema, {"key": "value"}) for i in range(3)]
        for k in range(n):
            data = rng.randbytes(rng.randrange(1, size)) + b"x" * rng.randrange(size)
            sent.append(Sent(f"/topic{k % 3}", 1000 + 10 * k, 997 + 10 * k, k, data))
            writer.add_message(channels[k % 3], 1000 + 10 * k, data, 997 + 10 * k, k)
            if extras and k == n // 2:
                writer.add_attachment(7, 5, "calibration.bin", "application/x", b"abc" * 300)
                writer.add_metadata("episode", {"success": "true"})
        writer.finish()
    return sent


def write_db3(
    path: Path,
    *,
    n: int = 400,
    journal: str = "DELETE",
    longest: int = 2000,
    page: int = 4096,
    reserved: int = 0,
    distro: str = "",
) -> list[Sent]:
    """A file as rosbag2 writes it, of std_msgs/String; `reserved` bytes of each page are not SQLite's."""
    rng, sent = random.Random(0), []
    path.unlink(missing_ok=True)
    database = sqlite3.connect(path, isolation_level=None)
    database.execute(f"PRAGMA page_size={page}")
    if reserved:
        database.execute("PRAGMA user_version=1")
        with path.open("r+b") as stream:  # before the first table
            stream.seek(20)
            stream.write(bytes([reserved]))
            stream.seek(105)  # where the first page's rows would end
            stream.write((page - reserved).to_bytes(2, "big"))
        database.close()
        database = sqlite3.connect(path, isolation_level=None)
    database.execute(f"PRAGMA journal_mode={journal}")
    database.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
    )
    database.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
    )
    database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    for i in range(3):
        database.execute("INSERT INTO topics VALUES(?, ?, 'std_msgs/msg/String', 'cdr', '')", (i + 1, f"/t{i}"))
    if distro:
        database.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)")
        database.execute("INSERT INTO schema VALUES(4, ?)", (distro,))
    database.execute("BEGIN")
    for k in range(n):
        text = "".join(rng.choices("abcdefgh", k=rng.randrange(1, longest))).encode() + b"\0"
        data = b"\0\1\0\0" + struct.pack("<I", len(text)) + text
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", (k % 3 + 1, 1000 + k, data))
        sent.append(Sent(f"/t{k % 3}", 1000 + k, 1000 + k, 0, data))
    database.execute("COMMIT")
    if journal == "WAL":
        kept = path.with_name("kept-wal")
        kept.write_bytes(path.with_name(path.name + "-wal").read_bytes())
        main = path.read_bytes()
        database.close()
        path.write_bytes(main)
        kept.rename(path.with_name(path.name + "-wal"))
    else:
        database.close()
    return sent


def write_two_tables(path: Path, *, page: int = 512, topic_id: int = 1) -> tuple[list[Sent], dict[str, int]]:
    """A bag of 120 messages and, before and between them, 180 rows of another table of the same shape; and the root of every
    table. Rows of the other one are of topic `topic_id`."""
    write_db3(path, n=0, page=page)
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE thumbs(id INTEGER PRIMARY KEY, topic_id INTEGER, at INTEGER, data BLOB)")
        sent = []
        for k in range(180):
            database.execute("INSERT INTO thumbs VALUES(?, ?, ?, ?)", (k + 1, topic_id, 1000 + k, b"small" * 20))
            if k >= 60:
                sent.append(Sent("/t0", 1000 + k, 1000 + k, 0, b"large%03d" % k * 100))
                database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", sent[-1][1::3])
        database.commit()
        return sent, dict(database.execute("SELECT name, rootpage FROM sqlite_master WHERE type = 'table'").fetchall())


def read_log(path: Path) -> list[Sent]:
    """Every message in file order, by the mcap library, its checksums verified."""
    with path.open("rb") as stream:
        return [
            Sent(channel.topic, message.log_time, message.publish_time, message.sequence, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        ]


def salvaged(path: Path, content: bytes | None = None, **options: Any) -> tuple[list[Sent], SalvageReport | None]:
    """What comes back from a log (with this content), and the report; None where nothing does."""
    if content is not None:
        path.write_bytes(content)
    out = path.with_suffix(".salvaged")
    try:
        report = salvage_log(path, out, force=True, **options)
    except LogError:
        return [], None
    found = read_log(out)
    assert report.recovered == len(found)
    return found, report


def invented(found: list[Sent], sent: list[Sent]) -> int:
    """How many messages came back that nobody sent."""
    return (Counter(found) - Counter(sent)).total()


def cuts(content: bytes, *, steps: int) -> list[bytes]:
    """The content up to each of `steps` equal parts of its length."""
    return [content[: len(content) * step // steps] for step in range(1, steps + 1)]


def mutated(content: bytes, rng: random.Random) -> bytes:
    """The content with one to five changes: bits flipped, bytes overwritten, zeroed, left out or put in."""
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        if changed:
            _change(changed, rng.randrange(len(changed)), rng.randrange(1, 300), rng)
    return bytes(changed)


def _change(content: bytearray, place: int, many: int, rng: random.Random) -> None:
    """One change of a kind drawn at random; most are a single bit."""
    run = slice(place, place + many)
    kind = rng.choices(range(6), (4, 2, 1, 1, 1, 1))[0]
    if kind == 0:
        content[place] ^= 1 << rng.randrange(8)
    elif kind == 1:
        content[place] = rng.choice((0, 1, 127, 128, 255))
    elif kind == 2:
        content[place : place + 8] = b"\xff" * len(content[place : place + 8])
    elif kind == 3:
        content[run] = bytes(len(content[run]))
    elif kind == 4:
        del content[run]
    else:
        content[place:place] = rng.randbytes(many)
