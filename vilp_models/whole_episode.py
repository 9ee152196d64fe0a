"""VILP along a whole recorded episode: every n_action_steps steps it sees the recorded present, imagines, and says what it would do.

The world goes on as it was recorded, not as the actions would have it: each plan is compared with what a person did from the same
present. `vilp-data view --generated` shows it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from vilp_data import windows
from vilp_data.dataset_split import side_episodes
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError, VilpDataError, nearest
from vilp_data.frame_spool import FrameSpool
from vilp_data.generated_episode import (
    KINDS,
    GeneratedEpisode,
    Kind,
    Maker,
    checkpoint_files,
    open_generated_episode,
    write_generated_episode,
)
from vilp_data.latents import open_latents
from vilp_data.plots import frame_psnr
from vilp_data.spec import TaskSpec
from vilp_data.types import F32, I64, U8
from vilp_models.checkpoint import FILE, run_folder, run_for_view
from vilp_models.imagined import Decoder, decode_frames
from vilp_models.lpips import MIN_SIDE, Lpips, load_lpips
from vilp_models.lpips_weights import WeightsError
from vilp_models.metrics import lpips_distance
from vilp_models.planner import Sampler
from vilp_models.policies.base import Observation
from vilp_models.policies.vilp import VilpPolicy
from vilp_models.report_files import shown
from vilp_models.trained import TrainedPlanners, default_device, load_low_level, load_planners

Arrays = Mapping[str, npt.NDArray[Any]]
Progress = Callable[[int, int], None]


def imagine_whole(
    store: EpisodeStore,
    policy: VilpPolicy,
    decoders: Mapping[str, Decoder],
    entry: EpisodeEntry,
    maker: Maker,
    *,
    seed: int = 0,
    perceptual: Lpips | None = None,
) -> GeneratedEpisode:
    """Plans from the first step of every run of valid steps on. Long episodes' frames wait in a file, not in memory.

    Raises UsageError where no step of the episode is followed by one that a frame could be imagined for, StoreError where its latents
    are missing or stale."""
    walk = _Walk(store, policy, decoders, entry, perceptual)
    policy.reset(seed)
    for first, end in windows.valid_runs(walk.arrays["valid"]).tolist():
        for step in range(first, end, policy.n_action_steps):
            walk.plan_at(step, end)
    if not walk.step:
        raise UsageError(
            "too short for one imagined frame",
            where=entry.id,
            found=f"{entry.n_valid} valid steps, frames of {policy.low_level.frame_stride} steps",
            remedy="name another episode",
        )
    return walk.result(maker)


class _Walk:
    """What was made so far."""

    def __init__(
        self,
        store: EpisodeStore,
        policy: VilpPolicy,
        decoders: Mapping[str, Decoder],
        entry: EpisodeEntry,
        perceptual: Lpips | None,
    ) -> None:
        self.policy, self.entry, self.decoders = policy, entry, decoders
        self.arrays: Arrays = open_steps(store, entry, decoders)
        self.frames = {view: open_frames(store, entry, view) for view in decoders}
        self.latents = {view: open_latents(store.root, entry, view, decoder.key) for view, decoder in decoders.items()}
        self.perceptual = perceptual if _large_enough(self.frames) else None
        self.step: list[int] = []
        self.plan: list[int] = []
        self.plan_step: list[int] = []
        self.action = np.full((entry.n_steps, policy.low_level.action_size), np.nan, np.float32)
        self.kept = {kind: {view: FrameSpool() for view in decoders} for kind in KINDS}
        self.psnr_db: dict[Kind, dict[str, list[F32]]] = {kind: {view: [] for view in decoders} for kind in KINDS}
        self.lpips: dict[Kind, dict[str, list[F32]]] = {kind: {view: [] for view in decoders} for kind in KINDS}

    def plan_at(self, step: int, end: int) -> None:
        """Look at the present of `step`; what lies past the run of valid steps, which ends before `end`, is not kept."""
        made = self.policy.plan(self._present(step))
        n_acted = min(self.policy.n_action_steps, end - step)
        self.action[step : step + n_acted] = made.actions[0, :n_acted]
        stride = self.policy.low_level.frame_stride
        last = min(step + self.policy.n_action_steps, end - 1)
        steps = np.arange(step + stride, last + 1, stride, dtype=np.int64)
        if len(steps):
            for view, frames in self.policy.imagined_frames(made).items():
                self._keep(view, steps, frames[0, : len(steps)])
        self.step += steps.tolist()
        self.plan += [len(self.plan_step)] * len(steps)
        self.plan_step.append(step)

    def result(self, maker: Maker) -> GeneratedEpisode:
        everything = np.arange(len(self.step), dtype=np.int64)
        kept = {kind: {v: spool.take(everything) for v, spool in of.items()} for kind, of in self.kept.items()}
        return GeneratedEpisode(
            episode=self.entry.id,
            frame_stride=self.policy.low_level.frame_stride,
            step=np.array(self.step, np.int64),
            plan=np.array(self.plan, np.int32),
            plan_step=np.array(self.plan_step, np.int64),
            action=self.action,
            imagined=kept["imagined"],
            reconstructed=kept["reconstructed"],
            psnr_db=_joined(self.psnr_db),
            lpips=_joined(self.lpips) if self.perceptual is not None else {},
            maker=maker,
        )

    def _present(self, step: int) -> Observation:
        return Observation(
            frames={view: frames[self._index(view, [step])] for view, frames in self.frames.items()},
            low_dim=self.arrays["low_dim"][[step]],
            hold_action=np.zeros((1, self.action.shape[1]), np.float32),  # VILP never holds
        )

    def _keep(self, view: str, steps: I64, imagined: U8) -> None:
        rows = self._index(view, steps)
        real, rebuilt = self.frames[view][rows], decode_frames(self.decoders[view], self.latents[view][rows])
        made: dict[Kind, U8] = {"reconstructed": rebuilt, "imagined": imagined}
        for kind, frames in made.items():
            for frame in frames:
                self.kept[kind][view].append(frame)
            self.psnr_db[kind][view].append(frame_psnr(real, frames).astype(np.float32))
            if self.perceptual is not None:
                self.lpips[kind][view].append(lpips_distance(self.perceptual, real, frames))

    def _index(self, view: str, steps: Any) -> Any:
        return self.arrays[f"source_index/{view}"][steps]


def _joined(measured: Mapping[Kind, Mapping[str, list[F32]]]) -> dict[Kind, dict[str, F32]]:
    return {kind: {view: np.concatenate(parts) for view, parts in of.items()} for kind, of in measured.items()}


def _large_enough(frames: Mapping[str, U8]) -> bool:
    """Whether LPIPS can take frames of every view."""
    return all(min(view.shape[1:3]) >= MIN_SIDE["alex"] for view in frames.values())


# --- of a dataset's runs


@dataclass(frozen=True)
class WholeRequest:
    """What walks, and along what. `action_set` is the one that the low-level policy learnt from; `words` say it all to
    `vilp-models generate`, but for the dataset and the episode."""

    root: Path
    spec: TaskSpec
    planner: Path
    vqgan: Path
    policy: Path
    n_action_steps: int
    action_set: str | None = None
    seed: int = 0
    denoising_steps: int | None = None
    sampler: Sampler | None = None
    words: tuple[str, ...] = ()

    def load(self) -> tuple[VilpPolicy, TrainedPlanners]:
        """Raises as `load_planners` and `load_low_level` do."""
        store, device = EpisodeStore(self.root), default_device()
        planned = load_planners(store, self.spec, self.planner, self.vqgan, device=device)
        low_level = load_low_level(
            store, self.spec, self.policy, planned.encoders, action_set=self.action_set, device=device
        )
        policy = VilpPolicy(
            planned.planners, planned.encoders, low_level.policy, n_action_steps=self.n_action_steps,
            denoising_steps=self.denoising_steps, sampler=self.sampler,
        )  # fmt: skip
        return policy, planned

    def maker(self, policy: VilpPolicy, planned: TrainedPlanners, episode: str, lpips: bool) -> Maker:
        views = sorted(self.spec.views)
        runs = [run_for_view(self.vqgan, view) for view in views]
        runs += [run_folder(self.planner, (view,)) for view in views] + [run_folder(self.policy, views)]
        settings = {
            "planner": self.planner.name,
            "low-level policy": self.policy.name,
            "VQGAN": self.vqgan.name,
            **({"action set": self.action_set} if self.action_set else {}),
            "planned frames": str(planned.contract.n_plan_frames),
            "steps between frames": str(planned.contract.frame_stride),
            "actions between plans": str(self.n_action_steps),
            "denoising steps": policy.tags["denoising_steps"],
            "sampler": policy.tags["sampler"],
            "seed": str(self.seed),
            **({"LPIPS": "alex"} if lpips else {}),
        }
        files = checkpoint_files(self.root, [run / FILE for run in dict.fromkeys(runs)])
        return Maker(files, settings, ("--whole", *self.words, "--episode", episode))


def generate_whole(
    request: WholeRequest, out: Path, *, n_episodes: int, ids: Sequence[str] = (), progress: Progress | None = None
) -> Iterator[str]:
    """Walk along `ids`, else along `n_episodes` spread over the validation episodes, and write a file each into `out`; a line about each
    as it is done. What is there already, of the same checkpoints and settings, is left.

    Raises UsageError for an id that is no validation episode; as `imagine_whole` and `WholeRequest.load` do."""
    store = EpisodeStore(request.root)
    chosen = _chosen(store, n_episodes, ids)
    policy, planned = request.load()
    perceptual, note = _perceptual(policy.device)
    if note:
        yield note
    for done, entry in enumerate(chosen, start=1):
        maker = request.maker(policy, planned, entry.id, perceptual is not None)
        if _there_already(store, out, entry.id, maker):
            yield f"{entry.id}: there already"
        else:
            made = imagine_whole(
                store, policy, planned.encoders, entry, maker, seed=request.seed, perceptual=perceptual
            )
            write_generated_episode(out, made, entry)
            yield _line(made)
        if progress is not None:
            progress(done, len(chosen))


def _chosen(store: EpisodeStore, n_episodes: int, ids: Sequence[str]) -> list[EpisodeEntry]:
    entries = {entry.id: entry for entry in side_episodes(store, "val")}
    if not entries:
        raise UsageError("no validation episode", where=store.root, remedy="draw a split with `vilp-data split`")
    for id in ids:
        if id not in entries:
            raise UsageError(f"no validation episode called {id!r}", where=store.root, remedy=nearest(id, entries))
    if ids:
        return [entries[id] for id in dict.fromkeys(ids)]
    every = list(entries.values())
    return [every[i] for i in np.unique(np.linspace(0, len(every) - 1, n_episodes).round().astype(int))]


def _perceptual(device: torch.device) -> tuple[Lpips | None, str | None]:
    try:
        return load_lpips("alex").to(device), None
    except WeightsError as error:
        return None, f"LPIPS is left out: {error.what}" + (f" ({error.remedy})" if error.remedy else "")


def _there_already(store: EpisodeStore, out: Path, episode: str, maker: Maker) -> bool:
    """Whether the file is of today's dataset, checkpoints and settings, whatever words asked for it."""
    try:
        there = open_generated_episode(store, out, episode).maker
    except VilpDataError:
        return False
    return (there.files, there.settings) == (maker.files, maker.settings)


def _line(made: GeneratedEpisode) -> str:
    over = [f"{view} {shown(float(np.nanmean(made.psnr_db['imagined'][view])), 1)} dB" for view in made.views]
    return (
        f"{made.episode}: {len(made.plan_step)} plans, {len(made.step)} imagined frames, {'; '.join(over)} on average"
    )
