"""A dataset as one page of HTML: every episode a card with frames, facts and findings, to be filtered, sorted and opened. It needs nothing
from elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path
from statistics import fmean

from vilp_data import shards
from vilp_data.check.findings import SEVERITIES, counts, grouped, verdict
from vilp_data.check.page import article, tally, with_code
from vilp_data.check.style import STYLE as PAGE_STYLE
from vilp_data.check.text import duration
from vilp_data.errors import number_of
from vilp_data.film_strips import PAGE_BYTES, StripForm, fitting_strip
from vilp_data.spec import ActionSpec, VectorSpec
from vilp_data.viewer.dataset_facts import Choice, DatasetFacts, NamedSet
from vilp_data.viewer.dataset_style import SCRIPT, STYLE
from vilp_data.viewer.episode_card import card

Progress = Callable[[int, int], None]
"""Told (episodes drawn, episodes in all)."""


def write_dataset_page(
    path: Path, facts: DatasetFacts, *, page_bytes: int = PAGE_BYTES, progress: Progress | None = None
) -> StripForm:
    """Write the page, whole or not at all, one episode after another: memory does not grow with the pictures. Returns their form.

    `page_bytes` is what all pictures together may take; many episodes have fewer and smaller ones. An episode whose frames cannot be read
    has none. Raises StoreError where the page's folder cannot be written."""
    form = fitting_strip(facts.store, facts.entries, page_bytes=page_bytes) if facts.entries else StripForm(0, 0, 0)
    with shards.atomic_file(path) as file:
        for text in _page(facts, form, progress):
            file.write(text.encode("utf-8", "replace"))  # a file name may hold bytes that are no text
    return form


def _page(facts: DatasetFacts, form: StripForm, progress: Progress | None) -> Iterator[str]:
    title, choices = facts.store.root.resolve().name or facts.spec.name, list(facts.choices())
    numbers = {(choice.label, value): n for n, (choice, value) in enumerate((c, v) for c in choices for v in c.values)}
    yield (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}: {number_of(len(facts.entries), 'episode')}</title><style>{PAGE_STYLE}{STYLE}</style></head><body><main>"
        f"<header><h1>{escape(title)}</h1>{_lead(facts)}{_tally(facts)}{_about(facts)}</header>{_findings(facts)}"
        f'<section><h2>Episodes</h2>{_filters(choices, numbers, facts)}<div class="episodes">'
    )
    grouping, longest_s = set(facts.grouping_tags()), max(map(facts.seconds, facts.entries), default=1.0)
    for done, entry in enumerate(facts.entries, 1):
        has = [
            numbers[choice.label, value]
            for choice in choices
            for value, ids in choice.values.items()
            if entry.id in ids
        ]
        yield card(facts, entry, form, has=has, grouping=grouping, longest_s=longest_s)
        if progress is not None:
            progress(done, len(facts.entries))
    empty = "the dataset holds no episode" if not facts.entries else "no episode fits all of this"
    yield (
        f'</div><p class="nothing soft{"" if facts.entries else " shown"}">{empty}</p></section>'
        "<footer>Written by <code>vilp-data view --html</code>, with the findings of <code>vilp-data check</code>. Pictures are small"
        " copies, evenly along the steps that may be used; a card opens. The bar under them is the length, beside the longest.</footer>"
        f"</main><script>{SCRIPT}</script></body></html>\n"
    )


# --- the head -----------------------------------------------------------------------------------------------------------


def _lead(facts: DatasetFacts) -> str:
    n_steps, n_valid = (sum(getattr(e, what) for e in facts.entries) for what in ("n_steps", "n_valid"))
    masked = f", {n_steps - n_valid:,} of them masked" if n_valid < n_steps else ""
    rates = ", ".join(f"{rate:g}" for rate in sorted({round(e.rate_hz, 3) for e in facts.entries}))
    told = f"Task {facts.spec.name}: {n_steps:,} steps{f' at {rates} Hz' if rates else ''}{masked}"
    seconds = sorted(map(facts.seconds, facts.entries))
    if seconds:
        told += (
            f"; episodes of {seconds[0]:.1f} to {seconds[-1]:.1f} s, the middle one {seconds[len(seconds) // 2]:.1f} s"
        )
    return f'<p class="soft">{escape(told)}.</p>'


def _tally(facts: DatasetFacts) -> str:
    entries = facts.entries
    cells = [(f"{len(entries)}", f"episode{'' if len(entries) == 1 else 's'}")]
    cells += [(duration(sum(map(facts.seconds, entries))), "in all")] if entries else []
    if facts.split is not None:
        sides = Counter(facts.side(entry.id) for entry in entries)
        cells += [(str(sides[side]), side) for side in ("training", "validation", "neither side") if sides[side]]
    outcomes = Counter(entry.outcome for entry in entries)
    if set(outcomes) - {"unknown"}:
        cells += [
            (str(n), {"unknown": "outcome unknown"}.get(outcome, outcome)) for outcome, n in outcomes.most_common()
        ]
    psnr_db = [db for entry in entries if (db := facts.least_psnr_db(entry.id)) is not None]
    if psnr_db:
        cells.append((f"{fmean(psnr_db):.1f}", "dB PSNR, reconstructed"))
    told = "".join(f'<li class="small"><b>{escape(value)}</b>{escape(what)}</li>' for value, what in cells)
    return f'<ul class="tally">{told}</ul>'


def _about(facts: DatasetFacts) -> str:
    rows = [*_views(facts), *_vectors(facts), ("split", _split(facts)), *(_set(one) for one in facts.sets)]
    rows += [*_tags(facts), *_reconstruction(facts)]
    told = "".join(f"<dt>{escape(name)}</dt><dd>{told}</dd>" for name, told in rows)
    return f'<details class="holds" open><summary>What it holds</summary><dl class="about">{told}</dl></details>'


