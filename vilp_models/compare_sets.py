"""Do other labels help? VILP, the oracle and BC trained on several action sets, each with several seeds, from the same starts.

    DATA/runs/policy-PRESET-SET-seedK, bc-PRESET-SET-seedK     what is trained
    DATA/comparisons/PRESET-SET+SET-SEEDS-xN/POLICY-SET-seedK  a rollout each (oracle-firstN: of N episodes)
    DATA/comparisons/PRESET-SET+SET-SEEDS-xN/stay, stay-val    the policy that learns from nothing, from the same starts
    DATA/comparisons/PRESET-SET+SET-SEEDS-xN/report.json, report.md
                                                               all of it, side by side; N training seeds

The planner is one and the same for all: it learns from video alone. What is done already, and was made of what is there today, is kept,
so that a comparison goes on where it stopped, and one of other starts or policies takes nothing away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vilp_data.action_set_lock import DIGITS, ActionSetLock
from vilp_data.dataset_action_sets import read_action_set
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, VilpDataError, nearest
from vilp_data.spec import SimSpec, TaskSpec
from vilp_models.checkpoint import read_state, run_folder
from vilp_models.compare_sets_report import COMPARED, SetsReport
from vilp_models.evaluate import evaluate_policy
from vilp_models.policies.base import Policy
from vilp_models.policies.load import FOLLOWS_RECORDINGS, PolicyRequest, load_policy
from vilp_models.recipe import BcRecipe, PolicyRecipe, VilpRecipe, load_recipe
from vilp_models.rollout import Progress
from vilp_models.rollout_folder import find_rollout
from vilp_models.rollout_report import roll_out_into
from vilp_models.runs import default_run, find_model_run
from vilp_models.simulator import Worlds, require_simulator
from vilp_models.starts import Recording, Start, episode_starts, parse_seeds, starts_digest, unseen_starts
from vilp_models.train import train_bc, train_policy
from vilp_models.trained import default_device

Told = Callable[[str], None]

Bar = Callable[[str, int], AbstractContextManager[Progress | None]]
"""(label, steps in all) -> what hears how many are done."""

IMAGINES_OR_FOLLOWS = frozenset({"vilp", "oracle"})
"""Policies that act by the low-level policy."""


def no_bar(label: str, total: int) -> AbstractContextManager[Progress | None]:
    return nullcontext()


@dataclass(frozen=True)
class SetsComparison:
    """What is compared with what: `policies` of COMPARED, each with `n_seeds` training seeds on every one of `sets`, whose first is what
    the others are measured against.

    seeds         the simulator's starts of VILP and BC, as `parse_seeds` reads them; the oracle begins at held-out episodes of the task's
                  own world, `n_oracle` of them at most
    environments  that are planned for together
    restart       train anew what is there of another recipe or dataset, instead of refusing
    """

    root: Path
    spec: TaskSpec
    preset: str | None
    sets: tuple[str, ...]
    policies: tuple[str, ...] = COMPARED
    n_seeds: int = 3
    seeds: str = "0:50"
    n_oracle: int | None = None
    environments: int = 50
    vqgan: Path | None = None
    restart: bool = False

    def __post_init__(self) -> None:
        if len(self.sets) < 2 or len(set(self.sets)) < len(self.sets):
            raise UsageError(
                "a comparison needs two action sets, none of them twice",
                found=", ".join(self.sets),
                remedy="--sets small,hybrid",
            )
        if not self.policies:
            raise UsageError("no policy to compare", remedy=f"--policies {','.join(COMPARED)}")
        for policy in self.policies:
            if policy not in COMPARED:
                raise UsageError(f"{policy!r} learns from no action set", remedy=nearest(policy, COMPARED))

    @property
    def folder(self) -> Path:
        """Where rollouts and report go."""
        parts = [self.preset or "default", "+".join(self.sets), self.seeds.replace(":", "-"), f"x{self.n_seeds}"]
        return self.root / "comparisons" / "-".join(parts)

    def run(self, kind: str, action_set: str, seed: int) -> Path:
        """Where "policy" or "bc" is trained."""
        run = default_run(self.root, kind, self.preset, action_set)
        return run.with_name(f"{run.name}-seed{seed}")


@dataclass(frozen=True)
class _Planned:
    """A rollout as it is to be: of this policy, from these starts (`what` they are, in a word) in this simulator."""

    folder: Path
    name: str
    acting: Policy
    starts: Sequence[Start]
    what: str
    sim: SimSpec

    def found(self) -> dict[str, Any] | None:
        """The report.json of the one that is there; None where there is none, or it is another."""
        there = find_rollout(self.folder)
        if there is None:
            return None
        wanted = {
            "tags": dict(self.acting.tags),
            "n_action_steps": self.acting.n_action_steps,
            "starts_sha256": starts_digest(self.sim, self.starts),
            "max_steps": self.sim.max_steps,
        }
        return there if all(there.get(name) == value for name, value in wanted.items()) else None


def compare_sets(comparison: SetsComparison, tell: Told, bar: Bar = no_bar) -> tuple[dict[str, Any], SetsReport]:
    """Train, judge and roll out whatever is not done yet, then write the report; it as plain data, and as it is shown. It covers the
    policies that were rolled out here before, too, while their rollouts are of today's models.

    `tell` hears a line before each piece of work, `bar` shows a rollout's steps. What a user named is proved before the first training.
    Raises what `read_action_set`, training, `evaluate_policy`, `load_policy` and `roll_out_into` raise."""
    locks = _require_ready(comparison)
    asked = [policy for policy in COMPARED if policy in comparison.policies]
    errors: dict[tuple[str, int], dict[str, Any]] = {}
    rollouts: dict[tuple[str, str, int], dict[str, Any]] = {}
    models = [(action_set, seed) for seed in range(comparison.n_seeds) for action_set in comparison.sets]
    for action_set, seed in models:
        if IMAGINES_OR_FOLLOWS & set(asked):
            errors[action_set, seed] = _low_level(comparison, action_set, seed, tell)
        if "bc" in asked:
            _train_bc(comparison, action_set, seed, tell)
    for seed in range(comparison.n_seeds):
        for policy in asked:
            for action_set in comparison.sets:
                rollouts[policy, action_set, seed] = _rollout(comparison, policy, action_set, seed, tell, bar)
    for policy in COMPARED:
        if policy not in asked:
            rollouts |= _from_before(comparison, policy, tell)
    shown = {policy for policy, _, _ in rollouts}
    if not errors and IMAGINES_OR_FOLLOWS & shown:
        errors = {model: _held_out(comparison, *model) for model in models}
    stays = [
        _rolled_out(_staying(comparison, follows), comparison, "stay", tell, bar)
        for follows in (False, True)
        if any((policy in FOLLOWS_RECORDINGS) == follows for policy in shown)
    ]
    report = SetsReport(
        comparison.spec.name, comparison.sets, comparison.n_seeds, errors, rollouts,
        dataset=str(comparison.root), preset=comparison.preset, locks=locks, stays=stays,
    )  # fmt: skip
    return report.write(comparison.folder), report


def _require_ready(comparison: SetsComparison) -> dict[str, ActionSetLock]:
    """The lock of each set. Raises where one does not hold, where what is trained before the comparison is not there, where the seeds
    are none, and where the task has no simulator."""
    for follows in {policy in FOLLOWS_RECORDINGS for policy in comparison.policies}:
        _starts(comparison, follows)
    locks = {action_set: read_action_set(comparison.root, action_set).lock for action_set in comparison.sets}
    if IMAGINES_OR_FOLLOWS & set(comparison.policies):
        _vqgan(comparison)
    if "vilp" in comparison.policies:
        find_model_run(comparison.root, "planner", preset=comparison.preset, option="--preset")
    return locks


def _low_level(comparison: SetsComparison, action_set: str, seed: int, tell: Told) -> dict[str, Any]:
    """Train a low-level policy; its report on held-out episodes."""
    root, spec = comparison.root, _with_seed(comparison.spec, "policy", seed)
    recipe = load_recipe(PolicyRecipe, "policy", spec.models, preset=comparison.preset, where=spec.name)
    run, vqgan = comparison.run("policy", action_set, seed), _vqgan(comparison)
    tell(f"low-level policy, {action_set}, seed {seed}")

    def train(restart: bool) -> None:
        train_policy(root, spec, recipe, run, vqgan=vqgan, action_set=action_set, restart=restart)

    _train(comparison, run, action_set, train, tell)
    return _held_out(comparison, action_set, seed)


def _held_out(comparison: SetsComparison, action_set: str, seed: int) -> dict[str, Any]:
    run, spec = comparison.run("policy", action_set, seed), _with_seed(comparison.spec, "policy", seed)
    return evaluate_policy(comparison.root, spec, run, _vqgan(comparison), action_set=action_set)[0]


def _train_bc(comparison: SetsComparison, action_set: str, seed: int, tell: Told) -> None:
    spec = _with_seed(comparison.spec, "bc", seed)
    recipe = load_recipe(BcRecipe, "bc", spec.models, preset=comparison.preset, where=spec.name)
    run, n_steps = comparison.run("bc", action_set, seed), _n_action_steps(comparison)
    tell(f"bc, {action_set}, seed {seed}")

    def train(restart: bool) -> None:
        train_bc(comparison.root, spec, recipe, run, n_action_steps=n_steps, action_set=action_set, restart=restart)

    _train(comparison, run, action_set, train, tell)


def _train(comparison: SetsComparison, run: Path, action_set: str, train: Callable[[bool], None], tell: Told) -> None:
    """`train(restart)`: begun anew where the run that is there can serve nobody, or where the user lets what does not fit go."""
    try:
        train(_is_of_another_version(comparison, run, action_set, tell))
    except UsageError as refused:
        if not comparison.restart:
            raise
        tell(f"{run.name} is trained anew: {refused.what}")
        train(True)


def _is_of_another_version(comparison: SetsComparison, run: Path, action_set: str, tell: Told) -> bool:
    """Whether this run, which is the comparison's own, learnt from the set of this name before it was drawn anew: it can serve nobody
    any more."""
    state = read_state(run_folder(run, sorted(comparison.spec.views)))
    there = None if state is None else state.action_set
    now = read_action_set(comparison.root, action_set).key
    if there is None or there["name"] != action_set or there["key"] == now:
        return False
    keys = f"{there['key'][:DIGITS]} then, {now[:DIGITS]} now"
    tell(f"{run.name} learnt from another version of {action_set} ({keys}): it is trained anew")
    return True


def _rollout(
    comparison: SetsComparison, policy: str, action_set: str, seed: int, tell: Told, bar: Bar = no_bar
) -> dict[str, Any]:
    """The rollout's report.json: the one that is there, if it is of these models, these starts and this length."""
    planned = _planned(comparison, policy, action_set, seed)
    return _rolled_out(planned, comparison, f"{policy}, {action_set}, seed {seed}", tell, bar)


