"""A check as text for the terminal: worst first, alike together, short. Pure."""

from __future__ import annotations

import textwrap

from vilp_data.check.action_fit import ActionFit
from vilp_data.check.findings import Evidence, Finding, Group, grouped, verdict
from vilp_data.check.report import Checked, Fit
from vilp_data.check.sources import CheckReport
from vilp_data.errors import number_of

SHOWN_PLACES = 3
SHOWN_SOURCES = 12
WIDTH = 118
MARKS = {"error": "ERROR  ", "warning": "WARNING", "note": "note   "}


def format_report(report: CheckReport) -> str:
    """The whole check; the verdict comes last, where a terminal stops scrolling."""
    findings = report.findings
    one = len(report.checked) == 1
    lines = [f"{report.folder}: {number_of(len(report.checked), 'log')}"] if report.folder else []
    lines += [_source_line(checked).removeprefix(report.folder) for checked in report.checked[:SHOWN_SOURCES]]
    if len(report.checked) > SHOWN_SOURCES:
        lines.append(f"… and {len(report.checked) - SHOWN_SOURCES} more")
    for group in grouped(findings):
        lines += ["", *(line.replace(report.folder, "") if report.folder else line for line in _group(group, not one))]
    fits = [_fit_line(fit) for fit in report.fits]
    if fits:
        lines += ["", *fits]
    return "\n".join([*lines, "", verdict(findings)])


def _source_line(checked: Checked) -> str:
    counted = f"{number_of(checked.n_episodes, 'episode')}, {duration(checked.duration_s)}"
    return f"{checked.source}: {checked.format}, {checked.size_bytes / 1e6:.1f} MB" + (
        f", {counted}" if checked.n_episodes else ""
    )


def duration(seconds: float) -> str:
    """`28.8 s`, `12 min 5 s`, `2 h 3 min`."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def _group(group: Group, with_source: bool) -> list[str]:
    first = group.first
    lines = [f"{MARKS[first.severity]} {where(first, with_source=with_source)}", f"        {first.what}"]
    if first.evidence:
        told = ", ".join(f"{name} {value}" for name, value in shown_evidence(first.evidence))
        lines += textwrap.wrap(told, WIDTH, initial_indent=" " * 8, subsequent_indent=" " * 8)
    if first.remedy:
        lines += textwrap.wrap(f"-> {first.remedy}", WIDTH, initial_indent=" " * 8, subsequent_indent=" " * 11)
    for other in group.others[:SHOWN_PLACES]:
        told = f"also {where(other, with_source=with_source)}: {other.what}"
        lines.append(" " * 8 + textwrap.shorten(told, WIDTH, placeholder=" …"))
    if len(group.others) > SHOWN_PLACES:
        lines.append(f"        and {len(group.others) - SHOWN_PLACES} more like these")
    return lines


def where(finding: Finding, *, with_source: bool) -> str:
    """The place in words, without the source where there is only one."""
    text = str(finding.place)
    source = finding.place.source or ""
    if not with_source and text.startswith(source):
        text = text[len(source) :].lstrip(", ")
    return text or "all of it"


def shown_evidence(evidence: Evidence) -> list[tuple[str, str]]:
    """(name, value) as they are shown. The fit at each shift is drawn or listed elsewhere."""
    drawn = [name for name in evidence if name.startswith("explained_at_shift")]
    hidden = drawn if len(drawn) > 2 else []
    return [
        (name, f"{value:.4g}" if isinstance(value, float) else str(value))
        for name, value in evidence.items()
        if name not in hidden
    ]


def _fit_line(fit: Fit) -> str:
    shares = "  ".join(f"{shift:+d}: {max(gain, 0):.0%}" for shift, gain in fit.fit.gain.items())
    return f"{fit.topic}: of the motion that the robot's past leaves open it explains, by shift,\n        {shares}  ({said_of(fit.fit)})"


def said_of(fit: ActionFit) -> str:
    """The verdict on a fit, in a few words."""
    if fit.is_early:
        return f"actions later than {_steps(-fit.best)} before the motion add nothing to the earlier ones"
    if fit.is_late:
        return f"stored {_steps(fit.best)} late"
    if fit.is_untold:
        return "too smooth to tell one step from the next"
    return "it drives its own step, as it should" if fit.best == 0 else "not clear enough to call it off"


def _steps(count: int) -> str:
    return "one step" if count == 1 else f"{count} steps"


def json_report(report: CheckReport) -> dict[str, object]:
    """Plain data: what every log and dataset showed, and all findings, worst first."""
    findings = report.findings
    return {
        "verdict": verdict(findings),
        "findings": [finding.as_dict() for finding in findings],
        "checked": [without_findings(checked) for checked in report.checked],
        "action_fits": [_fit_dict(fit) for fit in report.fits],
    }


def without_findings(checked: Checked) -> dict[str, object]:
    return {name: value for name, value in checked.as_dict().items() if name != "findings"}


def _fit_dict(fit: Fit) -> dict[str, object]:
    explained = {f"{shift:+d}": gain for shift, gain in fit.fit.gain.items()}
    return {
        "topic": fit.topic, "rate_hz": fit.rate_hz, "n_steps": fit.fit.n_steps, "best_shift": fit.fit.best,
        "verdict": said_of(fit.fit), "later_actions_add": fit.fit.later_add(0), "earlier_actions_add": fit.fit.earlier_add(0),
        "explained_by_own_past": fit.fit.own_past, "explained_by_shift": explained,
    }  # fmt: skip
