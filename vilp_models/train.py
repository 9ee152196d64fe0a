"""Which runs a model has, what each learns from, and whether it is to be trained, to go on, or to be left alone."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError

from vilp_data.dataset import WindowDataset
from vilp_data.dataset_action_sets import read_action_set
from vilp_data.dataset_split import read_split, side_episodes
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import BusyError, NoWindowError, UsageError, VilpDataError, nearest
from vilp_data.labelled_episodes import LabelledEpisodes
from vilp_data.pairs import PairDataset
from vilp_data.spec import TaskSpec, WindowSpec
from vilp_data.writer_lock import remove_leftovers, writer_lock
from vilp_models.action_labels import SetId, epochs_text, require_same_set, set_id
from vilp_models.checkpoint import RunState, read_recipe, read_state, run_folder
from vilp_models.contract import ContractOf, DataContract
from vilp_models.frames import TrainingFrames, open_clips
from vilp_models.model_training import Clips, ModelTraining
from vilp_models.processes import Processes
from vilp_models.recipe import BcRecipe, PlannerRecipe, PolicyRecipe, TrainingRecipe, VqganRecipe
from vilp_models.reconstructions import Reconstructions
from vilp_models.training_loop import Trainee, fit
from vilp_models.vqgan import VqganEncoder
from vilp_models.vqgan_training import VqganTraining


@dataclass(frozen=True)
class Run:
    """One run of one model.

    model     its kind, as in `RunState.model`
    views     the views it is named after
    folder    where its checkpoint lies
    recipe    what it is trained by
    trainee   makes what the loop trains; called only when there is something to train
    contract  of the dataset, with statistics over these episodes; None for a model that depends on frames alone
    built_by  what decides the network besides recipe and contract; as in `RunState.built_by`
    unit      what its batches hold
    action_set
              whose episodes alone it learns from; None for all that serve
    """

    model: str
    views: tuple[str, ...]
    folder: Path
    recipe: VqganRecipe | TrainingRecipe
    trainee: Callable[[Processes, DataContract | None], Trainee]
    contract: ContractOf | None = None
    built_by: Mapping[str, int] = field(default_factory=dict)
    unit: str = "samples"
    action_set: SetId | None = None

    @property
    def label(self) -> str:
        return f"{self.model} {'+'.join(self.views)}"


# --- the models ------------------------------------------------------------------------------------------------------


def train_vqgan(
    dataset_dir: Path,
    spec: TaskSpec,
    recipe: VqganRecipe,
    run_dir: Path,
    *,
    train_episodes: Sequence[str],
    split_hash: str,
    restart: bool = False,
    device: str | None = None,
    show: bool = True,
) -> list[RunState]:
    """Train one VQGAN a view, or where the recipe shares it one for all views of pictures and one for all of depth, on frames of
    `train_episodes` alone.

    Returns where each run ended; see `_bring_to_end` for what is left alone and what is refused.
    """
    _require_views(spec, dataset_dir)
    store = EpisodeStore(dataset_dir)
    entries = {entry.id: entry for entry in store.index()}
    for episode in train_episodes:
        if episode not in entries:
            raise UsageError(f"no episode called {episode!r}", where=dataset_dir, remedy=nearest(episode, entries))
    episodes = [entries[episode] for episode in sorted(train_episodes)]

    def run_of(views: tuple[str, ...]) -> Run:
        def trainee(processes: Processes, _: DataContract | None) -> Trainee:
            clips = open_clips(store, episodes, views)
            frames = TrainingFrames(clips, crop=recipe.crop, crop_moving=recipe.crop_moving)
            return VqganTraining(recipe, frames, processes)

        return Run("vqgan", views, run_folder(run_dir, views), recipe, trainee, unit="images")

    groups = _sharing(spec) if recipe.share_views else [(view,) for view in sorted(spec.views)]
    runs = [run_of(views) for views in groups]
    processes = Processes(recipe.precision, device=device)
    return _bring_all_to_end(runs, episodes, split_hash, processes, restart=restart, show=show)


def _require_views(spec: TaskSpec, dataset_dir: Path) -> None:
    if not spec.views:
        remedy = "record a camera, or train what needs none: `vilp-models train bc`"
        raise UsageError("the dataset has no views, so there is nothing to imagine", where=dataset_dir, remedy=remedy)


def _sharing(spec: TaskSpec) -> list[tuple[str, ...]]:
    """The views that may share a VQGAN: those whose frames have equally many channels, pictures first."""
    channels = {view: spec.views[view].channels for view in sorted(spec.views)}
    return [tuple(view for view, c in channels.items() if c == n) for n in sorted(set(channels.values()), reverse=True)]


def train_planner(
    dataset_dir: Path,
    spec: TaskSpec,
    recipe: PlannerRecipe,
    run_dir: Path,
    *,
    vqgan: Path,
    restart: bool = False,
    device: str | None = None,
    show: bool = True,
) -> list[RunState]:
    """Train one planner a view on latents that the VQGAN run `vqgan` made, over windows of `spec.window`.

    Returns and raises as `train_vqgan`; StoreError where latents are missing, SplitError where the VQGAN knows today's
    validation episodes."""
    from vilp_models.planner import Planner
    from vilp_models.planner_clips import planner_clips

    _require_views(spec, dataset_dir)
    episodes, split_hash = _training_side(dataset_dir)
    processes = Processes(recipe.precision, device=device)
    encoders = _encoders(dataset_dir, spec, vqgan, processes)
    keys = {view: encoder.key for view, encoder in encoders.items()}

    def contract(train: Sequence[EpisodeEntry]) -> DataContract:
        return DataContract.of(dataset_dir, spec, train=train, latent_keys=keys, low_dim=recipe.low_dim, action=False)

    def windows(split: Any) -> WindowDataset:
        return WindowDataset(dataset_dir, split=split, latent_keys=keys, window=spec.window, with_actions=False)

    def run_of(view: str) -> Run:
        def trainee(processes: Processes, agreed: DataContract | None) -> Trainee:
            assert agreed is not None
            clips: Callable[[torch.nn.Module], Clips] | None = None
            try:
                clips = planner_clips(windows("val"), view, encoders[view], device=processes.device)
            except NoWindowError:  # training can do without pictures
                if show and processes.is_main:
                    print(f"planner {view}: no window fits the validation episodes, so no clips are drawn of them")
            return ModelTraining(
                recipe, lambda: Planner(recipe, agreed, view), windows("train"), processes, clips=clips
            )

        return Run("planner", (view,), run_folder(run_dir, (view,)), recipe, trainee, contract, unit="clips")

    runs = [run_of(view) for view in sorted(spec.views)]
    return _bring_all_to_end(runs, episodes, split_hash, processes, restart=restart, show=show)


def train_policy(
    dataset_dir: Path,
    spec: TaskSpec,
    recipe: PolicyRecipe,
    run_dir: Path,
    *,
    vqgan: Path | None = None,
    action_set: str | None = None,
    restart: bool = False,
    device: str | None = None,
    show: bool = True,
) -> list[RunState]:
    """Train the low-level policy of all views together, on pairs of frames (or of latents) of the episodes with actions; with an
    `action_set` of those in it alone.

    `vqgan` is the run whose latents it sees, or whose reconstructions it sees some of; other recipes need none. Returns and
    raises as `train_planner`, and ActionSetError where the set does not hold."""
    from vilp_models.low_level import LowLevelPolicy

    _require_views(spec, dataset_dir)
    labels = None if action_set is None else read_action_set(dataset_dir, action_set)
    episodes, split_hash = _training_side(dataset_dir, acting=True, labels=labels)
    processes = Processes(recipe.precision, device=device)
    encoders = {}
    if recipe.sees == "latents" or recipe.reconstructed_share:
        if vqgan is None:
            raise UsageError("this policy's recipe needs a VQGAN", where=run_dir, remedy="name its run with --vqgan")
        encoders = _encoders(dataset_dir, spec, vqgan, processes)
    keys = {view: encoder.key for view, encoder in encoders.items()}
    views = tuple(sorted(spec.views))

    def contract(train: Sequence[EpisodeEntry]) -> DataContract:
        return DataContract.of(
            dataset_dir, spec, train=train, latent_keys=keys, plans=False, low_dim=recipe.low_dim, labels=labels
        )

    def trainee(processes: Processes, agreed: DataContract | None) -> Trainee:
        assert agreed is not None
        pairs = PairDataset(
            dataset_dir,
            split="train",
            frame_stride=spec.window.frame_stride,
            latent_keys=keys,
            with_frames=recipe.sees == "frames",
            labels=labels,
        )
        if labels is not None and show and processes.is_main:
            print(f"policy {epochs_text(labels, pairs, recipe)}")
        codebooks = {view: encoder.model.quantize.embedding.weight.detach() for view, encoder in encoders.items()}
        reconstruct = Reconstructions(encoders)
        return ModelTraining(
            recipe,
            lambda: LowLevelPolicy(recipe, agreed, codebooks=codebooks, reconstruct=reconstruct),
            pairs,
            processes,
        )

    folder = run_folder(run_dir, views)
    run = Run("policy", views, folder, recipe, trainee, contract, unit="pairs", action_set=set_id(labels))
    return _bring_all_to_end([run], episodes, split_hash, processes, restart=restart, show=show)


def train_bc(
    dataset_dir: Path,
    spec: TaskSpec,
    recipe: BcRecipe,
    run_dir: Path,
    *,
    n_action_steps: int,
    action_set: str | None = None,
    restart: bool = False,
    device: str | None = None,
    show: bool = True,
) -> list[RunState]:
    """Train behaviour cloning of all views together: one observation to the next `n_action_steps` actions.

    Only episodes with actions are read, with an `action_set` those in it alone, from every step that has one: windows are as long
    as a chunk, whatever the planner's are, and a chunk that reaches past the end is learnt as far as it was recorded. Returns and
    raises as `train_policy`."""
    from vilp_models.policies.bc import BcNetwork

    labels = None if action_set is None else read_action_set(dataset_dir, action_set)
    episodes, split_hash = _training_side(dataset_dir, acting=True, labels=labels)
    views, stride = tuple(sorted(spec.views)), spec.window.frame_stride
    n_frames = -(-n_action_steps // stride)
    chunk = WindowSpec(n_plan_frames=n_frames, frame_stride=stride, max_goal_frames=n_frames)

    def contract(train: Sequence[EpisodeEntry]) -> DataContract:
        return DataContract.of(dataset_dir, spec, train=train, plans=False, low_dim=recipe.low_dim, labels=labels)

    def trainee(processes: Processes, agreed: DataContract | None) -> Trainee:
        assert agreed is not None
        windows = WindowDataset(
            dataset_dir, split="train", latent_keys={}, views=views, window=chunk, acting=True, labels=labels
        )
        if labels is not None and show and processes.is_main:
            print(f"bc {epochs_text(labels, windows, recipe)}")
        return ModelTraining(recipe, lambda: BcNetwork(recipe, agreed, n_action_steps), windows, processes)

    run = Run(
        "bc", views, run_folder(run_dir, views), recipe, trainee, contract, {"n_action_steps": n_action_steps},
        unit="windows", action_set=set_id(labels),
    )  # fmt: skip
    processes = Processes(recipe.precision, device=device)
    return _bring_all_to_end([run], episodes, split_hash, processes, restart=restart, show=show)


def _training_side(
    dataset_dir: Path, *, acting: bool = False, labels: LabelledEpisodes | None = None
) -> tuple[list[EpisodeEntry], str]:
    """Today's training episodes, those with actions where only they serve, those of an action set where one is named; and the
    split's hash."""
    store = EpisodeStore(dataset_dir)
    episodes = [entry for entry in side_episodes(store, "train") if entry.has_action or not acting]
    return episodes if labels is None else labels.entries, read_split(dataset_dir).hash


