"""What a page says of a dataset, gathered: every episode's side, action sets, findings and reconstruction, and what it is sought by."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vilp_data.action_set_lock import ActionSetLock
from vilp_data.check.findings import SEVERITIES, Finding
from vilp_data.check.sources import check_sources
from vilp_data.dataset_action_sets import find_action_set, set_names, wrong_with
from vilp_data.dataset_split import find_split
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import SplitError, VilpDataError
from vilp_data.measured_fidelity import MeasuredFidelity, measured_runs, read_fidelity
from vilp_data.spec import TaskSpec
from vilp_data.split_lock import SplitLock

MOST_VALUES = 24
"""A tag that groups episodes has no more values than this, and no fewer than two episodes a value on average. What the others say is found
by the text search, and told by the open card."""

EDITS = {"labels": "relabelled", "trim": "trimmed"}
SIDES = {"train": "training", "val": "validation", None: "neither side"}


@dataclass(frozen=True)
class NamedSet:
    """An action set as it is stored. `lock` None: it cannot be read; `wrong`: why, or what does not hold any more, and `remedy` what to
    do about it."""

    name: str
    lock: ActionSetLock | None
    wrong: str | None = None
    remedy: str | None = None

    def source_of(self, id: str) -> str | None:
        """The source that the episode gives its actions to; None where it gives none."""
        return next((s.name for s in self.lock.sources if id in s.episodes), None) if self.lock else None


@dataclass(frozen=True)
class Choice:
    """One thing that episodes can be sought by: a label, and for each value in words the episodes that have it."""

    label: str
    values: Mapping[str, frozenset[str]]


@dataclass(frozen=True)
class DatasetFacts:
    """A dataset as a page shows it. `findings`: episode id -> its own; under None those of the dataset as a whole."""

    store: EpisodeStore
    spec: TaskSpec
    entries: Sequence[EpisodeEntry]
    split: SplitLock | None
    sets: Sequence[NamedSet]
    findings: Mapping[str | None, Sequence[Finding]]
    fidelity: MeasuredFidelity | None
    other_runs: Sequence[Path] = field(default=())

    @property
    def all_findings(self) -> list[Finding]:
        return [finding for found in self.findings.values() for finding in found]

    def side(self, id: str) -> str:
        """`training`, `validation`, `neither side`."""
        return SIDES[self.split.assignment.get(id) if self.split else None]

    def seconds(self, entry: EpisodeEntry) -> float:
        return entry.n_steps / entry.rate_hz

    def least_psnr_db(self, id: str) -> float | None:
        """Of the view that reconstructs worst; None where nothing was measured."""
        views = self.fidelity.episodes.get(id, {}) if self.fidelity else {}
        return min((one.psnr_db for one in views.values()), default=None)

    def varying_tags(self) -> dict[str, Counter[str]]:
        """Tags that tell episodes apart, with how many have each value: more than one value, or some without."""
        tags: dict[str, Counter[str]] = {}
        for entry in self.entries:
            for name, value in entry.tags.items():
                tags.setdefault(name, Counter())[value] += 1
        n = len(self.entries)
        return {name: tags[name] for name in sorted(tags) if len(tags[name]) > 1 or tags[name].total() < n}

    def grouping_tags(self) -> dict[str, Counter[str]]:
        """Those of the varying tags that group episodes, as goals and operators do, and seeds do not; of tags that make the same groups
        one alone: rather one that all have, rather one with short values."""
        n = len(self.entries)
        tags = {
            name: of for name, of in self.varying_tags().items() if len(of) <= MOST_VALUES and 2 * len(of) <= max(n, 4)
        }
        told: dict[frozenset[frozenset[str]], str] = {}
        for name in sorted(tags, key=lambda name: (tags[name].total() < n, max(map(len, tags[name])))):
            told.setdefault(self._groups(name), name)
        return {name: tags[name] for name in tags if name in told.values()}

    def _groups(self, tag: str) -> frozenset[frozenset[str]]:
        groups: dict[str | None, set[str]] = {}
        for entry in self.entries:
            groups.setdefault(entry.tags.get(tag), set()).add(entry.id)
        return frozenset(map(frozenset, groups.values()))

    def choices(self) -> Iterator[Choice]:
        """Everything to filter by that leaves something to choose."""
        yield from (choice for choice in self._all_choices() if len(choice.values) > 1)

    def _all_choices(self) -> Iterator[Choice]:
        if self.split is not None:
            yield _choice("split", ((self.side(e.id), e.id) for e in self.entries))
        outcome = _choice("outcome", ((e.outcome, e.id) for e in self.entries))
        yield outcome
        told = {frozenset(outcome.values.values())}
        for name in self.grouping_tags():
            tag = _choice(name, ((e.tags.get(name, "(without)"), e.id) for e in self.entries))
            if (ways := frozenset(tag.values.values())) not in told:  # "success=true" says what the outcome does
                told.add(ways)
                yield tag
        for one in self.sets:
            if one.lock is not None:
                yield _choice(f"set {one.name}", ((one.source_of(e.id) or "no labels", e.id) for e in self.entries))
        yield _choice("findings", self._by_finding())
        changed = [(EDITS[what], e.id) for e in self.entries for what in EDITS if what in e.edits]
        yield _choice("edits", [*changed, *(("none", e.id) for e in self.entries if not EDITS.keys() & e.edits.keys())])

    def _by_finding(self) -> Iterator[tuple[str, str]]:
        told = {id: found for id, found in self.findings.items() if id is not None and found}
        for severity in SEVERITIES:
            yield from (
                (f"any {severity}", id) for id, found in told.items() if any(f.severity == severity for f in found)
            )
        for kind in sorted({f.kind for found in told.values() for f in found}):
            yield from (
                (kind.replace("-", " "), id) for id, found in told.items() if any(f.kind == kind for f in found)
            )
        if told:
            yield from (("none", e.id) for e in self.entries if e.id not in told)


def dataset_facts(root: Path, *, run: Path | None = None) -> DatasetFacts:
    """Look at the dataset at `root`, its findings as `vilp-data check` has them: every stored byte is read once.

    `run` names whose fidelity report to show; None: the one written last. Raises UsageError where `root` is no dataset, StoreError where
    its spec or index cannot be read; damaged episodes, splits and action sets are findings, or words beside them."""
    store = EpisodeStore(root)
    spec, entries = store.spec(), store.index()
    findings: dict[str | None, list[Finding]] = {}
    ids = {entry.id for entry in entries}
    for finding in check_sources([root]).findings:
        episode = finding.place.episode
        findings.setdefault(episode if episode in ids else None, []).append(finding)
    try:
        split = find_split(root)
    except SplitError:  # the check told
        split = None
    runs = [run] if run is not None else measured_runs(root)
    fidelity = read_fidelity(runs[0], {entry.id: entry for entry in entries}) if runs else None
    return DatasetFacts(store, spec, entries, split, list(_sets(root, split, entries)), findings, fidelity, runs[1:])


def _sets(root: Path, split: SplitLock | None, entries: Sequence[EpisodeEntry]) -> Iterator[NamedSet]:
    for name in set_names(root):
        try:
            lock = find_action_set(root, name)
        except VilpDataError as error:
            yield NamedSet(name, None, error.what)
            continue
        if split is None:
            yield NamedSet(name, lock, "the split it was chosen in cannot be read")
            continue
        wrong = next(wrong_with(root, name, lock, split, entries), None)
        yield NamedSet(name, lock, wrong.what, wrong.remedy) if wrong else NamedSet(name, lock)


def _choice(label: str, told: Iterable[tuple[str, str]]) -> Choice:
    values: dict[str, set[str]] = {}
    for value, id in told:
        values.setdefault(value, set()).add(id)
    return Choice(label, {value: frozenset(ids) for value, ids in values.items()})
