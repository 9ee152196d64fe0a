"""What the fit of actions to motion says: stored late, early, driving nothing, or too smooth to tell. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from vilp_data.check.action_fit import MIN_GAIN, ActionFit
from vilp_data.check.findings import Evidence, Finding, Place


def action_findings(fit: ActionFit, *, topic: str, rate_hz: float, certain: bool) -> Iterator[Finding]:
    """What the fit says. `certain`: a task names action and state; else they were guessed by their names, and an error is a warning."""
    best, step_ms = fit.best, 1e3 / rate_hz
    evidence, place = _evidence(fit, rate_hz), Place(topic=topic)
    if fit.explained < MIN_GAIN:
        yield Finding(
            severity="warning" if certain else "note", kind="action-says-nothing", place=place, evidence=evidence,
            what=f"the action does not predict motion: at no shift does it explain more than {max(fit.explained, 0):.0%} of it",
            remedy="name the topic that drives the robot as the action; where none was recorded, "
            '[action.NAME] from = "STATE", shift = 1',
        )  # fmt: skip
    elif fit.is_late:
        yield Finding(
            severity="error" if certain else "warning", kind="action-late", place=place, evidence=evidence,
            what=f"the action is stored {_steps(best)} late: that of step k+{best} explains {max(fit.gain[best], 0):.0%} of the motion"
            f" at step k, its own {max(fit.gain[0], 0):.0%}, and given the later ones those up to k add {fit.earlier_add(0):.1%}",
            remedy=f"offset_s = {-best / rate_hz:.4g} on the action's topic ({best} x {step_ms:.3g} ms), and ingest again",
        )  # fmt: skip
    elif fit.is_early:
        yield Finding(
            severity="note", kind="action-early", place=place, evidence=evidence,
            what=f"the motion at step k depends on actions up to that of step k{best}: together they explain"
            f" {max(fit.up_to[best], 0):.0%} of it, and later ones, its own among them, add {fit.later_add(best):.1%}",
            remedy=f"a robot that follows its commands {-best * step_ms:.0f} ms later looks like this; if it does not, offset_s ="
            f" {-best / rate_hz:.4g} on the action's topic",
        )  # fmt: skip
    elif fit.is_untold:
        yield Finding(
            severity="note", kind="action-shift-untold", place=place, evidence=evidence,
            what="commands so smooth that an action a step later would explain the motion as well: a shift would not show",
            remedy="nothing is wrong by this; where a shift is feared, replay an episode, or compare the clocks by `vilp-data inspect`",
        )  # fmt: skip
    for name, shift, there, here in fit.odd if not (fit.is_late or fit.is_early or fit.is_untold) else ():
        late = "late" if shift > 0 else "early"
        yield Finding(
            severity="warning", kind="action-odd-episode", place=Place(topic=topic, episode=name),
            what=f"here the action fits best {_steps(abs(shift))} {late}, unlike in the others",
            evidence={f"explained_at_shift_{shift:+d}": round(there, 4), "explained_at_shift_+0": round(here, 4)},
            remedy="compare its clocks with another's by `vilp-data inspect`; once ingested, `vilp-data remove` leaves it out",
        )  # fmt: skip


def _evidence(fit: ActionFit, rate_hz: float) -> Evidence:
    return {
        **{f"explained_at_shift_{shift:+d}": round(gain, 4) for shift, gain in fit.gain.items()},
        "later_actions_add": round(fit.later_add(0), 4), "earlier_actions_add": round(fit.earlier_add(0), 4),
        "explained_by_own_past": round(fit.own_past, 4), "n_steps": fit.n_steps, "rate_hz": rate_hz,
    }  # fmt: skip


def _steps(count: int) -> str:
    return {1: "one step", 2: "two steps", 3: "three steps"}[count]
