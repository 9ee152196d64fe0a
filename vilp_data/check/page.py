"""A check as one page of HTML: findings, timing of each topic, the action's fit, contact sheets. It needs nothing from elsewhere."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from vilp_data import shards
from vilp_data.check.findings import SEVERITIES, Finding, Group, counts, grouped, verdict
from vilp_data.check.report import Checked, Fit, Sheet, TopicFacts
from vilp_data.check.sources import CheckReport
from vilp_data.check.style import STYLE
from vilp_data.check.svg import fit_bars, lag_line, lane
from vilp_data.check.text import duration, said_of, shown_evidence, where
from vilp_data.contact_sheet import jpeg_uri
from vilp_data.errors import UsageError

JPEG_QUALITY = 82
SHOWN_PLACES = 40
ALL_PICTURES = 24
"""Pictures of a camera where one log is checked; of several, they share."""

MOST_PICTURES = 600
"""Of a whole page, about 3 MB: beyond that only logs with findings show theirs."""


def write_page(path: Path, report: CheckReport) -> None:
    """Write the page, whole or not at all. StoreError where the folder cannot be written."""
    shards.write_atomic(path, page(report).encode())


def require_place(path: Path) -> None:
    """UsageError where no page can be written as `path`: to be known before an hour of checking, not after it."""
    folder = next(folder for folder in path.absolute().parents if folder.exists())
    if path.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        found = "a folder" if path.is_dir() else f"{folder} is no folder that can be written to"
        raise UsageError(
            "a page cannot be written there", where=path, found=found, remedy="name a file, such as check.html"
        )


def page(report: CheckReport) -> str:
    """The page as text."""
    findings = report.findings
    one = len(report.checked) == 1
    title = Path(report.checked[0].source).name if one else f"{report.folder or 'check'} ({len(report.checked)} logs)"
    body = [
        f"<header><h1>{escape(title)}</h1>{_lead(report)}{tally(findings)}</header>",
        _section(
            "Findings", _shorter(report, "".join(article(group, with_source=not one) for group in grouped(findings)))
        ),
        _section("Does the action drive the motion?", _fits(report.fits)),
        _section("What was checked" if one else "Each of them", "".join(_sources(report))),
        "<footer>Written by <code>vilp-data check</code>. The drawings show each topic along its log: the longest interval between two"
        " messages, in usual ones (dashed), on a logarithmic scale; coloured bands are findings.</footer>",
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}: {verdict(findings)}</title><style>{STYLE}</style></head>"
        f"<body><main>{''.join(body)}</main></body></html>\n"
    )


def _shorter(report: CheckReport, text: str) -> str:
    """Text of several logs in one folder, without that folder's name."""
    return text.replace(escape(report.folder), "") if report.folder else text


def _section(title: str, content: str) -> str:
    return f"<section><h2>{title}</h2>{content}</section>" if content else ""


def _lead(report: CheckReport) -> str:
    n_episodes = sum(checked.n_episodes for checked in report.checked)
    seconds = sum(checked.duration_s for checked in report.checked)
    size = sum(checked.size_bytes for checked in report.checked) / 1e6
    kinds = ", ".join(dict.fromkeys(checked.format for checked in report.checked))
    told = f"{kinds}: {n_episodes} episode{'' if n_episodes == 1 else 's'}, {duration(seconds)}, {size:.1f} MB"
    source = f'<p class="mono soft">{escape(report.checked[0].source)}</p>' if len(report.checked) == 1 else ""
    return f'<p class="soft">{escape(told)}</p>{source}'


def tally(findings: Sequence[Finding]) -> str:
    """How many of each severity, as a list of large numbers."""
    numbers = counts(findings)
    if not findings:
        return '<ul class="tally"><li class="good"><b>&#10003;</b>nothing to complain about</li></ul>'
    cells = [
        f'<li class="{severity if numbers[severity] else "none"}"><b>{numbers[severity]}</b>'
        f"{severity}{'' if numbers[severity] == 1 else 's'}</li>"
        for severity in SEVERITIES
    ]
    return f'<ul class="tally">{"".join(cells)}</ul>'


# --- findings -----------------------------------------------------------------------------------------------------------


def article(group: Group, *, with_source: bool) -> str:
    """Findings of one kind: the first in full, the places of the others folded away."""
    first = group.first
    evidence = "".join(
        f"<li>{escape(name.replace('_', ' '))} <b>{escape(value)}</b></li>"
        for name, value in shown_evidence(first.evidence)
    )
    times = f'<span class="soft">{len(group.findings)} times</span>' if group.others else ""
    return (
        f'<article class="finding {first.severity}"><div class="head"><span class="label">{first.severity}</span>'
        f'<span class="mono">{escape(where(first, with_source=with_source))}</span>{times}</div>'
        f'<p class="what">{escape(first.what)}</p>'
        + (f'<ul class="evidence">{evidence}</ul>' if evidence else "")
        + (f'<p class="remedy">{with_code(first.remedy)}</p>' if first.remedy else "")
        + _others(group.others, with_source=with_source)
        + "</article>"
    )


def _others(others: Sequence[Finding], *, with_source: bool) -> str:
    if not others:
        return ""
    items = "".join(
        f'<li><span class="mono">{escape(where(other, with_source=with_source))}</span>: {escape(other.what)}</li>'
        for other in others[:SHOWN_PLACES]
    )
    rest = f"<li>and {len(others) - SHOWN_PLACES} more</li>" if len(others) > SHOWN_PLACES else ""
    told = f"also in {len(others)} other place{'' if len(others) == 1 else 's'}"
    return f'<details class="more"><summary>{told}</summary><ul>{items}{rest}</ul></details>'


