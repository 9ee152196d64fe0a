"""Policies by name: which there are, and how each comes from a dataset folder and its runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, nearest
from vilp_data.spec import TaskSpec
from vilp_data.types import F32, U8
from vilp_models.policies.base import Policy
from vilp_models.starts import Recording
from vilp_models.vqgan import VqganEncoder, load_frame_encoder

DIGITS = 16
"""Of a checkpoint's digest, as reports and logs name it."""


@dataclass(frozen=True)
class PolicyRequest:
    """What a policy is loaded from. `preset` chooses the runs (runs/policy-PRESET, …), None the only ones there are;
    `recordings` are those that episodes start from, by seed; none where the simulator draws the starts."""

    root: Path
    spec: TaskSpec
    preset: str | None
    n_action_steps: int
    device: str = "cpu"
    recordings: Mapping[int, Recording] = field(default_factory=dict)

    def run_dir(self, kind: str) -> Path:
        """Folder of the runs of one kind of model. Raises UsageError where it is not clear which."""
        if self.preset is not None:
            return self.root / "runs" / f"{kind}-{self.preset}"
        there = sorted(path for path in (self.root / "runs").glob(f"{kind}-*") if path.is_dir())
        if len(there) != 1:
            raise UsageError(
                f"which {kind}?",
                where=self.root / "runs",
                found=", ".join(path.name for path in there) or "none",
                remedy=f"choose with --preset, or train one: `vilp-models train {kind}`",
            )
        return there[0]

    def encoders(self) -> dict[str, VqganEncoder]:
        """The VQGAN of each view. Raises UsageError where one is not trained."""
        run = self.run_dir("vqgan")
        return {view: load_frame_encoder(run, view) for view in sorted(self.spec.views)}


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
    trained = load_low_level(store, request.spec, request.run_dir("policy"), encoders, device=request.device)
    encode = partial(_latents, encoders) if trained.recipe.sees == "latents" else None
    tags = {"policy_checkpoint": trained.digest[:DIGITS]}
    return OraclePolicy(
        trained.policy, request.recordings, n_action_steps=request.n_action_steps, encode=encode, tags=tags
    )


def _latents(encoders: Mapping[str, VqganEncoder], view: str, frames: U8) -> F32:
    return encoders[view].encode_f32(frames)


def _bc(request: PolicyRequest) -> Policy:
    from vilp_models.policies.bc import BcPolicy
    from vilp_models.trained import load_bc

    trained = load_bc(
        EpisodeStore(request.root), request.spec, request.run_dir("bc"), n_action_steps=request.n_action_steps,
        device=request.device,
    )  # fmt: skip
    return BcPolicy(trained.network, tags={"bc_checkpoint": trained.digest[:DIGITS]})


def _vilp(request: PolicyRequest) -> Policy:
    from vilp_models.policies.vilp import VilpPolicy
    from vilp_models.trained import load_low_level, load_planners

    store = EpisodeStore(request.root)
    planned = load_planners(
        store, request.spec, request.run_dir("planner"), request.run_dir("vqgan"), device=request.device
    )
    low_level = load_low_level(store, request.spec, request.run_dir("policy"), planned.encoders, device=request.device)
    tags = {"policy_checkpoint": low_level.digest[:DIGITS]}
    tags |= {f"planner_checkpoint_{view}": digest[:DIGITS] for view, digest in planned.digests.items()}
    return VilpPolicy(
        planned.planners, planned.encoders, low_level.policy, n_action_steps=request.n_action_steps, tags=tags
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
