"""Is this VQGAN good enough to train a planner on? Validation episodes reconstructed, beside trivial baselines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data.episode_files import open_frames
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError, nearest
from vilp_data.keys import digest
from vilp_data.latents import BATCH, encode_batches, read_latents, stale_reason
from vilp_data.types import F16, I64, U8, Bool
from vilp_models.checkpoint import checkpoint_digest, read_state, refuse_trained_on_validation, run_for_view
from vilp_models.lpips import Lpips, load_lpips
from vilp_models.metrics import lpips_distance, moving_mask, psnr_from_mse, squared_error, temporal_median
from vilp_models.vqgan import VqganEncoder, load_frame_encoder

REPORT_FORMAT = 1
"""Raised when the same inputs give other numbers."""

ENOUGH_DB = 6.0
"""Moving pixels must be at least this much better than the mean training frame gives."""

PRECISION_STRIDE = 8
"""Every so many frames float16 latents are compared with float32 ones: another pass of encoder and decoder."""

WORST_FRAMES, WORST_GAP = 6, 10
"""Frames a view on the contact sheet, and how far apart they are in one episode."""


Progress = Callable[[int, int], None]
"""Told (frames done, frames in all), every view's counted."""


@dataclass(frozen=True)
class Errors:
    """Summed squared errors (0 to 255) and pixel counts, over all pixels and over the moving ones. They add up."""

    all_sum: float = 0.0
    all_count: int = 0
    moving_sum: float = 0.0
    moving_count: int = 0

    def __add__(self, other: Errors) -> Errors:
        return Errors(
            self.all_sum + other.all_sum,
            self.all_count + other.all_count,
            self.moving_sum + other.moving_sum,
            self.moving_count + other.moving_count,
        )

    @property
    def psnr(self) -> float:
        return psnr_from_mse(self.all_sum / self.all_count if self.all_count else float("nan"))

    @property
    def moving_psnr(self) -> float:
        """NaN where nothing moves."""
        return psnr_from_mse(self.moving_sum / self.moving_count if self.moving_count else float("nan"))


@dataclass(frozen=True)
class PrecisionCost:
    """What storing float16 instead of float32 latents costs, on every PRECISION_STRIDE-th frame. They add up."""

    max_error: float = 0.0
    flipped: int = 0
    pixels: int = 0
    stored: Errors = Errors()
    exact: Errors = Errors()

    def __add__(self, other: PrecisionCost) -> PrecisionCost:
        return PrecisionCost(
            max(self.max_error, other.max_error),
            self.flipped + other.flipped,
            self.pixels + other.pixels,
            self.stored + other.stored,
            self.exact + other.exact,
        )

    @property
    def flipped_share(self) -> float:
        """Share of latent pixels whose nearest code is another one."""
        return self.flipped / self.pixels if self.pixels else 0.0

    @property
    def psnr_change(self) -> float:
        """PSNR through the stored latents minus PSNR through float32 ones, in dB."""
        return self.stored.psnr - self.exact.psnr


@dataclass(frozen=True)
class EpisodeFidelity:
    """One view of one episode. `vqgan` is its reconstruction. The baselines put in place of each frame the mean
    training frame, a copy of the episode's first frame, and the frame before."""

    episode: str
    view: str
    frames: int
    lpips: float
    vqgan: Errors
    mean_frame: Errors
    copy: Errors
    previous_frame: Errors


@dataclass(frozen=True)
class WorstFrame:
    """A frame that reconstructs badly: uint8 [H,W,3] real and reconstructed."""

    episode: str
    view: str
    index: int
    mse: float
    real: U8
    reconstructed: U8


@dataclass(frozen=True)
class ViewFidelity:
    """One view over all episodes of the report."""

    view: str
    key: str
    episodes: tuple[EpisodeFidelity, ...]
    code_counts: I64
    precision: PrecisionCost
    worst: tuple[WorstFrame, ...]

    def total(self, name: str) -> Errors:
        """Errors of `vqgan` or of a baseline, pooled over episodes."""
        return sum((getattr(episode, name) for episode in self.episodes), Errors())

    @property
    def lpips(self) -> float:
        """Mean over frames."""
        return sum(e.lpips * e.frames for e in self.episodes) / sum(e.frames for e in self.episodes)

    @property
    def codes_used(self) -> int:
        return int(np.count_nonzero(self.code_counts))

    @property
    def code_perplexity(self) -> float:
        """exp of the entropy of code frequencies: how many codes do the work, if they did equally much."""
        share = self.code_counts[self.code_counts > 0] / self.code_counts.sum()
        return float(np.exp(-(share * np.log(share)).sum()))

    @property
    def gain_db(self) -> float:
        """Moving pixels: reconstruction above the mean training frame. NaN where nothing moves."""
        return self.total("vqgan").moving_psnr - self.total("mean_frame").moving_psnr

    @property
    def warning(self) -> str | None:
        """Why no planner should be trained on this view, or None."""
        if self.total("vqgan").moving_count == 0:
            return f"do not train a planner on this: nothing moves in view {self.view!r}; is the camera stuck?"
        if self.gain_db >= ENOUGH_DB:
            return None
        reached = self.total("vqgan").moving_psnr
        return (
            f"do not train a planner on this: moving pixels of view {self.view!r} reconstruct at {reached:.1f} dB, "
            f"{self.gain_db:+.1f} dB against the mean training frame (wanted: {ENOUGH_DB:+.0f} at least); "
            "train the VQGAN longer, wider, or with a higher models.vqgan.moving_weight"
        )


