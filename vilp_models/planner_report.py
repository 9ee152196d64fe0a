"""Does this planner imagine better than a copy of the present? Held-out episodes, beside copying and reconstruction."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.spec import WindowSpec
from vilp_data.types import F32, I64, U8
from vilp_models.imagined import (
    Decoder,
    Imagination,
    Recorded,
    decode_frames,
    read_recorded,
    recorded_starts,
    spread,
)
from vilp_models.metrics import moving_mask
from vilp_models.plan_errors import (
    MEASURES,
    Measure,
    Score,
    Sums,
    best_samples,
    latent_errors,
    masked_errors,
    score,
)

REPORT_FORMAT = 2
"""Raised when the same inputs give other numbers."""

CANDIDATES = ("sample", "best", "copy_reconstructed", "copy_true", "reconstruction")
"""sample              one imagined future: its errors, averaged over all samples of the start
best                of the start's samples the one with the least latent error over the horizon
copy_reconstructed  the reconstructed frame at t in place of every planned frame: what a planner that learnt nothing can do
copy_true           the true frame at t; in latents the same as copy_reconstructed
reconstruction      the true future through the VQGAN: the best that any planner can do"""

IMAGINED = ("sample", "best")
BASELINE = "copy_reconstructed"

BATCH_STARTS = 8
EXAMPLES = 4
"""Starts shown on the contact sheet, evenly spread, so that nobody chose them."""

Progress = Callable[[int, int], None]
"""Told (starts done, starts in all)."""


@dataclass(frozen=True)
class Example:
    """One start on the contact sheet; planned frames are `frame_stride` steps apart.

    present, present_reconstructed  uint8 [H,W,3]
    real, reconstructed             uint8 [N,H,W,3]
    best, first                     uint8 [N,H,W,3]: the sample with the least latent error, and the first
    """

    episode: str
    step: int
    frame_stride: int
    view: str
    present: U8
    present_reconstructed: U8
    real: U8
    reconstructed: U8
    best: U8
    first: U8


@dataclass
class ViewReport:
    """One view's planner: squared errors of every candidate, measure -> candidate -> sums over the report's episodes."""

    view: str
    sums: dict[Measure, dict[str, Sums]]
    examples: list[Example] = field(default_factory=list)

    @classmethod
    def empty(cls, view: str, n_episodes: int, n_frames: int) -> ViewReport:
        sums = {m: {name: Sums.zeros(n_episodes, n_frames) for name in CANDIDATES} for m in MEASURES}
        return cls(view, sums)

    def score(self, measure: Measure, candidate: str) -> Score:
        return score(self.sums[measure][candidate], measure)

    def gain(self, measure: Measure, candidate: str) -> Score:
        """`candidate` less copying the reconstructed present frame, paired: above zero is better for PSNR, below for latents."""
        sums = self.sums[measure]
        return score(sums[candidate], measure, minus=sums[BASELINE])

    @property
    def warnings(self) -> list[str]:
        """In words, where one sample does not beat copying, and where the best one does not."""
        out = []
        for candidate, words in (("sample", "an imagined future"), ("best", "even the best of all samples")):
            lost = [
                f"{_MEASURE_WORDS[measure]} {when} ({_signed(estimate.value, measure)})"
                for measure in MEASURES
                for when, estimate in _averages(self.gain(measure, candidate))
                if (estimate.value >= 0 if measure == "latent" else estimate.value <= 0)
            ]
            if lost:
                out.append(
                    f"do not act on this planner: in view {self.view!r} {words} is no better than copying the reconstructed "
                    f"present frame, by {'; '.join(lost)}. Train it longer, or compare models.planner.condition"
                )
        return out


_MEASURE_WORDS = {"latent": "latent error", "moving": "moving pixels", "changed": "changed pixels"}


def _averages(gain: Score) -> list[tuple[str, Any]]:
    return [("over the horizon", gain.mean), ("at the last frame", gain.last)]


def _signed(value: float, measure: Measure) -> str:
    return f"{value:+.3f}" if measure == "latent" else f"{value:+.2f} dB"


@dataclass(frozen=True)
class PlannerReport:
    """Every view; `episodes` are those that hold starts (the axis E), `n_starts` how many there are in all.

    agreement  view pairs "a+b" -> share of starts at which both views' best samples are the same one: views sample on their own,
               and may imagine different futures. One in n_samples is chance"""

    views: tuple[ViewReport, ...]
    episodes: tuple[str, ...]
    n_starts: int
    n_samples: int
    frame_stride: int
    agreement: Mapping[str, float]

    @property
    def warnings(self) -> list[str]:
        return [warning for view in self.views for warning in view.warnings]


def planner_report(
    store: EpisodeStore,
    imagination: Imagination,
    decoders: Mapping[str, Decoder],
    entries: Sequence[EpisodeEntry],
    window: WindowSpec,
    *,
    latent_std: Mapping[str, Sequence[float]],
    n_starts: int,
    n_samples: int = 8,
    progress: Progress | None = None,
) -> PlannerReport:
    """Imagine from `n_starts` starts spread evenly over the held-out `entries`, and compare.

    `latent_std` gives each view's latent deviation by channel, over the training episodes. Raises UsageError where no episode
    is long enough, StoreError for latents that are missing."""
    starts = spread(recorded_starts(store, entries, window), n_starts)
    total = sum(len(steps) for _, steps in starts)
    shown = set(np.linspace(0, total - 1, min(EXAMPLES, total)).round().astype(int).tolist())
    keys = {view: decoder.key for view, decoder in decoders.items()}
    reports = {view: ViewReport.empty(view, len(starts), window.n_plan_frames) for view in imagination.planners}
    chosen: dict[str, list[int]] = {view: [] for view in reports}
    done = 0
    for episode, (entry, steps) in enumerate(starts):
        for recorded in read_recorded(store, entry, steps, keys, window, batch_size=BATCH_STARTS):
            imagined = imagination.of(recorded, n_samples=n_samples)
            for view, report in reports.items():
                rows = [row for row in range(len(recorded)) if done + row in shown]
                best = _compare(
                    report, recorded, imagined[view], decoders[view], latent_std[view], episode=episode, shown=rows
                )
                chosen[view] += best.tolist()
            done += len(recorded)
            if progress is not None:
                progress(done, total)
    return PlannerReport(
        tuple(reports.values()),
        tuple(entry.id for entry, _ in starts),
        total,
        n_samples,
        window.frame_stride,
        _agreement(chosen),
    )


def _compare(
    report: ViewReport,
    recorded: Recorded,
    imagined: F32,
    decoder: Decoder,
    std: Sequence[float],
    *,
    episode: int,
    shown: Sequence[int],
) -> I64:
    """Add one view's errors at B starts of one episode to the report; which of their samples is best, int64 [B]."""
    view = report.view
    rows = np.arange(len(recorded))
    true, now = recorded.latents[view].astype(np.float32), recorded.present_latents[view].astype(np.float32)
    sample_errors = latent_errors(true[:, None], imagined, std)
    best = best_samples(sample_errors)
    copied = latent_errors(true, now[:, None], std)
    latent = {
        "sample": sample_errors.mean(axis=1),
        "best": sample_errors[rows, best],
        "copy_reconstructed": copied,
        "copy_true": copied,
        "reconstruction": np.zeros_like(copied),
    }
    for name, errors in latent.items():
        report.sums["latent"][name].add(episode, errors, np.ones_like(errors))

    real, present = recorded.future[view], recorded.present[view][:, None]
    frames = decode_frames(decoder, imagined)
    present_rebuilt = decode_frames(decoder, recorded.present_latents[view])
    rebuilt = decode_frames(decoder, recorded.latents[view])
    masks = {"moving": moving_mask(real, recorded.background[view]), "changed": moving_mask(real, present)}
    for measure in ("moving", "changed"):
        mask = masks[measure]
        each = masked_errors(real[:, None], frames, mask[:, None])
        pixels = {
            "sample": each.mean(axis=1),
            "best": each[rows, best],
            "copy_reconstructed": masked_errors(real, present_rebuilt[:, None], mask),
            "copy_true": masked_errors(real, present, mask),
            "reconstruction": masked_errors(real, rebuilt, mask),
        }
        count = mask.sum(axis=(-2, -1)).astype(np.float64)
        for name, errors in pixels.items():
            report.sums[measure][name].add(episode, errors, count)
    for row in shown:
        report.examples.append(
            Example(
                recorded.episode,
                int(recorded.step[row]),
                recorded.frame_stride,
                view,
                present=recorded.present[view][row],
                present_reconstructed=present_rebuilt[row],
                real=real[row],
                reconstructed=rebuilt[row],
                best=frames[row, best[row]],
                first=frames[row, 0],
            )
        )
    return best


def _agreement(chosen: Mapping[str, Sequence[int]]) -> dict[str, float]:
    views = sorted(chosen)
    pairs = [(one, other) for i, one in enumerate(views) for other in views[i + 1 :]]
    return {f"{a}+{b}": float(np.mean(np.equal(chosen[a], chosen[b]))) for a, b in pairs}