def _rolled_out(planned: _Planned, comparison: SetsComparison, label: str, tell: Told, bar: Bar) -> dict[str, Any]:
    if (there := planned.found()) is None:
        tell(f"rolling out {label}")
        with bar(label, len(planned.starts) * planned.sim.max_steps) as progress:
            roll_out_into(
                planned.folder, comparison.spec, planned.acting, planned.starts, name=planned.name, what=planned.what,
                max_steps=planned.sim.max_steps, environments=comparison.environments, with_logs=False, progress=progress,
            )  # fmt: skip
        there = find_rollout(planned.folder)
        assert there is not None
    return there


def _from_before(comparison: SetsComparison, policy: str, tell: Told) -> dict[tuple[str, str, int], dict[str, Any]]:
    """The rollouts of a policy that was not asked for now, where those of all its models are there and still of today; else none."""
    models = [(action_set, seed) for seed in range(comparison.n_seeds) for action_set in comparison.sets]
    if any(find_rollout(_folder(comparison, policy, *model)) is None for model in models):
        return {}
    rollouts = {}
    for model in models:
        try:
            there = _planned(comparison, policy, *model).found()
        except VilpDataError:  # its models are not there any more, or fit nothing of today
            there = None
        if there is None:
            tell(f"{policy} is left out of the report: its rollouts here are of other models or starts than today's")
            return {}
        rollouts[(policy, *model)] = there
    return rollouts


