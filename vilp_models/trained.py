"""Trained models of a dataset, checked to fit it as it is today, and not to know what they are judged on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from vilp_data.dataset_split import side_episodes
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.keys import ingest_key
from vilp_data.spec import TaskSpec, WindowSpec
from vilp_models.action_labels import SetId, labels_of
from vilp_models.checkpoint import (
    FILE,
    TrainedRun,
    checkpoint_digest,
    load_run,
    read_state,
    refuse_trained_on_validation,
    run_folder,
    run_for_view,
)
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
    """A low-level policy on `device`, ready to act; `digest` names its checkpoint, `action_set` what it learnt from."""

    policy: LowLevelPolicy
    contract: DataContract
    recipe: PolicyRecipe
    digest: str
    action_set: SetId | None = None


@dataclass(frozen=True)
class TrainedBc:
    """A behaviour cloning network on its device, ready to act; `digest` names its checkpoint, `action_set` what it learnt from."""

    network: BcNetwork
    digest: str
    action_set: SetId | None = None


def load_encoders(
    store: EpisodeStore, spec: TaskSpec, vqgan: Path, *, device: str | None = None
) -> dict[str, VqganEncoder]:
    """The VQGAN in `vqgan` of each view of `spec`, on `device` or as `load_frame_encoder` chooses. Raises as that does, and
    SplitError where one knows today's validation episodes."""
    encoders = {view: load_frame_encoder(vqgan, view, device=device) for view in sorted(spec.views)}
    _refuse_seen(store, vqgan, encoders)
    return encoders


def load_planners(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path, vqgan: Path, *, device: str = "cpu"
) -> TrainedPlanners:
    """The planners in `run_dir`, one for each view of `spec`, and the VQGANs in `vqgan`.

    Raises UsageError where one is missing, unfinished, made of another dataset or another VQGAN; SplitError where one knows today's
    validation episodes, StoreError for damage."""
    _refuse_other_task(spec, run_dir, [run_folder(run_dir, (view,)) for view in sorted(spec.views)], "planner")
    encoders = {view: load_frame_encoder(vqgan, view, device=device) for view in sorted(spec.views)}
    planners, digests = {}, {}
    for view in encoders:
        run = run_folder(run_dir, (view,))
        trained = _checked(store, spec, run, "planner", encoders)
        recipe = PlannerRecipe.model_validate(trained.recipe)
        planners[view] = Planner(recipe, trained.contract, view)
        load_arrays(planners[view], trained.arrays)
        planners[view].eval().requires_grad_(False).to(device)
        digests[view] = checkpoint_digest(run)
    _refuse_seen(store, vqgan, encoders)
    return TrainedPlanners(planners, encoders, trained.contract, recipe, digests)


def load_low_level(
    store: EpisodeStore,
    spec: TaskSpec,
    run_dir: Path,
    encoders: Mapping[str, VqganEncoder],
    *,
    action_set: str | None = None,
    device: str = "cpu",
) -> TrainedPolicy:
    """The low-level policy in `run_dir`. Raises as `load_planners`, UsageError where it learnt from another action set than
    `action_set`, and ActionSetError where that does not hold any more."""
    run = run_folder(run_dir, tuple(spec.views))
    _refuse_other_task(spec, run_dir, [run], "policy")
    trained = _checked(store, spec, run, "policy", encoders, action_set)
    recipe = PolicyRecipe.model_validate(trained.recipe)
    policy = LowLevelPolicy(recipe, trained.contract)
    load_arrays(policy, trained.arrays)
    policy.eval().requires_grad_(False).to(device)
    return TrainedPolicy(policy, trained.contract, recipe, checkpoint_digest(run), trained.state.action_set)


