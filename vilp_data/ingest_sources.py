"""The demonstrations in the logs of one ingest, each known by its bytes; and which known ones today's logs still hold, unchanged."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from vilp_data.cut_identity import Cut, cut_sha256
from vilp_data.cut_log import cut_log
from vilp_data.decode import decode_vector
from vilp_data.decode.column_names import ColumnNames
from vilp_data.demonstrations import LOG_TAG
from vilp_data.errors import DecodeError, LogError, SpecError, some_of
from vilp_data.held_messages import held_sha256
from vilp_data.keys import digest
from vilp_data.log_hashes import HashCache
from vilp_data.sources import IndexedLog, open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import LogEpisode
from vilp_data.vector_tracks import vector_tables

ARRAY = "array"
"""What readers of tables and arrays call the schema of their numbers."""

HELD = "held"
"""Where `EpisodeEntry.cut` says what a cut was made of besides its own messages."""


def held_of(cut: Mapping[str, Any]) -> str:
    """As `Source.held`, of an episode's `cut`."""
    return str(cut.get(HELD, ""))


@dataclass(frozen=True)
class Source:
    """One demonstration of one log, before it is known which episode it is. `alone`: its log holds no other. `cut`: where it was cut out
    of its log, None for a log's own. `held`: SHA-256 of what a cut is made of besides its own messages, "" where that is nothing.
    `told`: part -> what the log calls the numbers of its arrays today, of parts that are read from arrays; empty where it
    calls them nothing."""

    log: Path
    demonstration: LogEpisode
    sha256: str
    alone: bool
    cut: Cut | None = None
    held: str = ""
    told: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def made_of(self) -> tuple[str, str]:
        """All that an ingest of it takes in: its own bytes, and what holds in it from before."""
        return self.sha256, self.held

    @property
    def key_sha256(self) -> str:
        """What its key depends on."""
        return digest(self.made_of) if self.held else self.sha256

    @property
    def place(self) -> dict[str, Any]:
        """What `EpisodeEntry.cut` says of it."""
        return {} if self.cut is None else self.cut.to_json() | ({HELD: self.held} if self.held else {})


@dataclass(frozen=True)
class KnownCut:
    """An episode that was cut out of a log called `log`, stored or removed."""

    id: str
    log: str
    sha256: str
    cut: Cut


@dataclass
class Sources:
    """`found` in order of the logs' names, what is made of the same bytes once. `held`: log -> the known cuts that it holds though its
    demonstrations are others now: those that it holds unchanged; and the others too where these are at least half of what is known by
    its name, so that it is the same log, edited. Logs that cannot be read (name, why); sentences about the rest."""

    found: list[Source] = field(default_factory=list)
    held: dict[Path, list[KnownCut]] = field(default_factory=dict)
    failed: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_sources(logs: Sequence[Path], spec: TaskSpec, cache: HashCache, known: Sequence[KnownCut] = ()) -> Sources:
    """Every demonstration of the logs, in whatever order these are given. Reads them as far as the cache does not know them."""
    sources, by_bytes, copies = Sources(), dict[tuple[str, str], Source](), list[tuple[Source, Source]]()
    for path in sorted(logs, key=lambda path: (path.name, str(path))):
        try:
            with open_log(path, array_rate_hz=spec.rate_hz or 10.0) as log:
                found, held, notes = _read_log(log, path, spec, cache, [one for one in known if one.log == path.name])
        except (LogError, DecodeError, SpecError) as error:
            sources.failed.append((path.name, str(error)))
            continue
        sources.held[path] = held
        sources.notes += notes
        for source in found:
            first = by_bytes.setdefault(source.made_of, source)
            if first is source:
                sources.found.append(source)
            else:
                copies.append((source, first))
    sources.notes += _about_copies(copies)
    return sources