def _folder(comparison: SetsComparison, policy: str, action_set: str, seed: int) -> Path:
    few = _few(comparison) if policy in FOLLOWS_RECORDINGS else ""
    return comparison.folder / f"{policy}{few}-{action_set}-seed{seed}"


def _planned(comparison: SetsComparison, policy: str, action_set: str, seed: int) -> _Planned:
    starts, recordings, what = _starts(comparison, policy in FOLLOWS_RECORDINGS)
    kind = "bc" if policy == "bc" else "policy"
    request = PolicyRequest(
        comparison.root, comparison.spec, comparison.preset, _n_action_steps(comparison), device=default_device(),
        recordings=recordings, vqgan=comparison.vqgan, action_set=action_set,
        runs={kind: comparison.run(kind, action_set, seed)},
    )  # fmt: skip
    folder, sim = _folder(comparison, policy, action_set, seed), require_simulator(comparison.spec)
    return _Planned(folder, policy, load_policy(policy, request), starts, what, sim)


def _staying(comparison: SetsComparison, follows: bool) -> _Planned:
    """The policy that does nothing: what is to be beaten from the simulator's starts, or from those of policies that follow
    recordings."""
    starts, _, what = _starts(comparison, follows)
    request = PolicyRequest(comparison.root, comparison.spec, comparison.preset, _n_action_steps(comparison))
    folder = comparison.folder / (f"stay-{what}{_few(comparison)}" if follows else "stay")
    return _Planned(folder, "stay", load_policy("stay", request), starts, what, require_simulator(comparison.spec))


