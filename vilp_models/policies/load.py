"""Policies by name: which there are, and how each comes from a dataset folder and its runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from vilp_data.dataset_split import read_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, nearest
from vilp_data.spec import TaskSpec
from vilp_data.types import F32, U8
from vilp_models.action_labels import SetId, set_text
from vilp_models.checkpoint import checkpoint_digest, run_for_view
from vilp_models.planner import Sampler
from vilp_models.policies.base import Policy
from vilp_models.recipe import Precision
from vilp_models.runs import find_model_run
from vilp_models.starts import Recording
from vilp_models.vqgan import VqganEncoder

DIGITS = 16
"""Of a checkpoint's digest, as reports and logs name it."""

LEARNS_FROM_ACTIONS = frozenset({"policy", "bc"})
"""Kinds of models that may be trained by an action set."""


@dataclass(frozen=True)
class PolicyRequest:
    """What a policy is loaded from. `preset` chooses the runs (runs/policy-PRESET, …), None the only ones there are.

    device      where all of its networks run
    recordings  those that episodes start from, by policy seed; none where the simulator draws the starts
    vqgan       the run of the VQGANs, where another than the preset's
    runs        "policy", "bc", "planner" -> its run, where another than the preset's
    action_set  the set that its low-level policy, or its cloned behaviour, learnt from (runs/policy-PRESET-SET, …)
    denoising_steps, sampler, precision
                of a policy that imagines, as `VilpPolicy` takes them
    """

    root: Path
    spec: TaskSpec
    preset: str | None
    n_action_steps: int
    device: str = "cpu"
    recordings: Mapping[int, Recording] = field(default_factory=dict)
    vqgan: Path | None = None
    runs: Mapping[str, Path] = field(default_factory=dict)
    action_set: str | None = None
    denoising_steps: int | None = None
    sampler: Sampler | None = None
    precision: Precision = "f32"

    def run_dir(self, kind: str) -> Path:
        """Folder of the runs of one kind of model. Raises UsageError where there is none, or it is not clear which."""
        if kind == "vqgan":
            return find_model_run(self.root, kind, given=self.vqgan, preset=self.preset, option="--vqgan")
        if kind in self.runs:
            return self.runs[kind]
        action_set = self.action_set if kind in LEARNS_FROM_ACTIONS else None
        return find_model_run(self.root, kind, preset=self.preset, action_set=action_set, option="--preset")

    def tags(self, action_set: SetId | None, **checkpoints: str) -> dict[str, str]:
        """What was run, for report and logs: digests, cut short, the action set if one was learnt from, and the split that the
        models' episodes were checked against."""
        digests = {name: digest[:DIGITS] for name, digest in checkpoints.items()}
        learnt = {} if action_set is None else {"action_set": set_text(action_set)}
        return {**digests, **learnt, "split": read_split(self.root).hash[:DIGITS]}

    def vqgan_checkpoints(self) -> dict[str, str]:
        """Tag -> digest of each view's VQGAN, decoder and codebook included, which latents do not tell apart."""
        run = self.run_dir("vqgan")
        views = sorted(self.spec.views)
        return {f"vqgan_checkpoint_{view}": checkpoint_digest(run_for_view(run, view)) for view in views}

    def encoders(self) -> dict[str, VqganEncoder]:
        """The VQGAN of each view. Raises UsageError where one is not trained, SplitError where one knows validation episodes."""
        from vilp_models.trained import load_encoders

        return load_encoders(EpisodeStore(self.root), self.spec, self.run_dir("vqgan"), device=self.device)


def load_policy(name: str, request: PolicyRequest) -> Policy:
    """The policy called `name`, ready for `reset`.

    Raises UsageError for an unknown name, for one that needs recorded episodes where there are none, and where its models are not
    trained, or not for this dataset."""
    if name not in LOADERS:
        raise UsageError(f"no policy called {name!r}", remedy=nearest(name, LOADERS))
    if name in FOLLOWS_RECORDINGS and not request.recordings:
        raise UsageError(
            f"the policy {name!r} follows recorded episodes, and a seed has none",
            remedy="start with --from-episodes val",
        )
    return LOADERS[name](request)


def _stay(request: PolicyRequest) -> Policy:
    from vilp_models.policies.stay import StayPolicy

    return StayPolicy(n_action_steps=request.n_action_steps)


def _replay(request: PolicyRequest) -> Policy:
    from vilp_models.policies.recorded import RecordedPolicy

    return RecordedPolicy(request.recordings, n_action_steps=request.n_action_steps)


def _oracle(request: PolicyRequest) -> Policy:
    from vilp_models.policies.oracle import OraclePolicy
    from vilp_models.trained import load_low_level

    store, encoders = EpisodeStore(request.root), request.encoders()
    trained = load_low_level(
        store, request.spec, request.run_dir("policy"), encoders, action_set=request.action_set, device=request.device
    )
    encodes = trained.recipe.sees == "latents"
    encode = partial(_latents, encoders) if encodes else None
    vqgans = request.vqgan_checkpoints() if encodes else {}
    tags = request.tags(trained.action_set, policy_checkpoint=trained.digest, **vqgans)
    return OraclePolicy(
        trained.policy, request.recordings, n_action_steps=request.n_action_steps, encode=encode, tags=tags
    )


def _latents(encoders: Mapping[str, VqganEncoder], view: str, frames: U8) -> F32:
    """Rounded as the latents that were trained on."""
    return encoders[view].encode(frames).astype(np.float32)


def _bc(request: PolicyRequest) -> Policy:
    from vilp_models.policies.bc import BcPolicy
    from vilp_models.trained import load_bc

    trained = load_bc(
        EpisodeStore(request.root), request.spec, request.run_dir("bc"), n_action_steps=request.n_action_steps,
        action_set=request.action_set, device=request.device,
    )  # fmt: skip
    return BcPolicy(trained.network, tags=request.tags(trained.action_set, bc_checkpoint=trained.digest))


def _vilp(request: PolicyRequest) -> Policy:
    from vilp_models.policies.vilp import VilpPolicy
    from vilp_models.trained import load_low_level, load_planners

    store = EpisodeStore(request.root)
    planned = load_planners(
        store, request.spec, request.run_dir("planner"), request.run_dir("vqgan"), device=request.device
    )
    low_level = load_low_level(
        store, request.spec, request.run_dir("policy"), planned.encoders,
        action_set=request.action_set, device=request.device,
    )  # fmt: skip
    planners = {f"planner_checkpoint_{view}": digest for view, digest in planned.digests.items()}
    return VilpPolicy(
        planned.planners,
        planned.encoders,
        low_level.policy,
        n_action_steps=request.n_action_steps,
        denoising_steps=request.denoising_steps,
        sampler=request.sampler,
        precision=request.precision,
        tags=request.tags(
            low_level.action_set, policy_checkpoint=low_level.digest, **planners, **request.vqgan_checkpoints()
        ),
    )


LOADERS: Mapping[str, Callable[[PolicyRequest], Policy]] = {
    "stay": _stay,
    "replay": _replay,
    "oracle": _oracle,
    "bc": _bc,
    "vilp": _vilp,
}

FOLLOWS_RECORDINGS = frozenset({"replay", "oracle"})
"""Policies that only know what to do from the first state of a recorded episode."""

HAS_MODELS = frozenset({"oracle", "bc", "vilp"})
"""Policies that come from trained runs, and so from a preset."""