def _read_log(
    log: IndexedLog, path: Path, spec: TaskSpec, cache: HashCache, known: Sequence[KnownCut]
) -> tuple[list[Source], list[KnownCut], list[str]]:
    """The log's demonstrations, with the tags that the task gives them, the known cuts that it holds, and sentences."""
    natives, remember = log.episodes(), partial(cache.remembered, path)
    hashes = cache.of_log(log, path, natives)
    if not natives:
        raise LogError("the log holds no message", where=path, remedy="leave it out")
    cuts = cut_log(log, spec, path, remember)
    notes = [*cuts.notes, *(f"{path}: {doubt}" for doubt in log.doubts())]
    told = spec.tags_of(path.name)
    demonstrations = [replace(one, tags={**told, **one.tags}) for one in cuts.demonstrations]
    if spec.episodes.kind == "file":
        alone = len(natives) == 1
        names = _names_of_arrays(log, spec)
        return [Source(path, one, hashes[one.name], alone, told=names) for one in demonstrations], [], notes
    topics = tuple(sorted({topic.name for topic in log.topics()}.intersection(spec.topics())))
    found, names = [], _names_of_arrays(log, spec)
    for one in demonstrations:
        cut = Cut(one.start_ns, one.end_ns, topics)
        native = hashes[cuts.native[one.name]]
        sha256, held = cut_sha256(log, cut, native, remember), held_sha256(log, one, spec, native, remember)
        found.append(Source(path, one, sha256, alone=False, cut=cut, held=held, told=names))
    today = {source.sha256 for source in found}
    others = [one for one in known if one.sha256 not in today]
    still = [one for one in others if _holds(log, natives, hashes, one, remember)]
    return found, others if _is_same_log(known, others, still) else still, notes


def _names_of_arrays(log: IndexedLog, spec: TaskSpec) -> dict[str, Sequence[str]]:
    """`Source.told`: names that a log gives beside its messages may change while these do not; one message says how wide a part is."""
    topics, told = {topic.name: topic for topic in log.topics()}, dict[str, Sequence[str]]()
    for part, table in vector_tables(spec).items():
        topic = topics.get(str(table.topic))
        if topic is None or topic.schema != ARRAY or table.names:
            continue
        if not topic.names:
            told[part] = ()
            continue
        names = ColumnNames(table.fields, topic.names)
        with suppress(LogError, DecodeError):  # said where it is ingested
            for message in islice(log.messages([topic.name]), 1):
                names.add(message, len(decode_vector(message, table.fields)))
                told[part] = names.names
    return told


def _is_same_log(known: Sequence[KnownCut], others: Sequence[KnownCut], still: Sequence[KnownCut]) -> bool:
    """Whether at least half of what is known by a log's name is unchanged in it. What lies over a known cut that is not was stored beside
    it, so it is of another log of that name, and does not count: else an ingest that was killed would go on otherwise than it began."""
    gone = [one for one in others if one not in still]
    unchanged = [
        one for one in known if one not in gone and not any(one.cut.overlap_ns(other.cut) > 0 for other in gone)
    ]
    return 0 < len(unchanged) >= len(gone)


def _about_copies(copies: Sequence[tuple[Source, Source]]) -> Iterator[str]:
    """A sentence about what each log was copied to, however many demonstrations and logs that is."""
    of: dict[tuple[Path, str], list[tuple[Source, Source]]] = {}
    for source, first in copies:
        of.setdefault((first.log, _likeness(source)), []).append((source, first))
    for (log, likeness), pairs in of.items():
        what = f"{_named(pairs[0][0])}: a copy of {_named(pairs[0][1])}"
        if len(pairs) > 1:
            logs = some_of(list(dict.fromkeys(str(source.log) for source, _ in pairs)), 3)
            what = f"{logs}: {len(pairs)} copies of what {log} holds"
        said = sorted({told for source, first in pairs if (told := _said_otherwise(source, first))})
        yield f"{what}, {likeness}; taken once" + (f", with the labels of that log: {some_of(said, 3)}" if said else "")


def _said_otherwise(copy: Source, first: Source) -> str:
    return tags_said_otherwise(copy.demonstration.tags, first.demonstration.tags)


def tags_said_otherwise(said: Mapping[str, str], kept: Mapping[str, str]) -> str:
    """How the tags of a copy differ from those that are kept, in words; a cut's tag that names its log aside. Empty for no difference."""
    differing = [tag for tag in sorted({*said, *kept} - {LOG_TAG}) if said.get(tag) != kept.get(tag)]
    nothing = "nothing"
    return ", ".join(f"{tag} = {kept.get(tag, nothing)} (there {said.get(tag, nothing)})" for tag in differing)


def _named(source: Source) -> str:
    return str(source.log) if source.alone else f"{source.log}, {source.demonstration.name}"


def _likeness(source: Source) -> str:
    return "byte for byte" if source.alone else "row for row" if source.cut is None else "message for message"


def _holds(
    log: IndexedLog, natives: Sequence[LogEpisode], hashes: Mapping[str, str], known: KnownCut,
    remember: Callable[[str, Callable[[], Any]], Any],
) -> bool:  # fmt: skip
    """Whether a log holds just what an earlier cut was made of."""
    within = [native for native in natives if native.start_ns <= known.cut.start_ns < native.end_ns]
    return any(cut_sha256(log, known.cut, hashes[native.name], remember) == known.sha256 for native in within)
