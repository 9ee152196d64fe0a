"""A planner report as files: report.json, report.md, and sheet.png with the real, the reconstructed and the imagined."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vilp_data.contact_sheet import ERROR_GAIN, captioned, error_image, grid, stacked, to_png
from vilp_data.types import U8
from vilp_models.metrics import MOVING_THRESHOLD
from vilp_models.plan_errors import MEASURES, RESAMPLES, Measure, Score
from vilp_models.planner_report import BASELINE, CANDIDATES, IMAGINED, Example, PlannerReport, ViewReport
from vilp_models.report_files import (
    estimate_table,
    estimate_words,
    markdown_table,
    number,
    page,
    shown,
    write_report_files,
)

TITLES: Mapping[Measure, str] = {
    "latent": "Standardised latent error (less is better)",
    "moving": "PSNR over moving pixels, dB",
    "changed": "PSNR over changed pixels, dB",
}
NAMES = {
    "sample": "imagined, a sample",
    "best": "imagined, best sample",
    "copy_reconstructed": "copy of the reconstructed present",
    "copy_true": "copy of the true present",
    "reconstruction": "true future, reconstructed",
}


def write_planner_report(report: PlannerReport, folder: Path, inputs: Mapping[str, Any]) -> list[Path]:
    """Write the three files into `folder`, report.json with its `inputs` last. Raises StoreError where they cannot be written."""
    table = {"inputs": inputs, **to_table(report)}
    examples = [example for view in report.views for example in view.examples]
    sheet = to_png(stacked([example_sheet(example) for example in examples]))
    return write_report_files(folder, table, to_markdown(report, inputs), {"sheet.png": sheet})


def to_table(report: PlannerReport) -> dict[str, Any]:
    """The report as plain data; what is not defined is null."""
    return {
        "episodes": list(report.episodes),
        "starts": report.n_starts,
        "samples": report.n_samples,
        "moving_threshold": MOVING_THRESHOLD,
        "warnings": report.warnings,
        "best_sample_agreement": dict(report.agreement),
        "views": {view.view: _view_table(view) for view in report.views},
    }


def to_markdown(report: PlannerReport, inputs: Mapping[str, Any]) -> str:
    """For people: what was compared, then for each view and measure the averages, the gains over copying, and every step."""
    parts = [["# Planner on held-out episodes"], _words(report, inputs)]
    for view in report.views:
        parts.append([f"## {view.view}"])
        for measure in MEASURES:
            parts += [[f"### {TITLES[measure]}"], _averages(view, measure), _steps(view, measure, report.frame_stride)]
    if report.agreement:
        rows = [[pair, shown(share)] for pair, share in report.agreement.items()]
        parts.append(markdown_table("views | share of starts where the same sample is best in both", rows))
    parts.append(["![present and future: real, reconstructed, imagined, error](sheet.png)"])
    return page(report.warnings, parts)


def example_sheet(example: Example) -> U8:
    """Rows real, reconstructed, best and first sample, error of the best; a column a time, the present first: uint8 [H,W,3]."""
    columns = ["t", *(f"t + {(i + 1) * example.frame_stride}" for i in range(len(example.real)))]
    rows = {
        "real": [example.present, *example.real],
        "reconstructed": [example.present_reconstructed, *example.reconstructed],
        "best sample": [None, *example.best],
        "first sample": [None, *example.first],
        f"error x{ERROR_GAIN}": [None, *error_image(example.real, example.best)],
    }
    text = f"{example.view}  {example.episode}  from step {example.step}; error of the best sample"
    return captioned(text, grid(rows, columns))


def summary(table: Mapping[str, Any], folder: Path) -> list[str]:
    """A report.json for a terminal: a line a view and measure, then the warnings."""
    lines = ["averages over the horizon (at the last frame)"]
    for view, measures in table["views"].items():
        for measure in MEASURES:
            row = measures[measure]
            means = {n: f"{_brief(row[n]['mean'])} ({_brief(row[n]['last'])})" for n in (*IMAGINED, BASELINE)}
            lines.append(
                f"{view}: {TITLES[measure]}: " + "; ".join(f"{NAMES[n]} {words}" for n, words in means.items())
            )
    warnings = [f"warning: {warning}" for warning in table["warnings"]]
    return [*lines, *warnings, f"{folder}/report.md and sheet.png show it in full"]


def _brief(estimate: Mapping[str, float | None]) -> str:
    value = estimate["value"]
    return "–" if value is None else f"{value:.3g}"


def _words(report: PlannerReport, inputs: Mapping[str, Any]) -> list[str]:
    n, stride = inputs.get("n_plan_frames"), inputs.get("frame_stride")
    return [
        f"{report.n_starts} starts spread evenly over {len(report.episodes)} validation episodes, each imagined {report.n_samples} "
        f"times, {n} frames {stride} steps apart, {inputs.get('denoising_steps')} denoising steps ({inputs.get('sampler')}), "
        f"seed {inputs.get('seed')}. Only starts whose whole horizon was recorded.",
        "",
        "- *a sample*: the squared errors of all samples of a start, averaged: what acting on one of them gets. "
        "*best sample*: of a start's samples the one with the least latent error over the horizon, which needs the answer to be known.",
        "- *copy*: the frame at t in place of every planned one, reconstructed by the VQGAN as the planner's are, or true. "
        "*true future, reconstructed*: no planner with this VQGAN can be better.",
        "- *Latent error*: squared, in units of each channel's deviation over the training episodes. "
        f"*Moving pixels* of a frame are more than {MOVING_THRESHOLD} of 255 from the episode's temporal median, *changed pixels* "
        "as much from the frame at t: where a copy must fail.",
        f"- Errors are pooled over starts, then scored at each horizon step. In brackets 95 % intervals of a bootstrap over episodes "
        f"({RESAMPLES} draws); gains are paired.",
    ]


def _averages(view: ViewReport, measure: Measure) -> list[str]:
    rows = []
    for name in CANDIDATES:
        own = view.score(measure, name)
        gain = view.gain(measure, name) if name in IMAGINED else None
        gains = (
            ["", ""]
            if gain is None
            else [estimate_words(e, _digits(measure), sign=True) for e in (gain.mean, gain.last)]
        )
        rows.append([NAMES[name], *(estimate_words(e, _digits(measure)) for e in (own.mean, own.last)), *gains])
    return markdown_table(
        "what | over the horizon | last frame | against the reconstructed copy | at the last frame", rows
    )


def _steps(view: ViewReport, measure: Measure, stride: int) -> list[str]:
    scores = {name: view.score(measure, name).steps for name in CANDIDATES}
    titles = " | ".join(["what", *(f"t + {(i + 1) * stride}" for i in range(len(scores[BASELINE])))])
    return markdown_table(
        titles, [[NAMES[name], *(shown(x, _digits(measure)) for x in steps)] for name, steps in scores.items()]
    )


def _digits(measure: Measure) -> int:
    return 3 if measure == "latent" else 2


def _view_table(view: ViewReport) -> dict[str, Any]:
    return {
        measure: {
            **{name: _score_table(view.score(measure, name)) for name in CANDIDATES},
            "gain": {name: _score_table(view.gain(measure, name)) for name in IMAGINED},
        }
        for measure in MEASURES
    }


def _score_table(score: Score) -> dict[str, Any]:
    steps = [number(x) for x in score.steps.tolist()]
    return {"mean": estimate_table(score.mean), "last": estimate_table(score.last), "steps": steps}
