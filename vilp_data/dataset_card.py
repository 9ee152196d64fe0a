"""The card of a dataset: one page of Markdown that says what is in it, and a contact sheet. The same dataset gives the same bytes."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vilp_data import shards
from vilp_data.alike_findings import alike_findings
from vilp_data.contact_sheet import captioned, grid, stacked, to_png
from vilp_data.dataset_split import find_split
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError, number_of
from vilp_data.keys import digest
from vilp_data.spec import ActionSpec, TaskSpec, VectorSpec
from vilp_data.split_lock import SplitLock
from vilp_data.stats import ChannelStats
from vilp_data.types import F32, U8
from vilp_data.vector_parts import names_that_differ, shared_names, vector_parts

SHEET_EPISODES, SHEET_TIMES = 6, 6
SHEET_WIDTH = 160
"""Wider frames are made smaller, narrower ones larger by a whole number."""

MOST_VALUES = 12
"""A tag of more different values is told by how many there are."""

MOST_SOURCES, MOST_FINDINGS = 40, 20
SHEET_SUFFIX = ".contact_sheet.png"

MARKER = "<!-- written by `vilp-data card`, which may replace it -->"
"""What makes a page a card: the only kind that is replaced without being told to."""

_IDENTIFIER = re.compile(r"[A-Za-z0-9.+-]+")
"""Licences in the short form that hubs know: CC-BY-4.0."""


@dataclass(frozen=True)
class Card:
    """The page, and the picture that it shows beside it: PNG bytes, or None where the dataset has no view."""

    markdown: str
    sheet: bytes | None


def write_card(
    store: EpisodeStore,
    path: Path,
    *,
    licence: str | None = None,
    only: Collection[str] | None = None,
    exported: Sequence[str] = (),
    force: bool = False,
) -> Path | None:
    """Write the card as `path`, the contact sheet beside it; returns the sheet's path, None where the dataset has no view.

    Raises UsageError where `path` is a page that somebody wrote, unless `force` is given, and as `make_card` does."""
    _require_free(path, force=force)
    sheet = path.with_name(path.stem + SHEET_SUFFIX)
    card = make_card(store, licence=licence, only=only, exported=exported, sheet_name=sheet.name)
    if card.sheet is not None:
        shards.write_atomic(sheet, card.sheet)
    shards.write_atomic(path, card.markdown.encode())
    return None if card.sheet is None else sheet


def _require_free(path: Path, *, force: bool) -> None:
    if path.is_dir():
        raise UsageError("a folder, not a file", where=path, remedy="name a Markdown file with -o, such as README.md")
    if path.is_file() and not force and MARKER.encode() not in path.read_bytes():
        remedy = "name another file with -o, or replace it with --force; what it says is nowhere else"
        raise UsageError("a page that is no card of this command", where=path, remedy=remedy)


def make_card(
    store: EpisodeStore,
    *,
    licence: str | None = None,
    only: Collection[str] | None = None,
    exported: Sequence[str] = (),
    sheet_name: str = "README" + SHEET_SUFFIX,
) -> Card:
    """The card of a dataset, or of the episodes `only`. `exported` are lines about the export that it lies in.

    Raises UsageError where there is no episode, StoreError for damaged ones."""
    spec = store.spec()
    entries = [entry for entry in store.index() if only is None or entry.id in only]
    if not entries:
        raise UsageError("no episodes, so nothing to tell", where=store.root, remedy="run `vilp-data ingest` first")
    lock = find_split(store.root)
    parts: list[Iterable[str]] = [
        _front_matter(licence),
        [f"# {spec.name}", "", _summary(entries)],
        [f"![frames of {number_of(min(len(entries), SHEET_EPISODES), 'episode')} over time]({sheet_name})"]
        if spec.views
        else [],
        _section("This export", [f"- {line}" for line in exported]) if exported else [],
        _section("Views", _views(store, spec, entries)),
        _section("Numbers", _vectors(store, spec, entries, lock)),
        _section("Split", _split(entries, lock)),
        _section("Outcomes and tags", _tags(entries)),
        _section("Masked steps and findings", _findings(entries)),
        _section("Sources", _sources(entries)),
        _section("Licence", [licence or "Not stated."]),
    ]
    text = "\n".join("\n".join(part) + "\n" for part in parts if part)
    return Card(text, to_png(contact_sheet(store, spec, entries)) if spec.views else None)


def contact_sheet(store: EpisodeStore, spec: TaskSpec, entries: Sequence[EpisodeEntry]) -> U8:
    """A block of rows for each view, at least one: episodes evenly chosen, each from its first frame to its last. uint8 [H,W,3]."""
    chosen = [entries[i] for i in _evenly(len(entries), SHEET_EPISODES)]
    columns = [f"{round(100 * share)} %" for share in np.linspace(0, 1, SHEET_TIMES)]
    blocks = []
    for view in spec.views:
        rows: dict[str, list[U8 | None]] = {}
        for number, entry in enumerate(chosen):
            frames = open_frames(store, entry, view)
            shown = [frames[i] for i in np.linspace(0, len(frames) - 1, SHEET_TIMES).round().astype(int)]
            rows[f"{_evenly(len(entries), SHEET_EPISODES)[number] + 1}"] = [_thumbnail(frame) for frame in shown]
        blocks.append(captioned(f"view {view}", grid(rows, columns, scale=_scale(rows))))
    names = [f"{number + 1}: {entries[number].id}" for number in _evenly(len(entries), SHEET_EPISODES)]
    width = max(block.shape[1] for block in blocks)
    legend = [captioned(name, np.zeros((0, width, 3), np.uint8)) for name in names]
    return stacked([*blocks, *legend])


def _thumbnail(frame: U8) -> U8:
    picture = np.repeat(frame, 3, axis=-1) if frame.shape[-1] == 1 else frame
    if picture.shape[1] <= SHEET_WIDTH:
        return picture
    height = max(round(picture.shape[0] * SHEET_WIDTH / picture.shape[1]), 1)
    return np.asarray(cv2.resize(picture, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)


def _scale(rows: Mapping[str, Sequence[U8 | None]]) -> int:
    width: int = next(frame.shape[1] for row in rows.values() for frame in row if frame is not None)
    return max(SHEET_WIDTH // width, 1)


def _evenly(count: int, most: int) -> list[int]:
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, most)).tolist()})


# --- sections -----------------------------------------------------------------------------------------------------------


def _front_matter(licence: str | None) -> list[str]:
    """What dataset hubs read: YAML between two lines of dashes."""
    named = (
        []
        if licence is None
        else [f"license: {licence.lower()}"]
        if _IDENTIFIER.fullmatch(licence)
        else ["license: other"]
    )
    return ["---", *named, "task_categories:", "- robotics", "---", MARKER]


def _section(title: str, lines: Iterable[str]) -> list[str]:
    return [f"## {title}", "", *lines]


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    cells = [[cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows]
    return [f"| {' | '.join(row)} |" for row in [list(head), ["---"] * len(head), *cells]]


def _code(text: str) -> str:
    """A name that came from a log, which is to stay text whatever it holds."""
    return f"`{text.replace('`', chr(39))}`"


def _summary(entries: Sequence[EpisodeEntry]) -> str:
    seconds = sorted(entry.n_steps / entry.rate_hz for entry in entries)
    steps, labelled = sum(entry.n_steps for entry in entries), sum(entry.has_action for entry in entries)
    rates = sorted({round(entry.rate_hz, 4) for entry in entries})
    rate = f"{rates[0]:g} Hz" if len(rates) == 1 else f"{rates[0]:g} to {rates[-1]:g} Hz"
    middle = seconds[len(seconds) // 2]
    return (
        f"{number_of(len(entries), 'episode')}, {number_of(steps, 'step')} at {rate}: {_duration(sum(seconds))} in all,"
        f" from {seconds[0]:.1f} s to {seconds[-1]:.1f} s each, the middle one {middle:.1f} s. {labelled} have actions,"
        f" {sum(entry.has_state for entry in entries)} the simulator's state."
    )


def _duration(seconds: float) -> str:
    hours, rest = divmod(round(seconds), 3600)
    minutes, left = divmod(rest, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {left:02d} s"


def _views(store: EpisodeStore, spec: TaskSpec, entries: Sequence[EpisodeEntry]) -> list[str]:
    if not spec.views:
        return ["None: numbers alone."]
    rows = []
    for view, table in spec.views.items():
        height, width, channels = open_frames(store, entries[0], view).shape[1:]
        meaning = "RGB" if channels == 3 else _depth_words(table)
        images = sum(entry.n_frames[view] for entry in entries)
        steps = sum(entry.n_steps for entry in entries)
        rows.append(
            [_code(view), f"{width} x {height}", meaning, str(images), f"{images / steps:.2f}", _code(table.topic)]
        )
    return _table(["view", "width x height", "pixels, uint8", "stored images", "images a step", "topic"], rows)


def _depth_words(table: object) -> str:
    depth = getattr(table, "depth", None)
    if depth is None:
        return "one channel"
    return f"depth: 0 no reading, 1 to 255 linear from {depth.near_m:g} m to {depth.far_m:g} m"


def _vectors(
    store: EpisodeStore, spec: TaskSpec, entries: Sequence[EpisodeEntry], lock: SplitLock | None
) -> Iterator[str]:
    """A row for each number of low_dim and action: unit and frame, and its statistics over valid training steps."""
    training = [entry for entry in entries if lock is None or lock.assignment.get(entry.id) == "train"]
    whose = "training episode" if lock is not None and training else "episode"
    rows, untold = [], []
    tables: list[tuple[str, Mapping[str, ActionSpec | VectorSpec]]] = [
        ("low_dim", spec.low_dim),
        ("action", spec.action),
    ]
    for name, parts in tables:
        stats = _stats(store, training or list(entries), name)
        if stats is None:
            continue
        names = shared_names((entry.column_names for entry in entries), name)
        columns = vector_parts(np.arange(len(stats.mean), dtype=np.float32)[None], parts, names)
        for part, (labels, numbers) in columns.items():
            for label, number in zip(labels, numbers[0].astype(int).tolist(), strict=True):
                values = [f"{array[number]:.6g}" for array in (stats.mean, stats.std, stats.min, stats.max)]
                rows.append(
                    [f"`{name}[{number}]`", _code(f"{part}.{label}".strip(".")), _meaning(parts.get(part)), *values]
                )
        if list(columns) == [""] and len(parts) > 1:
            untold.append(f"The task does not say how wide each part of {name} is; in order: {', '.join(parts)}.")
    differing = names_that_differ(entry.column_names for entry in entries)
    untold += [f"{sentence[0].upper()}{sentence[1:]}." for sentence in differing]
    if not rows:
        yield "Images alone."
        return
    yield from _table(["column", "part", "meaning", "mean", "deviation", "least", "greatest"], rows)
    yield ""
    yield from untold
    yield f"Statistics over the valid steps of {number_of(len(training or entries), whose)}."


def _meaning(part: ActionSpec | VectorSpec | None) -> str:
    if not isinstance(part, ActionSpec):
        return _code(str(part.topic)) if part is not None else ""
    unit = f", {part.unit}" if part.unit else ", unit not stated"
    frame = f", frame {part.frame}" if part.frame else ""
    return f"{part.kind.replace('_', ' ')}{unit}{frame}"


def _stats(store: EpisodeStore, entries: Sequence[EpisodeEntry], name: str) -> ChannelStats | None:
    def arrays() -> Iterator[F32]:
        for entry in entries:
            steps = open_steps(store, entry)
            if name in steps:
                yield steps[name][steps["valid"]]

    total: ChannelStats | None = None
    for array in arrays():
        if array.size:
            stats = ChannelStats.of(array)
            total = stats if total is None else total.merged(stats)
    return total


def _split(entries: Sequence[EpisodeEntry], lock: SplitLock | None) -> list[str]:
    if lock is None:
        return ["None drawn."]
    rows = []
    for side, word in (("train", "training"), ("val", "validation"), (None, "neither side")):
        mine = [entry for entry in entries if lock.assignment.get(entry.id) == side]
        if mine:
            seconds = sum(entry.n_steps / entry.rate_hz for entry in mine)
            rows.append([word, str(len(mine)), str(sum(entry.n_steps for entry in mine)), _duration(seconds)])
    by = f", grouped by {lock.group_by}" if lock.group_by else ""
    told = f"By episode{by}, ratio {lock.ratio:g}, seed {lock.seed}; SHA-256 of the assignment `{lock.hash}`."
    return [*_table(["side", "episodes", "steps", "time"], rows), "", told]


def _tags(entries: Sequence[EpisodeEntry]) -> list[str]:
    rows = [["(outcome)", _counted(Counter(entry.outcome for entry in entries))]]
    for name in sorted({name for entry in entries for name in entry.tags}):
        counts = Counter(entry.tags[name] for entry in entries if name in entry.tags)
        missing = len(entries) - counts.total()
        rows.append([_code(name), _counted(counts) + (f"; {missing} without" if missing else "")])
    edited = {what: sum(what in entry.edits for entry in entries) for what in ("labels", "trim")}
    words = {"labels": "relabelled", "trim": "trimmed"}
    told = [f"{number_of(count, 'episode')} {words[what]}" for what, count in edited.items() if count]
    return [
        *_table(["tag", "values (episodes)"], rows),
        *(["", f"Since the ingest: {', '.join(told)}."] if told else []),
    ]


def _counted(counts: Counter[str]) -> str:
    if len(counts) > MOST_VALUES:
        values = sorted(counts)
        return f"{len(counts)} different, such as {_code(values[0])}, {_code(values[1])}"
    return ", ".join(f"{_code(value)} ({count})" for value, count in sorted(counts.items()))


def _findings(entries: Sequence[EpisodeEntry]) -> Iterator[str]:
    masked = {entry.id: entry.n_steps - entry.n_valid for entry in entries if entry.n_valid < entry.n_steps}
    yield (
        f"Masked: {number_of(sum(masked.values()), 'step')} of {number_of(len(masked), 'episode')}."
        " No observation or action there may be used."
        if masked
        else "No step is masked."
    )
    alike = alike_findings((entry.id, finding) for entry in entries for finding in entry.findings)
    if alike:
        yield ""
    for one in alike[:MOST_FINDINGS]:
        others = f" (and the like in {len(one.episodes) - 1} more)" if len(one.episodes) > 1 else ""
        yield f"- {_code(one.episodes[0])}: {one.sentence}{others}"
    if len(alike) > MOST_FINDINGS:
        yield f"- and {len(alike) - MOST_FINDINGS} other kinds"


def _sources(entries: Sequence[EpisodeEntry]) -> Iterator[str]:
    logs: dict[str, list[EpisodeEntry]] = {}
    for entry in entries:
        logs.setdefault(entry.source, []).append(entry)
    rows = []
    for source in sorted(logs)[:MOST_SOURCES]:
        hashes = sorted({entry.source_sha256 for entry in logs[source]})
        told = (
            f"`{hashes[0]}`" if len(hashes) == 1 else f"`{digest(hashes)}`, over those of {len(hashes)} demonstrations"
        )
        rows.append([_code(source), str(len(logs[source])), told])
    yield from _table(["log", "episodes", "SHA-256"], rows)
    yield ""
    if len(logs) > MOST_SOURCES:
        yield f"And {len(logs) - MOST_SOURCES} logs more."
    contents = {entry.id: entry.content_sha256 for entry in entries}
    yield f"SHA-256 over the contents of {number_of(len(entries), 'episode')}: `{digest(contents)}`."
