"""Trained models of a dataset, checked to fit it as it is today, and not to know what they are judged on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from vilp_data.dataset_split import side_episodes
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.spec import TaskSpec, WindowSpec
from vilp_models.checkpoint import TrainedRun, checkpoint_digest, load_run, refuse_trained_on_validation, run_folder
from vilp_models.contract import DataContract
from vilp_models.low_level import LowLevelPolicy
from vilp_models.planner import Planner
from vilp_models.policies.bc import BcNetwork
from vilp_models.recipe import BcRecipe, PlannerRecipe, PolicyRecipe
from vilp_models.training_state import load_arrays
from vilp_models.vqgan import VqganEncoder, load_frame_encoder


@dataclass(frozen=True)
class TrainedPlanners:
    """A planner for each view on `device`, ready to sample, and the VQGANs of their latents; `digests` name their checkpoints."""

    planners: Mapping[str, Planner]
    encoders: Mapping[str, VqganEncoder]
    contract: DataContract
    recipe: PlannerRecipe
    digests: Mapping[str, str]

    @property
    def window(self) -> WindowSpec:
        """The planned frames they were trained on, which is what they can be asked for."""
        contract = self.contract
        return WindowSpec(n_plan_frames=contract.n_plan_frames, frame_stride=contract.frame_stride)

    @property
    def latent_std(self) -> dict[str, list[float]]:
        """view -> deviation of each latent channel over the training episodes."""
        return {view: list(self.contract.normaliser[f"latents/{view}"]["std"]) for view in self.planners}


@dataclass(frozen=True)
class TrainedPolicy:
    """A low-level policy on `device`, ready to act; `digest` names its checkpoint."""

    policy: LowLevelPolicy
    contract: DataContract
    recipe: PolicyRecipe
    digest: str


@dataclass(frozen=True)
class TrainedBc:
    """A behaviour cloning network on its device, ready to act; `digest` names its checkpoint."""

    network: BcNetwork
    digest: str


def load_planners(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path, vqgan: Path, *, device: str = "cpu"
) -> TrainedPlanners:
    """The planners in `run_dir`, one for each view of `spec`, and the VQGANs in `vqgan`.

    Raises UsageError where one is missing, unfinished, made of another dataset or another VQGAN; SplitError where one knows today's
    validation episodes, StoreError for damage."""
    encoders = {view: load_frame_encoder(vqgan, view) for view in sorted(spec.views)}
    keys = {view: encoder.key for view, encoder in encoders.items()}
    planners, digests = {}, {}
    for view in encoders:
        run = run_folder(run_dir, (view,))
        trained = _checked(store, spec, run, "planner", keys)
        recipe = PlannerRecipe.model_validate(trained.recipe)
        planners[view] = Planner(recipe, trained.contract, view)
        load_arrays(planners[view], trained.arrays)
        planners[view].eval().requires_grad_(False).to(device)
        digests[view] = checkpoint_digest(run)
    return TrainedPlanners(planners, encoders, trained.contract, recipe, digests)


def load_low_level(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path, encoders: Mapping[str, VqganEncoder], *, device: str = "cpu"
) -> TrainedPolicy:
    """The low-level policy in `run_dir`. Raises as `load_planners`."""
    run = run_folder(run_dir, tuple(spec.views))
    trained = _checked(store, spec, run, "policy", {view: encoder.key for view, encoder in encoders.items()})
    recipe = PolicyRecipe.model_validate(trained.recipe)
    policy = LowLevelPolicy(recipe, trained.contract)
    load_arrays(policy, trained.arrays)
    policy.eval().requires_grad_(False).to(device)
    return TrainedPolicy(policy, trained.contract, recipe, checkpoint_digest(run))


def load_bc(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path, *, n_action_steps: int, device: str = "cpu"
) -> TrainedBc:
    """The behaviour cloning network in `run_dir`, which gives chunks of `n_action_steps`. Raises as `load_planners`, and UsageError
    where it was trained on chunks of another length."""
    run = run_folder(run_dir, tuple(spec.views))
    trained = _checked(store, spec, run, "bc", {})
    recipe = BcRecipe.model_validate(trained.recipe)
    n_outputs = len(trained.arrays[f"head.{2 * len(recipe.hidden)}.bias"])
    if n_outputs != n_action_steps * trained.contract.action_size:
        raise UsageError(
            "trained on chunks of another length than are executed",
            where=run,
            found=f"{n_outputs // trained.contract.action_size} actions, models.vilp.n_action_steps = {n_action_steps}",
            remedy="set n_action_steps to that in the task TOML, or train again: `vilp-models train bc --restart`",
        )
    network = BcNetwork(recipe, trained.contract, n_action_steps)
    load_arrays(network, trained.arrays)
    network.eval().requires_grad_(False).to(device)
    return TrainedBc(network, checkpoint_digest(run))


def default_device() -> str:
    """An accelerator where there is one."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def _checked(store: EpisodeStore, spec: TaskSpec, run: Path, kind: str, latent_keys: Mapping[str, str]) -> TrainedRun:
    """The run, once its contract was compared with the dataset's under `latent_keys`, and its episodes with validation."""
    trained = load_run(run, kind)
    refuse_trained_on_validation(trained.state, side_episodes(store, "val"), where=run)
    there = trained.contract
    known = [entry for entry in store.index() if entry.id in trained.state.train_episodes]
    now = DataContract.of(
        store.root,
        spec,
        train=known,
        latent_keys={view: key for view, key in latent_keys.items() if view in there.latent_keys},
        plans=bool(there.n_plan_frames),
        low_dim=bool(there.low_dim),
        action=bool(there.action),
    )
    there.require_same(now, where=run, model=kind)
    return trained