def _views(facts: DatasetFacts) -> Iterator[tuple[str, str]]:
    for view, table in facts.spec.views.items():
        images = sum(entry.n_frames.get(view, 0) for entry in facts.entries)
        told = f"{table.width} x {table.height}, {images:,} images, from <code>{escape(table.topic)}</code>"
        yield f"view {view}", told


def _vectors(facts: DatasetFacts) -> Iterator[tuple[str, str]]:
    labelled = sum(entry.has_action for entry in facts.entries)
    for name, parts in (("low_dim", facts.spec.low_dim), ("action", facts.spec.action)):
        if parts:
            told = ", ".join(f"{escape(part)} {_from(table)}" for part, table in parts.items())
            missing = len(facts.entries) - labelled if name == "action" else 0
            yield name, told + (f"; {number_of(missing, 'episode')} without" if missing else "")


def _from(part: VectorSpec | ActionSpec) -> str:
    """The topic a part is read from; of an action that the log did not record, the state that it is taken from."""
    read = part.topic if part.topic is not None else getattr(part, "from_", None)
    return f"<code>{escape(str(read))}</code>" + (" (some steps later)" if part.topic is None else "")


def _split(facts: DatasetFacts) -> str:
    lock = facts.split
    if lock is None:
        return "none drawn, or it cannot be read"
    by = f", grouped by {escape(lock.group_by)}" if lock.group_by else ""
    changed = "" if lock.is_intact else ' <span class="wrong">changed by hand</span>'
    return f"ratio {lock.ratio:g}, seed {lock.seed}{by}; <code>{escape(lock.hash[:12])}</code>{changed}"


def _set(one: NamedSet) -> tuple[str, str]:
    remedy = f" {with_code(one.remedy)}" if one.remedy else ""
    wrong = f'<span class="wrong">{escape(one.wrong)}</span>{remedy}' if one.wrong else ""
    if one.lock is None:
        return f"set {one.name}", wrong
    sources = ", ".join(
        f"{escape(source.name)} {len(source.episodes)} (weight {source.weight}, effective epochs {source.effective_epochs:.2g})"
        for source in one.lock.sources
    )
    told = f"actions of {number_of(len(one.lock.episodes), 'episode')}: {sources}; {len(one.lock.video_only)} of video only"
    return f"set {one.name}", f"{told}. {wrong}" if wrong else told


def _tags(facts: DatasetFacts) -> Iterator[tuple[str, str]]:
    varying = facts.varying_tags()
    same = {name: value for entry in facts.entries for name, value in entry.tags.items() if name not in varying}
    if same:
        yield (
            "tags of all",
            ", ".join(f"{escape(name)} <code>{escape(value)}</code>" for name, value in sorted(same.items())),
        )


def _reconstruction(facts: DatasetFacts) -> Iterator[tuple[str, str]]:
    measured = facts.fidelity
    if measured is None:
        return
    told = f"run <code>{escape(measured.run.name)}</code>: "
    if not measured.episodes:
        yield "reconstruction", told + "nothing measured of these episodes (<code>vilp-models evaluate vqgan</code>)"
        return
    each = (
        f"{escape(view)} {fmean(views[view].psnr_db for views in measured.episodes.values() if view in views):.1f} dB"
        for view in measured.views
    )
    told += f"{', '.join(each)}, measured on {number_of(len(measured.episodes), 'episode')}"
    if facts.other_runs:
        told += (
            f"; also measured, and shown with <code>--run</code>: {escape(', '.join(r.name for r in facts.other_runs))}"
        )
    outdated = ' <span class="wrong">The run was trained on since.</span>' if measured.outdated else ""
    yield "reconstruction", f"{told}.{outdated}"


def _findings(facts: DatasetFacts) -> str:
    found = facts.all_findings
    if not found:
        whole = facts.split is None or facts.split.is_intact
        return tally([]) if whole and not any(one.wrong for one in facts.sets) else ""
    articles = "".join(article(group, with_source=False) for group in grouped(found))
    worst = next(severity for severity in SEVERITIES if counts(found)[severity])
    told = f'Findings: <span class="badge {worst}">{verdict(found)}</span>'
    return f'<details class="findings"><summary>{told}</summary>{tally(found)}{articles}</details>'


# --- filters ------------------------------------------------------------------------------------------------------------


def _filters(choices: list[Choice], numbers: dict[tuple[str, str], int], facts: DatasetFacts) -> str:
    sorts = [("as stored", "order 1"), ("longest first", "seconds -1"), ("shortest first", "seconds 1")]
    sorts += [("most findings", "findings -1")] if facts.all_findings else []
    if facts.fidelity is not None and facts.fidelity.episodes:
        sorts += [("worst PSNR first", "psnr 1"), ("best PSNR first", "psnr -1")]
    listed = "".join(f'<option value="{value}">{name}</option>' for name, value in sorts)
    return (
        '<form class="filters"><label class="find"><span>find</span>'
        '<input type="search" placeholder="name, tag, finding" aria-label="find"></label>'
        f"{''.join(_select(choice, numbers) for choice in choices)}"
        f'<label class="sort"><span>order</span><select aria-label="order">{listed}</select></label>'
        '<button class="more" type="button" aria-expanded="false">Filters</button>'
        '<button class="reset" type="reset">Reset</button><output aria-live="polite"></output></form>'
    )


def _select(choice: Choice, numbers: dict[tuple[str, str], int]) -> str:
    options = "".join(
        f'<option value="{numbers[choice.label, value]}">{escape(value)} ({len(ids)})</option>'
        for value, ids in choice.values.items()
    )
    return f'<label class="choice"><span>{escape(choice.label)}</span><select><option value="">all</option>{options}</select></label>'
