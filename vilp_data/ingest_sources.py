"""The demonstrations in the logs of one ingest, each known by its bytes; and which known ones today's logs still hold, unchanged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from vilp_data.cut_identity import Cut, cut_sha256
from vilp_data.cut_log import cut_log
from vilp_data.errors import DecodeError, LogError, SpecError
from vilp_data.log_hashes import HashCache
from vilp_data.sources import IndexedLog, open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import LogEpisode


@dataclass(frozen=True)
class Source:
    """One demonstration of one log, before it is known which episode it is. `alone`: its log holds no other. `cut`: where it was cut out
    of its log, None for a log's own."""

    log: Path
    demonstration: LogEpisode
    sha256: str
    alone: bool
    cut: Cut | None = None

    @property
    def place(self) -> dict[str, Any]:
        """What `EpisodeEntry.cut` says of it."""
        return self.cut.to_json() if self.cut is not None else {}


@dataclass(frozen=True)
class KnownCut:
    """An episode that was cut out of a log called `log`, stored or removed."""

    id: str
    log: str
    sha256: str
    cut: Cut


@dataclass
class Sources:
    """`found` in order of logs, those with the same bytes once. `held`: log -> the known cuts that it holds though its demonstrations are
    others now: those that it holds unchanged; and the others too where these are at least half of what is known by its name, so that
    it is the same log, edited. Logs that cannot be read (name, why); sentences about the rest."""

    found: list[Source] = field(default_factory=list)
    held: dict[Path, list[KnownCut]] = field(default_factory=dict)
    failed: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_sources(logs: Sequence[Path], spec: TaskSpec, cache: HashCache, known: Sequence[KnownCut] = ()) -> Sources:
    """Every demonstration of the logs. Reads them as far as the cache does not know them."""
    sources, by_hash = Sources(), dict[str, Source]()
    for path in logs:
        try:
            with open_log(path, array_rate_hz=spec.rate_hz or 10.0) as log:
                found, held, notes = _read_log(log, path, spec, cache, [one for one in known if one.log == path.name])
        except (LogError, DecodeError, SpecError) as error:
            sources.failed.append((path.name, str(error)))
            continue
        sources.held[path] = held
        sources.notes += notes
        for source in found:
            first = by_hash.setdefault(source.sha256, source)
            if first is source:
                sources.found.append(source)
            else:
                copied = "" if first.alone else f", {first.demonstration.name}"
                sources.notes.append(f"{path}: a copy of {first.log}{copied}, byte for byte; taken once")
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
        return [Source(path, one, hashes[one.name], alone) for one in demonstrations], [], notes
    topics = tuple(sorted({topic.name for topic in log.topics()}.intersection(spec.topics())))
    found = []
    for one in demonstrations:
        cut = Cut(one.start_ns, one.end_ns, topics)
        sha256 = cut_sha256(log, cut, hashes[cuts.native[one.name]], remember)
        found.append(Source(path, one, sha256, alone=False, cut=cut))
    today = {source.sha256 for source in found}
    others = [one for one in known if one.sha256 not in today]
    held = [one for one in others if _holds(log, natives, hashes, one, remember)]
    unchanged = len(known) - len(others) + len(held)
    return found, others if 0 < len(known) <= 2 * unchanged else held, notes


def _holds(
    log: IndexedLog, natives: Sequence[LogEpisode], hashes: Mapping[str, str], known: KnownCut,
    remember: Callable[[str, Callable[[], Any]], Any],
) -> bool:  # fmt: skip
    """Whether a log holds just what an earlier cut was made of."""
    within = [native for native in natives if native.start_ns <= known.cut.start_ns < native.end_ns]
    return any(cut_sha256(log, known.cut, hashes[native.name], remember) == known.sha256 for native in within)
