"""What VILP imagines along a whole recorded episode, and what it would do: DATA/generated/RUN/EPISODE.safetensors.

Every `n_action_steps` steps of a recorded episode it looked at the real present (a *plan*), imagined the next frames, one every
`frame_stride` steps, and its low-level policy said the actions between them. The file holds what was made, not what was recorded:
the viewer reads that from the dataset. Reconstructed frames are kept too, so that looking needs no network.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from vilp_data import shards
from vilp_data.contact_sheet import error_image
from vilp_data.dataset_split import find_split
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import StoreError, UsageError, nearest
from vilp_data.types import F32, I32, I64, U8

FORMAT = 1
"""Of these files."""

SHOWN_AT_A_TIME = 64
"""Frames of a view that are in memory together while they are drawn."""

Kind = Literal["reconstructed", "imagined"]
KINDS: tuple[Kind, ...] = ("reconstructed", "imagined")
"""What is measured against the recorded frames: the VQGAN's part of the error, then all of it."""


@dataclass(frozen=True)
class Maker:
    """What made it, and how to make it again.

    files        checkpoint, by its place in the dataset (else its path) -> the checksum in its header
    settings     what to say of it, by name: denoising steps, sampler, seed, action set, …
    command      words after `vilp-models generate --data DATA` that make this episode's file again
    """

    files: Mapping[str, str]
    settings: Mapping[str, str]
    command: tuple[str, ...]