def with_code(text: str) -> str:
    """Text whose `commands` and lines of TOML are set as code."""
    escaped = escape(text, quote=False)
    escaped = re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped)
    setting = r'((?:topic|clock|offset_s|from|shift|by) = (?:"[^"]*"|[-\d.]+)(?:, (?:clock|offset_s|shift) = (?:"[^"]*"|[-\d.]+\d))*)'
    return re.sub(setting, r"<code>\1</code>", escaped)


# --- action -------------------------------------------------------------------------------------------------------------


def _fits(fits: Sequence[Fit]) -> str:
    if not fits:
        return ""
    lead = (
        '<p class="soft">Of the motion that the robot\'s own past leaves open: how much does the action explain, if it were stored'
        " some steps earlier or later? Smooth commands explain it nearly as well a step later, so what is said below each drawing"
        " rests on what later and earlier actions add to each other.</p>"
    )
    return lead + f'<div class="fits">{"".join(map(_fit, fits))}</div>'


def _fit(fit: Fit) -> str:
    told = f"{fit.fit.n_steps:,} steps at {fit.rate_hz:.3g} Hz; its own past alone explains {max(fit.fit.own_past, 0):.0%}."
    told += f" {said_of(fit.fit).capitalize()}."
    return (
        f"<figure>{fit_bars(fit.fit)}<figcaption><strong>{escape(fit.topic)}</strong><br>{told}</figcaption></figure>"
    )


# --- each log -----------------------------------------------------------------------------------------------------------


def _sources(report: CheckReport) -> Iterator[str]:
    several = len(report.checked) > 1
    cameras = max(sum(len(checked.sheets) for checked in report.checked), 1)
    each = ALL_PICTURES if not several else max(min(ALL_PICTURES, MOST_PICTURES // cameras), 4)
    left = MOST_PICTURES
    for checked in report.checked:
        wanted = each if left > 0 or checked.findings else 0
        left -= wanted * len(checked.sheets)
        yield _source(checked, is_open=not several, n_pictures=wanted)


def _source(checked: Checked, *, is_open: bool, n_pictures: int) -> str:
    numbers = counts(checked.findings)
    worst = next((severity for severity in SEVERITIES if numbers[severity]), "good")
    told = f"{checked.n_episodes} episode{'' if checked.n_episodes == 1 else 's'}, {duration(checked.duration_s)}"
    topics = "".join(_topic(topic, checked) for topic in checked.topics)
    sheets = "".join(_sheet(sheet, n_pictures) for sheet in checked.sheets) if n_pictures else ""
    return (
        f'<details class="source"{" open" if is_open else ""}><summary><span class="name">{escape(Path(checked.source).name)}</span>'
        f'<span class="soft">{escape(told)}</span><span class="badge {worst}">{escape(verdict(checked.findings))}</span></summary>'
        f'<div class="inside">{topics}{sheets}</div></details>'
    )


def _topic(topic: TopicFacts, checked: Checked) -> str:
    marks = [f for f in checked.findings if f.place.topic == topic.name and f.place.episode is None]
    plots = ""
    if topic.timeline is not None and topic.timing is not None and topic.timing.rate_hz and checked.duration_s > 0:
        drawn = lane(topic.timeline.longest_s, 1 / topic.timing.rate_hz, marks, checked.duration_s)
        scale = f'<span class="scale"><span>0 s</span><span>{checked.duration_s:.1f} s</span></span>'
        plots = f'<div class="plots">{drawn}{scale}{lag_line(topic.timeline.lag_s)}</div>'
    facts = ", ".join(_facts(topic))
    return (
        f'<div class="topic"><div><div class="title mono">{escape(topic.name)}</div><div class="facts">{escape(topic.schema)}</div>'
        f'<div class="facts">{facts}</div></div>{plots}</div>'
    )


def _facts(topic: TopicFacts) -> Iterator[str]:
    if topic.n_messages is not None:
        yield f"<b>{topic.n_messages:,}</b> messages"
    timing = topic.timing
    if timing is not None and timing.rate_hz is not None:
        yield f"<b>{timing.rate_hz:.4g}</b> Hz" + ("" if timing.periodic else " on the whole, on events")
        if timing.jitter is not None and timing.periodic:
            yield f"jitter <b>{timing.jitter:.1%}</b>"
        if timing.max_gap_s is not None:
            yield f"longest gap <b>{timing.max_gap_s:.3g}</b> s"
    if timing is not None and timing.lag_s is not None:
        yield f"lag <b>{timing.lag_s * 1e3:.1f}</b> ms"
    if topic.image:
        yield f"<b>{escape(topic.image)}</b>"
    if topic.note:
        yield escape(topic.note)


def _sheet(sheet: Sheet, n_pictures: int) -> str:
    every = max(-(-len(sheet.pictures) // n_pictures), 1)
    figures = "".join(
        f'<figure><img alt="{escape(label)}" loading="lazy" src="{jpeg_uri(picture, quality=JPEG_QUALITY)}">'
        f"<figcaption>{escape(label)}</figcaption></figure>"
        for label, picture in sheet.pictures[::every]
    )
    return f'<h3 class="mono">{escape(sheet.topic)}</h3><div class="sheet">{figures}</div>'
