"""Where episodes begin: at what the simulator draws from a seed, or at the first state of a recorded episode."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vilp_data.dataset_split import find_split, side_episodes
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError, nearest, some_of
from vilp_data.keys import content_digest, digest
from vilp_data.spec import SimSpec, TaskSpec
from vilp_data.types import F32, F64, I32, U8, is_rollout
from vilp_models.simulator import Worlds, is_of_world

SIDES = ("val", "train", "all")


@dataclass(frozen=True)
class Start:
    """Where an episode begins. `name` tells it from others and names its files.

    policy_seed  what the policy draws from, and by which it finds the start's recording
    reset_seed   what the environment is reset with, if anything: it draws its own start from that
    state        float64 [S]: the recorded state to begin at instead
    recording    content hash of the stored episode that begins there, which some policies look ahead in
    """

    name: str
    policy_seed: int
    reset_seed: int | None
    state: F64 | None = None
    recording: str | None = None


@dataclass(frozen=True)
class Recording:
    """A stored episode to look ahead in: mapped frames view -> uint8 [n,H,W,3], source_index view -> int32 [F], low_dim float32
    [F,L], action float32 [F,A], state float64 [F,S]. Past the end the last step repeats."""

    frames: Mapping[str, U8]
    source_index: Mapping[str, I32]
    low_dim: F32
    action: F32
    state: F64

    @property
    def n_steps(self) -> int:
        return len(self.action)

    def held(self, step: int) -> int:
        """`step`, or the last one."""
        return min(step, self.n_steps - 1)

    def frame(self, view: str, step: int) -> U8:
        """uint8 [H,W,3]: what the view showed at `step`."""
        frame: U8 = self.frames[view][self.source_index[view][self.held(step)]]
        return frame


def parse_seeds(text: str) -> range:
    """ "100000:100050" is 100000 … 100049, "7" is 7 alone. Raises UsageError for anything else, or a range without a seed."""
    match = re.fullmatch(r"(\d+)(?::(\d+))?", text)
    first, end = (int(match[1]), int(match[2] or int(match[1]) + 1)) if match else (0, 0)
    if end <= first:
        remedy = "FIRST:END, without END itself, as 100000:100050 for fifty seeds; or one seed"
        raise UsageError(f"no seeds: {text!r}", remedy=remedy)
    return range(first, end)


def seed_starts(seeds: Sequence[int]) -> list[Start]:
    """A start for each seed, which is the simulator's and the policy's."""
    return [Start(f"seed{seed:07d}", seed, seed) for seed in seeds]


def unseen_starts(store: EpisodeStore, spec: TaskSpec, seeds: Sequence[int]) -> list[Start]:
    """`seed_starts`, of seeds that no training episode of the task's own world was recorded from: from those a policy may know the way by
    heart. Raises UsageError that names some of them."""
    split = find_split(store.root)
    sides = {} if split is None else split.assignment
    trained = [entry for entry in store.index() if sides.get(entry.id) == "train"]
    met = [entry for entry in trained if (seed := tagged_seed(entry.tags)) is not None and seed in seeds]
    if met:
        world = Worlds(spec, cameras=False)
        own = world.own_tags()
        world.close()
        met = [entry for entry in met if is_of_world(entry.tags, own)]
    if met:
        raise UsageError(
            "training episodes were recorded from these starts, so a policy may know them by heart",
            where=store.root,
            found=some_of([f"seed {entry.tags['seed']} ({entry.id})" for entry in met], 3),
            remedy="other seeds, such as --seeds 100000:100050; or --from-episodes train, to see how it does there",
        )
    return seed_starts(seeds)


def tagged_seed(tags: Mapping[str, str]) -> int | None:
    """What the simulator was reset with for the episode of these tags; None where they do not say, or say what can be no seed. Whoever
    begins at its recorded state needs none."""
    text = tags.get("seed", "")
    return int(text) if re.fullmatch("[0-9]{1,18}", text) else None


def episode_starts(
    store: EpisodeStore, side: str, *, limit: int | None = None, world: Mapping[str, str] | None = None
) -> tuple[list[Start], dict[int, Recording]]:
    """The first recorded state of each stored episode on a side of the split ("val", "train", or "all" there are), the first
    `limit` of them by id; and the recordings, by the start's policy seed: `episode_seed` of their id. Episodes whose tags say another
    `world` (`simulator.world_tags`) than the one to be played in are left out.

    Raises UsageError for an unknown side, where no such episode has actions and simulator states, or where one begins with a step
    that cannot be used; SplitError where the dataset has no split."""
    if side not in SIDES:
        raise UsageError(f"no such side of the split: {side!r}", remedy=nearest(side, SIDES))
    entries = store.index() if side == "all" else side_episodes(store, "val" if side == "val" else "train")
    played = [
        entry
        for entry in entries
        if entry.has_action and entry.has_state and not is_rollout(entry.tags) and is_of_world(entry.tags, world or {})
    ][:limit]
    if not played:
        told = ", ".join(f"{tag} {value}" for tag, value in (world or {}).items())
        raise UsageError(
            f"no episode of {side!r} has both actions and simulator states" + (f", and is of {told}" if told else ""),
            where=store.root,
            remedy="roll out from --seeds instead",
        )
    recordings, starts = {}, []
    for entry in played:
        seed, recording = episode_seed(entry.id), open_recording(store, entry)
        recordings[seed] = recording
        starts.append(
            Start(
                entry.id, seed, tagged_seed(entry.tags), np.array(recording.state[0], np.float64), entry.content_sha256
            )
        )
    return starts, recordings


def starts_digest(sim: SimSpec, starts: Sequence[Start]) -> str:
    """SHA-256 of all that decides where rollouts from `starts` begin, and what their policies may look ahead in: two of the same
    digest can be compared start by start."""
    begun = [
        [s.name, s.policy_seed, s.reset_seed, None if s.state is None else content_digest(s.state), s.recording]
        for s in starts
    ]
    return digest({"env": sim.env, "options": sim.options, "starts": begun})


def episode_seed(episode: str) -> int:
    """A seed from the id of an episode alone, so that it stays when episodes are added: 48 bits, which no two ids of a dataset share
    but by an odd chance, and JSON numbers hold."""
    return int.from_bytes(hashlib.sha256(episode.encode()).digest()[:6])


def open_recording(store: EpisodeStore, entry: EpisodeEntry) -> Recording:
    """One stored episode, its frames mapped. Raises UsageError where its first step cannot be used, StoreError for damage."""
    views = sorted(entry.frames_sha256)
    steps = open_steps(store, entry, views)
    if not (np.isfinite(steps["state"][0]).all() and steps["valid"][0]):
        remedy = "leave it out, or roll out from --seeds"
        raise UsageError("its first step is not valid, so nothing can begin there", where=entry.id, remedy=remedy)
    return Recording(
        frames={view: open_frames(store, entry, view) for view in views},
        source_index={view: np.array(steps[f"source_index/{view}"]) for view in views},
        low_dim=np.array(steps["low_dim"]),
        action=np.array(steps["action"]),
        state=np.array(steps["state"]),
    )