@dataclass(frozen=True)
class GeneratedEpisode:
    """P imagined frames of each view, of K plans, along an episode of F steps.

    step, plan   int64, int32 [P]: the step that each frame imagines, rising, and which plan imagined it
    plan_step    int64 [K]: the step at which each plan looked at the recorded present, rising
    action       float32 [F,A], in the dataset's units: what would have been done at each step; NaN where nothing was planned
    imagined, reconstructed
                 view -> uint8 [P,H,W,C], beside the frame that was recorded at `step`
    psnr_db, lpips
                 kind -> view -> float32 [P] against the recorded frame; `lpips` is empty where it was not measured
    """

    episode: str
    frame_stride: int
    step: I64
    plan: I32
    plan_step: I64
    action: F32
    imagined: Mapping[str, U8]
    reconstructed: Mapping[str, U8]
    psnr_db: Mapping[Kind, Mapping[str, F32]]
    lpips: Mapping[Kind, Mapping[str, F32]]
    maker: Maker

    @property
    def views(self) -> tuple[str, ...]:
        return tuple(sorted(self.imagined))

    @property
    def ahead(self) -> I64:
        """int64 [P]: how many steps before each frame its plan last saw the world."""
        ahead: I64 = self.step - self.plan_step[self.plan]
        return ahead

    @property
    def shown_first(self) -> int:
        """The row to begin looking at: the last of a plan in the middle, where the dream has gone furthest."""
        ends = np.flatnonzero(np.diff(self.plan, append=self.plan[-1] + 1))
        return int(ends[len(ends) // 2])

    @property
    def plan_of_step(self) -> I32:
        """int32 [F]: the plan in force at each step, -1 where none is."""
        known = np.isfinite(self.action).all(axis=1)
        plan = np.searchsorted(self.plan_step, np.arange(len(self.action)), side="right") - 1
        return np.where(known, plan, -1).astype(np.int32)


@dataclass(frozen=True)
class Shown:
    """Some imagined frames of a view beside the recorded ones: rows `first` and on, uint8 [n,H,W,C] each."""

    first: int
    real: U8
    reconstructed: U8
    imagined: U8

    @property
    def error(self) -> U8:
        """|real - imagined|, brighter."""
        return error_image(self.real, self.imagined)


def shown_frames(store: EpisodeStore, generated: GeneratedEpisode, view: str) -> Iterator[Shown]:
    """All rows of a view, SHOWN_AT_A_TIME at a time. Raises StoreError as `open_frames` does."""
    entry = store.entry(generated.episode)
    recorded = open_frames(store, entry, view)
    index = open_steps(store, entry, [view])[f"source_index/{view}"]
    for first in range(0, len(generated.step), SHOWN_AT_A_TIME):
        rows = slice(first, first + SHOWN_AT_A_TIME)
        real = recorded[index[generated.step[rows]]]
        yield Shown(first, real, generated.reconstructed[view][rows], generated.imagined[view][rows])


# --- files


def find_generated(root: Path, run: str) -> Path:
    """The folder of generated episodes that `run` names: under DATA/generated/, or a path.

    Raises UsageError where it holds none."""
    known = sorted(path.name for path in (root / "generated").glob("*") if generated_ids(path))
    folder = root / "generated" / run if run in known or not Path(run).is_dir() else Path(run)
    if not generated_ids(folder):
        make = "make some with `vilp-models generate --whole`"
        raise UsageError(
            "no generated episodes there", where=folder, remedy=f"{nearest(run, known)}; or {make}" if known else make
        )
    return folder


def generated_name(root: Path, folder: Path) -> str:
    """What `find_generated` finds a folder by: its name under DATA/generated/, else its whole path."""
    own = folder.resolve().parent == (root / "generated").resolve()
    return folder.resolve().name if own else str(folder.resolve())


def generated_ids(folder: Path) -> list[str]:
    """The episodes that a folder of generated ones has a file of, sorted."""
    return sorted(path.name.removesuffix(".safetensors") for path in folder.glob("[!.]*.safetensors"))


def generated_path(folder: Path, episode_id: str) -> Path:
    return folder / f"{episode_id}.safetensors"


def write_generated_episode(folder: Path, generated: GeneratedEpisode, entry: EpisodeEntry) -> Path:
    """Write what was made along the stored episode `entry`; its path. Raises StoreError where it cannot be written."""
    tensors: dict[str, npt.NDArray[Any]] = {
        "step": generated.step,
        "plan": generated.plan,
        "plan_step": generated.plan_step,
        "action": generated.action,
        **{f"imagined/{view}": frames for view, frames in generated.imagined.items()},
        **{f"reconstructed/{view}": frames for view, frames in generated.reconstructed.items()},
    }
    for name, measured in (("psnr_db", generated.psnr_db), ("lpips", generated.lpips)):
        tensors |= {f"{name}/{kind}/{view}": v for kind, of in measured.items() for view, v in of.items()}
    header = {
        "generated_format": str(FORMAT),
        "episode": generated.episode,
        "frame_stride": str(generated.frame_stride),
        "made_of": json.dumps(_made_of(entry), sort_keys=True),
        "files": json.dumps(dict(generated.maker.files), sort_keys=True),
        "settings": json.dumps(dict(generated.maker.settings)),
        "command": json.dumps(generated.maker.command),
    }
    path = generated_path(folder, generated.episode)
    shards.write_shard(path, tensors, header)
    return path


def open_generated_episode(store: EpisodeStore, folder: Path, episode_id: str) -> GeneratedEpisode:
    """The mapped file of one episode, if it still is what the dataset's models make of the episode today.

    Raises UsageError for an unknown id; StoreError for damage, and where the episode, its side of the split, or a checkpoint is
    another one now, with the command that makes it again."""
    known = generated_ids(folder)
    if episode_id not in known:
        raise UsageError(
            "nothing generated of this episode", where=folder, found=episode_id, remedy=nearest(episode_id, known)
        )
    path = generated_path(folder, episode_id)
    shard = shards.open_shard(path)
    if shard.metadata.get("generated_format") != str(FORMAT):
        found = f"format {shard.metadata.get('generated_format')}, this is {FORMAT}"
        remedy = "make it again with `vilp-models generate --whole`"
        raise StoreError("written by another version", where=path, found=found, remedy=remedy)
    maker = _maker(shard.metadata)
    why = _stale_reason(store, episode_id, shard.metadata, maker)
    if why is not None:
        words = ["vilp-models", "generate", "--data", str(store.root), *maker.command]
        remedy = f"make it again: {shlex.join(words)}"
        raise StoreError("made of something else than the dataset holds today", where=path, found=why, remedy=remedy)
    arrays = shard.arrays
    views = sorted(name.removeprefix("imagined/") for name in arrays if name.startswith("imagined/"))
    measured = {
        name: {kind: {view: arrays[f"{name}/{kind}/{view}"] for view in views} for kind in KINDS}
        for name in ("psnr_db", "lpips")
        if all(f"{name}/{kind}/{view}" in arrays for kind in KINDS for view in views)
    }
    return GeneratedEpisode(
        episode=episode_id,
        frame_stride=int(shard.metadata["frame_stride"]),
        step=arrays["step"],
        plan=arrays["plan"],
        plan_step=arrays["plan_step"],
        action=arrays["action"],
        imagined={view: arrays[f"imagined/{view}"] for view in views},
        reconstructed={view: arrays[f"reconstructed/{view}"] for view in views},
        psnr_db=measured["psnr_db"],
        lpips=measured.get("lpips", {}),
        maker=maker,
    )


def stale_generated(root: Path) -> dict[str, str]:
    """generated/RUN/EPISODE.safetensors -> why it is refused, and the command that makes it again."""
    store, reasons = EpisodeStore(root), {}
    for folder in sorted((root / "generated").glob("*")):
        for episode_id in generated_ids(folder):
            try:
                open_generated_episode(store, folder, episode_id)
            except StoreError as error:
                reasons[str(generated_path(folder, episode_id))] = f"{error.found}; {error.remedy}"
    return reasons


def checkpoint_files(root: Path, files: list[Path]) -> dict[str, str]:
    """`Maker.files` of these checkpoints. Raises StoreError where one cannot be read."""
    return {_place(root, path): shards.read_header(path).metadata["sha256"] for path in files}


def _place(root: Path, path: Path) -> str:
    return str(path.relative_to(root)) if path.is_relative_to(root) else str(path.resolve())


def _made_of(entry: EpisodeEntry) -> dict[str, object]:
    return {
        "key": entry.key,
        "content_sha256": entry.content_sha256,
        "frames_sha256": dict(entry.frames_sha256),
    }


def _maker(metadata: Mapping[str, str]) -> Maker:
    command = tuple(str(word) for word in json.loads(metadata["command"]))
    return Maker(json.loads(metadata["files"]), json.loads(metadata["settings"]), command)


def _stale_reason(store: EpisodeStore, episode_id: str, metadata: Mapping[str, str], maker: Maker) -> str | None:
    """What is another thing today; None where nothing is. A checkpoint that is not there any more says nothing."""
    entries = {entry.id: entry for entry in store.index()}
    if episode_id not in entries:
        return "the episode is not in the dataset any more"
    made_of, today = json.loads(metadata["made_of"]), _made_of(entries[episode_id])
    changed = [name for name, value in today.items() if made_of.get(name) != value]
    if changed:
        return f"the episode was ingested or trimmed since ({', '.join(changed)})"
    split = find_split(store.root)
    if split is not None and split.assignment.get(episode_id) != "val":
        return "the episode is none to validate on any more: the split was drawn anew"
    for place, sha256 in maker.files.items():
        path = store.root / place
        if path.is_file() and shards.read_header(path).metadata.get("sha256") != sha256:
            return f"{place} was trained again since"
    return None