def _few(comparison: SetsComparison) -> str:
    """Part of the name of what follows fewer recordings than there are."""
    return f"-first{comparison.n_oracle}" if comparison.n_oracle else ""


def _starts(comparison: SetsComparison, follows: bool) -> tuple[list[Start], dict[int, Recording], str]:
    """Those of policies that follow recordings, with these, or the simulator's; and which they are, in a word."""
    require_simulator(comparison.spec)
    if not follows:
        starts = unseen_starts(EpisodeStore(comparison.root), comparison.spec, parse_seeds(comparison.seeds))
        return starts, {}, comparison.seeds
    world = Worlds(comparison.spec, cameras=False)
    own = world.own_tags()
    world.close()
    starts, recordings = episode_starts(EpisodeStore(comparison.root), "val", limit=comparison.n_oracle, world=own)
    return starts, recordings, "val"


def _with_seed(spec: TaskSpec, model: str, seed: int) -> TaskSpec:
    models = {**spec.models, model: {**spec.models.get(model, {}), "seed": seed}}
    return spec.model_copy(update={"models": models})


def _vqgan(comparison: SetsComparison) -> Path:
    return find_model_run(comparison.root, "vqgan", given=comparison.vqgan, preset=comparison.preset, option="--vqgan")


def _n_action_steps(comparison: SetsComparison) -> int:
    spec = comparison.spec
    return load_recipe(VilpRecipe, "vilp", spec.models, preset=comparison.preset, where=spec.name).n_action_steps