def load_bc(
    store: EpisodeStore,
    spec: TaskSpec,
    run_dir: Path,
    *,
    n_action_steps: int,
    action_set: str | None = None,
    device: str = "cpu",
) -> TrainedBc:
    """The behaviour cloning network in `run_dir`, which gives chunks of `n_action_steps`. Raises as `load_low_level`, and UsageError
    where it was trained on chunks of another length."""
    run = run_folder(run_dir, tuple(spec.views))
    _refuse_other_task(spec, run_dir, [run], "bc")
    trained = _checked(store, spec, run, "bc", {}, action_set)
    recipe, learnt = BcRecipe.model_validate(trained.recipe), trained.state.built_by["n_action_steps"]
    if learnt != n_action_steps:
        raise UsageError(
            "this model was trained on chunks of another length than are executed",
            where=run,
            found=f"n_action_steps {learnt} in the model, {n_action_steps} in [models.vilp]",
            remedy=f"set n_action_steps = {learnt} in the task's [models.vilp], or train again: `vilp-models train bc --restart`",
        )
    network = BcNetwork(recipe, trained.contract, learnt)
    load_arrays(network, trained.arrays)
    network.eval().requires_grad_(False).to(device)
    return TrainedBc(network, checkpoint_digest(run), trained.state.action_set)


def default_device() -> str:
    """An accelerator where there is one."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def _key(encoder: VqganEncoder, known: str) -> str:
    """`known`, where this network makes such latents on some kind of device: a policy may act on another than its latents were
    made on, which differ in rounding alone. Else the encoder's own key."""
    return known if known in (encoder.key_on("cpu"), encoder.key_on("cuda")) else encoder.key


def _refuse_seen(store: EpisodeStore, vqgan: Path, views: Iterable[str]) -> None:
    """Raise SplitError where the VQGAN of one of these views was trained on today's validation episodes."""
    val = side_episodes(store, "val")
    for view in views:
        run = run_for_view(vqgan, view)
        state = read_state(run)
        if state is not None:
            refuse_trained_on_validation(state, val, where=run)


def _refuse_other_task(spec: TaskSpec, run_dir: Path, wanted: Sequence[Path], kind: str) -> None:
    """Compare what `spec` alone says with the runs that are wanted, before anything of today's views is read.

    Runs are named after their views: where one is missing, those there are say which views they know. Raises UsageError."""
    all_there = all((run / FILE).is_file() for run in wanted)
    for run in wanted if all_there else sorted(path.parent for path in run_dir.glob(f"*/{FILE}")):
        state = read_state(run)
        if state is not None and state.model == kind and state.contract is not None:
            there = DataContract.from_json(state.contract)
            there.require_same(there.as_said_by(spec), where=run, model=kind)


def _checked(
    store: EpisodeStore,
    spec: TaskSpec,
    run: Path,
    kind: str,
    encoders: Mapping[str, VqganEncoder],
    action_set: str | None = None,
) -> TrainedRun:
    """The run, once its contract was compared with the dataset's under the encoders' latents, its episodes with validation, and its
    action set with the one asked for."""
    trained = load_run(run, kind)
    refuse_trained_on_validation(trained.state, side_episodes(store, "val"), where=run)
    labels = labels_of(store.root, trained.state, action_set, where=run)
    there = trained.contract
    keys = {view: _key(encoders[view], known) for view, known in there.latent_keys.items() if view in encoders}
    # Another VQGAN may not have encoded these episodes, and then there are no latents to take statistics of.
    there.require_same(there.as_said_by(spec, latent_keys=keys), where=run, model=kind)
    known = [entry for entry in store.index() if entry.id in trained.state.train_episodes]
    now = there.now(store.root, spec, known, latent_keys=keys, labels=labels)
    if _some_were_taken_out(known, trained.state.train_episodes):
        # What is left has other statistics, and the model keeps its own.
        now = replace(now, normaliser=there.normaliser)
    there.require_same(now, where=run, model=kind)
    return trained


def _some_were_taken_out(known: Sequence[EpisodeEntry], learnt: Mapping[str, str]) -> bool:
    """Whether training episodes (id -> key) were removed or trimmed since, and the others are those it was trained on."""
    left = {entry.id: entry for entry in known}
    same = all(entry.ingest_key == ingest_key(learnt[id]) for id, entry in left.items())
    return same and any(id not in left or left[id].key != key for id, key in learnt.items())