def _encoders(dataset_dir: Path, spec: TaskSpec, vqgan: Path, processes: Processes) -> dict[str, VqganEncoder]:
    """Each view's VQGAN where this process computes; on its own kind of device otherwise, which the latents' key names."""
    from vilp_models.trained import default_device, load_encoders

    here = str(processes.device) if processes.device.type == default_device() else None
    return load_encoders(EpisodeStore(dataset_dir), spec, vqgan, device=here)


# --- runs ------------------------------------------------------------------------------------------------------------


def _bring_all_to_end(
    runs: Sequence[Run],
    episodes: Sequence[EpisodeEntry],
    split_hash: str,
    processes: Processes,
    *,
    restart: bool,
    show: bool,
) -> list[RunState]:
    states = [_bring_to_end(run, episodes, split_hash, processes, restart=restart, show=show) for run in runs]
    processes.end()
    return states


def _bring_to_end(
    run: Run,
    episodes: Sequence[EpisodeEntry],
    split_hash: str,
    processes: Processes,
    *,
    restart: bool,
    show: bool,
) -> RunState:
    """Train one run to its last step, on these training episodes.

    A finished run with this recipe and contract is left alone; an unfinished one goes on exactly where it stopped. Raises
    UsageError where the run there has another recipe, action set or contract, or is unfinished and has other episodes (`restart`
    begins those anew, and leaves what is there until its own first checkpoint replaces it), BusyError where another process
    trains into it, DivergedError where a loss stops being finite, KeyboardInterrupt on Ctrl-C, saved.
    """
    with _only_trainer(run.folder, processes):
        table = run.recipe.model_dump(mode="json")
        wanted = RunState(
            step=0,
            steps=run.recipe.steps,
            views=run.views,
            split_hash=split_hash,
            train_episodes={entry.id: entry.key for entry in episodes},
            model=run.model,
            built_by=run.built_by,
            action_set=run.action_set,
        )
        earlier = None if restart else read_state(run.folder)
        if earlier is not None and not _must_train(run, table, wanted, earlier, episodes):
            if show and processes.is_main:
                print(f"{run.label}: trained already, {earlier.steps} steps{_unseen(earlier, wanted)}")
            return earlier
        contract = None if run.contract is None else run.contract(episodes)
        if contract is not None:
            wanted = replace(wanted, contract=contract.to_json())
        trainee = run.trainee(processes, contract)
        return fit(
            trainee, run.folder, wanted, table, processes,
            unit=run.unit, per_step=run.recipe.batch_size, resume=not restart, show=show,
        )  # fmt: skip