@dataclass(frozen=True)
class FidelityReport:
    """Every view of the report; `lpips_network` names the network behind its LPIPS numbers."""

    views: tuple[ViewFidelity, ...]
    lpips_network: str

    @property
    def warnings(self) -> list[str]:
        return [view.warning for view in self.views if view.warning is not None]


def fidelity_report(
    store: EpisodeStore,
    run_dir: Path,
    episodes: Sequence[str],
    *,
    views: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> FidelityReport:
    """Measure the VQGANs in `run_dir` on validation `episodes`: stored float16 latents (encoded here where there are
    none), quantised, then decoded.

    Raises SplitError where an episode was trained on, UsageError for an unknown episode or a view without a VQGAN.
    """
    entries = {entry.id: entry for entry in store.index()}
    unknown = [episode for episode in episodes if episode not in entries]
    if unknown:
        raise UsageError(f"no episode called {unknown[0]!r}", where=store.root, remedy=nearest(unknown[0], entries))
    if not episodes:
        raise UsageError(
            "no validation episode to report on", where=store.root, remedy="draw a split with `vilp-data split`"
        )
    views = views or sorted(store.spec().views)
    chosen = [entries[episode] for episode in sorted(episodes)]
    done, total = 0, sum(entry.n_frames[view] for entry in chosen for view in views)

    def advance(frames: int) -> None:
        nonlocal done
        done += frames
        if progress is not None:
            progress(done, total)

    perceptual = load_lpips("alex")
    measured = []
    for view in views:
        run = run_for_view(run_dir, view)
        state = read_state(run)
        assert state is not None  # run_for_view found its checkpoint
        refuse_trained_on_validation(state, chosen, where=run)
        encoder = load_frame_encoder(run_dir, view)
        perceptual = perceptual.to(encoder.device)
        mean = mean_frame(store, _training_entries(entries, run_dir, view), view)
        measured.append(_measure_view(store, encoder, perceptual, view, chosen, mean, advance))
    return FidelityReport(tuple(measured), "alex")


def report_inputs(store: EpisodeStore, run_dir: Path, episodes: Sequence[str]) -> dict[str, Any]:
    """All that a report depends on, as plain data: a report written with equal inputs need not be made again."""
    entries = {entry.id: entry for entry in store.index()}
    views, tables = sorted(store.spec().views), store.spec().views
    depth = [view for view in views if tables[view].depth is not None]
    return {
        "format": REPORT_FORMAT,
        **({"readings_only": depth} if depth else {}),  # reports of pictures have the numbers they had before
        "checkpoints": {view: checkpoint_digest(run_for_view(run_dir, view)) for view in views},
        "frames": {e: {view: entries[e].frames_id(view) for view in views} for e in sorted(episodes)},
        "mean_frame_of": {
            view: digest({e.id: e.frames_id(view) for e in _training_entries(entries, run_dir, view)}) for view in views
        },
    }


def mean_frame(store: EpisodeStore, episodes: Sequence[EpisodeEntry], view: str) -> U8:
    """Mean over all frames of these episodes, rounded: uint8 [H,W,C]; of depth over those with a reading there."""
    if not episodes:
        raise UsageError(
            "none of the run's training episodes is in this dataset",
            where=store.root,
            remedy="name the dataset it was trained on",
        )
    total: npt.NDArray[np.int64] | None = None
    count: npt.NDArray[np.int64] | int = 0
    for episode in episodes:
        frames = open_frames(store, episode, view)
        part = frames.sum(axis=0, dtype=np.int64)
        total = part if total is None else total + part
        count = count + has_reading(frames).sum(axis=0)[..., None]
    assert total is not None
    return np.round(total / np.maximum(count, 1)).astype(np.uint8)


def has_reading(frames: U8) -> Bool:
    """Which pixels tell anything, bool [...,H,W]: all of a picture's; of depth (one channel) those that are not 0, "no reading"."""
    return np.any(frames > 0, axis=-1) if frames.shape[-1] == 1 else np.ones(frames.shape[:-1], np.bool_)


def _training_entries(entries: Mapping[str, EpisodeEntry], run_dir: Path, view: str) -> list[EpisodeEntry]:
    """The episodes that the view's run was trained on, as far as the dataset still has them."""
    return [entries[episode] for episode in sorted(_trained_on(run_for_view(run_dir, view)) & entries.keys())]


def _trained_on(run: Path) -> set[str]:
    state = read_state(run)
    assert state is not None  # run_for_view found its checkpoint
    return set(state.train_episodes)


def _measure_view(
    store: EpisodeStore,
    encoder: VqganEncoder,
    perceptual: Lpips,
    view: str,
    entries: Sequence[EpisodeEntry],
    mean: U8,
    advance: Callable[[int], None],
) -> ViewFidelity:
    key, counts, precision = encoder.key, np.zeros(encoder.codes, np.int64), PrecisionCost()
    measured: list[EpisodeFidelity] = []
    worst: list[WorstFrame] = []
    for entry in entries:
        frames = store.read_frames(view, entry)
        latents = _latents(store, encoder, key, view, entry, frames)
        counts += np.bincount(encoder.codes_of(latents).ravel(), minlength=encoder.codes)
        decoded = np.concatenate([encoder.decode(latents[i : i + BATCH]) for i in range(0, len(latents), BATCH)])
        distance = float(lpips_distance(perceptual, frames, decoded).mean())
        measured.append(_measure_episode(entry.id, view, frames, decoded, mean, distance))
        precision += precision_cost(encoder, frames[::PRECISION_STRIDE], latents[::PRECISION_STRIDE])
        worst += _worst(entry.id, view, frames, decoded)
        advance(len(frames))
    worst.sort(key=lambda frame: -frame.mse)
    return ViewFidelity(view, key, tuple(measured), counts, precision, tuple(worst[:WORST_FRAMES]))


def _latents(store: EpisodeStore, encoder: VqganEncoder, key: str, view: str, entry: EpisodeEntry, frames: U8) -> F16:
    if stale_reason(store.root, entry, view, key) is None:
        return read_latents(store.root, entry, view, key)
    return np.concatenate(list(encode_batches(encoder, frames)))


def _measure_episode(episode: str, view: str, frames: U8, decoded: U8, mean: U8, distance: float) -> EpisodeFidelity:
    background = temporal_median(frames)
    moving = moving_mask(frames, background) & has_reading(background)
    return EpisodeFidelity(
        episode=episode,
        view=view,
        frames=len(frames),
        lpips=distance,
        vqgan=errors_between(frames, decoded, moving),
        mean_frame=errors_between(frames, mean, moving),
        copy=errors_between(frames, frames[0], moving),
        previous_frame=errors_between(frames[1:], frames[:-1], moving[1:]),
    )


def errors_between(real: U8, other: U8, moving: npt.NDArray[np.bool_]) -> Errors:
    """Errors of `other`, which broadcasts over frames, where `moving` bool [n,H,W] says what moves. Pixels of depth without a reading
    in `real` do not count: whatever stands there is right."""
    out = Errors()
    for start in range(0, len(real), BATCH):  # float copies of a whole episode would not fit beside it
        part = slice(start, start + BATCH)
        known = has_reading(real[part])
        error = squared_error(real[part], other[part] if other.ndim == 4 else other) * known
        mask = moving[part] & known
        out += Errors(
            float(error.sum(dtype=np.float64)),
            int(known.sum()),
            float(error[mask].sum(dtype=np.float64)),
            int(mask.sum()),
        )
    return out


def precision_cost(encoder: VqganEncoder, frames: U8, latents: F16) -> PrecisionCost:
    """Compare stored latents with those of a float32 encoder, not rounded."""
    out = PrecisionCost()
    for start in range(0, len(frames), BATCH):
        real, stored = frames[start : start + BATCH], latents[start : start + BATCH]
        exact = encoder.encode_f32(real)
        everywhere = np.ones(real.shape[:3], np.bool_)
        flipped = encoder.codes_of(stored) != encoder.codes_of(exact)
        out += PrecisionCost(
            max_error=float(np.abs(stored.astype(np.float32) - exact).max()),
            flipped=int(flipped.sum()),
            pixels=flipped.size,
            stored=errors_between(real, encoder.decode(stored), everywhere),
            exact=errors_between(real, encoder.decode(exact), everywhere),
        )
    return out


def _worst(episode: str, view: str, frames: U8, decoded: U8) -> Iterator[WorstFrame]:
    """The episode's worst frames, WORST_GAP apart, so that one bad moment does not fill the sheet."""
    mse = np.array(
        [(squared_error(real, fake) * has_reading(real)).mean() for real, fake in zip(frames, decoded, strict=True)]
    )
    for _ in range(WORST_FRAMES):
        index = int(mse.argmax())
        if mse[index] < 0:
            return
        yield WorstFrame(episode, view, index, float(mse[index]), frames[index].copy(), decoded[index].copy())
        mse[max(0, index - WORST_GAP) : index + WORST_GAP + 1] = -1
