"""One episode on the page of a dataset: a card with a film strip and what is known of it, which opens."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator, Sequence
from html import escape

from vilp_data.check.findings import SEVERITIES, Finding, counts
from vilp_data.check.page import with_code
from vilp_data.check.text import where
from vilp_data.episodes import EpisodeEntry
from vilp_data.errors import VilpDataError
from vilp_data.film_strips import StripForm, StripFrame, film_strip
from vilp_data.measured_fidelity import Fidelity
from vilp_data.viewer.dataset_facts import DatasetFacts

HOVERED = 6
"""Findings told under the pointer; the open card has all."""


def card(
    facts: DatasetFacts,
    entry: EpisodeEntry,
    form: StripForm,
    *,
    has: Sequence[int],
    grouping: Collection[str],
    longest_s: float,
) -> str:
    """The card. `has` numbers the choices that find it, `grouping` are the tags that it shows closed, `longest_s` is what its length is
    drawn against."""
    findings = facts.findings.get(entry.id, ())
    seconds, psnr_db = facts.seconds(entry), facts.least_psnr_db(entry.id)
    sought = "" if psnr_db is None else f' data-psnr="{psnr_db:.4f}"'
    return (
        f'<details class="episode" data-has="{" ".join(map(str, has))}" data-seconds="{seconds:.3f}"{sought}'
        f' data-findings="{_weight(findings)}" data-text="{escape(_text(entry, findings))}">'
        f'<summary>{"".join(_films(facts, entry, form))}<span class="span"><i style="width:{100 * seconds / longest_s:.1f}%"></i></span>'
        f'<span class="id mono">{escape(entry.id)}</span>{_numbers(facts, entry)}{_chips(facts, entry, findings, grouping)}</summary>'
        f'<div class="inside"><div>{_known(facts, entry)}</div><div>{_said(findings)}{_commands(facts, entry)}</div></div></details>\n'
    )


def _weight(findings: Sequence[Finding]) -> int:
    """For an order by findings: one error before any number of warnings."""
    numbers = counts(findings)
    return int(numbers["error"] * 1_000_000 + numbers["warning"] * 1_000 + numbers["note"])


def _text(entry: EpisodeEntry, findings: Sequence[Finding]) -> str:
    """What the text search looks through, in small letters."""
    tags = (f"{name}={value}" for name, value in entry.tags.items())
    parts = [
        entry.id,
        entry.source,
        entry.source_episode,
        entry.outcome,
        *tags,
        *(f"{f.severity} {f.kind} {f.what}" for f in findings),
    ]
    return "\n".join(parts).lower()


# --- closed -------------------------------------------------------------------------------------------------------------


def _films(facts: DatasetFacts, entry: EpisodeEntry, form: StripForm) -> Iterator[str]:
    views = [view for view in facts.spec.views if view in entry.frames_sha256]
    if not views:
        yield '<span class="none-to-show">no images</span>'
    for view in views:
        try:
            frames = list(film_strip(facts.store, entry, view, form))
        except VilpDataError as error:
            yield f'<span class="none-to-show">view {escape(view)}: {escape(error.what)}</span>'
            continue
        keys = {0, len(frames) // 2, len(frames) - 1}
        shown = "".join(_frame(frame, f"{entry.id}, {view}", key=i in keys) for i, frame in enumerate(frames))
        told = shown or '<span class="none-to-show frame key">every step is masked</span>'
        yield f'<span class="film"><span class="view">{escape(view)}</span>{told}</span>'


def _frame(frame: StripFrame, of: str, *, key: bool) -> str:
    return (
        f'<span class="frame{" key" if key else ""}"><img alt="{escape(of)} at {frame.at_s:.1f} s" loading="lazy" decoding="async"'
        f' width="{frame.width}" height="{frame.height}" src="{frame.uri}"><small>{frame.at_s:.1f} s</small></span>'
    )


def _numbers(facts: DatasetFacts, entry: EpisodeEntry) -> str:
    told = [f"<b>{facts.seconds(entry):.1f}</b> s", f"<b>{entry.n_steps}</b> steps"]
    if entry.n_valid < entry.n_steps:
        told.append(f"<b>{entry.n_steps - entry.n_valid}</b> masked")
    psnr_db = facts.least_psnr_db(entry.id)
    if psnr_db is not None:
        told.append(f'<span title="reconstructed, of the view that does worst"><b>{psnr_db:.1f}</b> dB</span>')
    return f'<span class="numbers">{"".join(f"<span>{one}</span>" for one in told)}</span>'


def _chips(facts: DatasetFacts, entry: EpisodeEntry, findings: Sequence[Finding], grouping: Collection[str]) -> str:
    side = facts.side(entry.id)
    chips = [(side.split()[0], side, "")] if facts.split is not None else []
    chips += [(entry.outcome, entry.outcome, "")] if entry.outcome != "unknown" else []
    for one in facts.sets:
        if source := one.source_of(entry.id):
            chips.append(("set", f"{one.name}: {source}", "gives its actions to this set"))
    chips += [
        ("", f"{name} {value}", "")
        for name, value in sorted(entry.tags.items())
        if name in grouping and name != "success"
    ]
    chips += [("", "trimmed", "")] if entry.is_trimmed else []
    chips += [] if entry.has_action else [("", "no actions", "")]
    numbers = counts(findings)
    for severity in SEVERITIES:
        if numbers[severity]:
            words = [f.what for f in findings if f.severity == severity]
            rest = [f"and {len(words) - HOVERED} more"] if len(words) > HOVERED else []
            count = f"{numbers[severity]} {severity}{'' if numbers[severity] == 1 else 's'}"
            chips.append((severity, count, "\n".join([*words[:HOVERED], *rest])))
    told = "".join(
        f'<span class="chip {kind}" title="{escape(title)}">{escape(text)}</span>' for kind, text, title in chips
    )
    return f'<span class="chips">{told}</span>' if told else ""


# --- open ---------------------------------------------------------------------------------------------------------------


def _known(facts: DatasetFacts, entry: EpisodeEntry) -> str:
    rows = [("log", entry.source), ("demonstration", entry.source_episode), ("outcome", entry.outcome)]
    if facts.split is not None:
        rows.append(("split", facts.side(entry.id)))
    valid = "" if entry.n_valid == entry.n_steps else f", {entry.n_valid} of them may be used"
    rows.append(("steps", f"{entry.n_steps} at {entry.rate_hz:g} Hz{valid}"))
    if entry.is_trimmed:
        rows.append(("trimmed", f"from {entry.whole_steps} steps, begins with the one numbered {entry.first_step}"))
    rows += [(f"view {view}", f"{entry.n_frames[view]} images") for view in sorted(entry.frames_sha256)]
    measured = facts.fidelity.episodes.get(entry.id, {}) if facts.fidelity else {}
    rows += [(f"reconstructed {view}", _fidelity(measured[view])) for view in sorted(measured)]
    for one in facts.sets:
        source = one.source_of(entry.id)
        rows.append((f"set {one.name}", f"actions, as {source}" if source else "no actions of it"))
    told = _rows(rows)
    return told + (f"<h3>Tags</h3>{_rows(sorted(entry.tags.items()))}" if entry.tags else "")


def _rows(rows: Sequence[tuple[str, str]]) -> str:
    return f"<dl>{''.join(f'<dt>{escape(name)}</dt><dd>{escape(told)}</dd>' for name, told in rows)}</dl>"


def _fidelity(of: Fidelity) -> str:
    told = [f"{of.psnr_db:.1f} dB PSNR"]
    told += [f"{of.moving_psnr_db:.1f} dB where it moves"] if of.moving_psnr_db is not None else []
    return ", ".join([*told, *([f"LPIPS {of.lpips:.4f}"] if of.lpips is not None else [])])


def _said(findings: Sequence[Finding]) -> str:
    items = "".join(
        f'<li class="{f.severity}"><b>{escape(_place(f))}</b>{escape(f.what)}'
        + (f'<br><span class="soft">&rarr; {with_code(f.remedy)}</span>' if f.remedy else "")
        + "</li>"
        for f in findings
    )
    return f'<h3>Findings</h3><ul class="said">{items}</ul>' if items else ""


def _place(finding: Finding) -> str:
    """Where in the episode, whose name the card bears."""
    place = where(finding, with_source=False).removeprefix(finding.place.episode or "").lstrip(", ")
    return f"{place}: " if place else ""


def _commands(facts: DatasetFacts, entry: EpisodeEntry) -> str:
    command = shlex.join(["vilp-data", "view", entry.id, "--data", str(facts.store.root)])
    return f"<h3>Look closer</h3><code>{escape(command)}</code>"