@contextlib.contextmanager
def _only_trainer(run: Path, processes: Processes) -> Iterator[None]:
    """Be the only ones who train into this run; the main process holds the lock. Raises BusyError at once where another does, in
    every process: one that went on would wait for the main one for ever."""
    with contextlib.ExitStack() as stack:
        refused: VilpDataError | None = None
        if processes.is_main:
            try:
                stack.enter_context(writer_lock(run))
                remove_leftovers(run)
            except VilpDataError as error:
                refused = error
        if processes.any(refused is not None):
            if refused is not None and not isinstance(refused, BusyError):
                raise refused
            raise BusyError(
                "another process is training this run", where=run, remedy="wait until it is done, or stop it"
            ) from refused
        yield


def _must_train(
    run: Run, recipe: Mapping[str, Any], wanted: RunState, earlier: RunState, episodes: Sequence[EpisodeEntry]
) -> bool:
    """Whether the run in this folder is to go on (True) or is there (False); UsageError where it is another run."""
    old, recipe = {**_as_of_today(run), **earlier.built_by}, {**recipe, **wanted.built_by}
    changed = sorted(key for key in {*recipe, *old} if recipe.get(key) != old.get(key))
    remedy = "train again with --restart, or into another folder"
    if earlier.model != wanted.model:
        found = f"{earlier.model} there, {wanted.model} now"
        raise UsageError("this folder holds a run of another model", where=run.folder, found=found, remedy=remedy)
    require_same_set(earlier, wanted.action_set, where=run.folder)
    if changed:
        found = ", ".join(f"{key} = {old.get(key)!r} there, {recipe.get(key)!r} now" for key in changed)
        raise UsageError("this run was trained with another recipe", where=run.folder, found=found, remedy=remedy)
    gone = sorted(
        episode for episode, key in earlier.train_episodes.items() if wanted.train_episodes.get(episode) != key
    )
    if gone:
        raise UsageError(
            f"{len(gone)} episodes this run was trained on changed, or are no training episodes today",
            where=run.folder,
            found=", ".join(gone[:5]) + (", …" if len(gone) > 5 else ""),
            remedy=remedy,
        )
    if not earlier.finished and earlier.training_set != wanted.training_set:
        raise UsageError(
            "this run is unfinished, and training episodes were added since", where=run.folder, remedy=remedy
        )
    if run.contract is not None and earlier.contract is not None:
        now = run.contract([entry for entry in episodes if entry.id in earlier.train_episodes])
        DataContract.from_json(earlier.contract).require_same(now, where=run.folder, model=run.model)
    return not earlier.finished


def _as_of_today(run: Run) -> dict[str, Any]:
    """The recipe that the run in this folder was trained with; a key that came later has its default, which is how it was."""
    stored = read_recipe(run.folder)
    try:
        return type(run.recipe).model_validate(stored).model_dump(mode="json")
    except ValidationError:  # keys or values of then that are none today
        return stored


def _unseen(earlier: RunState, wanted: RunState) -> str:
    count = len(wanted.train_episodes.keys() - earlier.train_episodes.keys())
    return f"; {count} training episodes came later and were not seen" if count else ""
