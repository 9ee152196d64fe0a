"""Do other labels help? VILP, the oracle and BC trained on several action sets, each with several seeds, from the same starts.

    DATA/runs/policy-PRESET-SET-seedK, bc-PRESET-SET-seedK     what is trained
    DATA/comparisons/PRESET-SET-SET/POLICY-SET-seedK           a rollout each
    DATA/comparisons/PRESET-SET-SET/report.json, report.md     all of it, side by side

The planner is one and the same for all: it learns from video alone. What is done already, and was made of what is there today, is kept,
so that a comparison goes on where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, nearest
from vilp_data.spec import TaskSpec
from vilp_models.compare_sets_report import COMPARED, SetsReport
from vilp_models.evaluate import evaluate_policy
from vilp_models.policies.load import FOLLOWS_RECORDINGS, PolicyRequest, load_policy
from vilp_models.recipe import BcRecipe, PolicyRecipe, VilpRecipe, load_recipe
from vilp_models.rollout_folder import find_rollout
from vilp_models.rollout_report import roll_out_into
from vilp_models.runs import default_run, find_model_run
from vilp_models.simulator import Worlds, require_simulator
from vilp_models.starts import Recording, Start, episode_starts, parse_seeds, seed_starts
from vilp_models.train import train_bc, train_policy
from vilp_models.trained import default_device

Told = Callable[[str], None]


@dataclass(frozen=True)
class SetsComparison:
    """What is compared with what: `policies` of COMPARED, each with `n_seeds` training seeds on every one of `sets`, whose first is what
    the others are measured against.

    seeds         the simulator's starts of VILP and BC, as `parse_seeds` reads them; the oracle begins at held-out episodes of the task's
                  own world, `n_oracle` of them at most
    environments  that are planned for together
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

    def __post_init__(self) -> None:
        if len(set(self.sets)) < 2:
            raise UsageError(
                "a comparison needs two action sets", found=", ".join(self.sets), remedy="--sets small,hybrid"
            )
        for policy in self.policies:
            if policy not in COMPARED:
                raise UsageError(f"{policy!r} learns from no action set", remedy=nearest(policy, COMPARED))

    @property
    def folder(self) -> Path:
        """Where rollouts and report go."""
        return self.root / "comparisons" / "-".join([self.preset or "default", *self.sets])

    def run(self, kind: str, action_set: str, seed: int) -> Path:
        """Where "policy" or "bc" is trained."""
        run = default_run(self.root, kind, self.preset, action_set)
        return run.with_name(f"{run.name}-seed{seed}")


def compare_sets(comparison: SetsComparison, tell: Told) -> tuple[dict[str, Any], SetsReport]:
    """Train, judge and roll out whatever is not done yet, then write the report; it as plain data, and as it is shown.

    `tell` hears a line before each piece of work. Raises what training, `evaluate_policy`, `load_policy` and `roll_out_into` raise."""
    require_simulator(comparison.spec)
    needs_policy = {"vilp", "oracle"} & set(comparison.policies)
    errors: dict[tuple[str, int], dict[str, Any]] = {}
    rollouts: dict[tuple[str, str, int], dict[str, Any]] = {}
    for seed in range(comparison.n_seeds):
        for action_set in comparison.sets:
            if needs_policy:
                errors[action_set, seed] = _low_level(comparison, action_set, seed, tell)
            if "bc" in comparison.policies:
                _train_bc(comparison, action_set, seed, tell)
    for seed in range(comparison.n_seeds):
        for policy in comparison.policies:
            for action_set in comparison.sets:
                rollouts[policy, action_set, seed] = _rollout(comparison, policy, action_set, seed, tell)
    report = SetsReport(comparison.spec.name, comparison.sets, comparison.n_seeds, errors, rollouts)
    return report.write(comparison.folder), report


def _low_level(comparison: SetsComparison, action_set: str, seed: int, tell: Told) -> dict[str, Any]:
    """Train a low-level policy; its report on held-out episodes."""
    root, spec = comparison.root, _with_seed(comparison.spec, "policy", seed)
    recipe = load_recipe(PolicyRecipe, "policy", spec.models, preset=comparison.preset, where=spec.name)
    run, vqgan = comparison.run("policy", action_set, seed), _vqgan(comparison)
    tell(f"low-level policy, {action_set}, seed {seed}")
    train_policy(root, spec, recipe, run, vqgan=vqgan, action_set=action_set)
    return evaluate_policy(root, spec, run, vqgan, action_set=action_set)[0]


def _train_bc(comparison: SetsComparison, action_set: str, seed: int, tell: Told) -> None:
    spec = _with_seed(comparison.spec, "bc", seed)
    recipe = load_recipe(BcRecipe, "bc", spec.models, preset=comparison.preset, where=spec.name)
    run, n_steps = comparison.run("bc", action_set, seed), _n_action_steps(comparison)
    tell(f"bc, {action_set}, seed {seed}")
    train_bc(comparison.root, spec, recipe, run, n_action_steps=n_steps, action_set=action_set)


def _rollout(comparison: SetsComparison, policy: str, action_set: str, seed: int, tell: Told) -> dict[str, Any]:
    """The rollout's report.json: the one that is there, if it is of these models, these starts and this length."""
    starts, recordings, what = _starts(comparison, policy)
    kind = "bc" if policy == "bc" else "policy"
    request = PolicyRequest(
        comparison.root, comparison.spec, comparison.preset, _n_action_steps(comparison), device=default_device(),
        recordings=recordings, vqgan=comparison.vqgan, action_set=action_set,
        runs={kind: comparison.run(kind, action_set, seed)},
    )  # fmt: skip
    acting = load_policy(policy, request)
    folder = comparison.folder / f"{policy}-{action_set}-seed{seed}"
    n_steps = require_simulator(comparison.spec).max_steps
    there = find_rollout(folder)
    made_of = (dict(acting.tags), [start.name for start in starts], n_steps)
    if there is None or (there["tags"], [e["name"] for e in there["episodes"]], there["max_steps"]) != made_of:
        tell(f"rolling out {policy}, {action_set}, seed {seed}")
        roll_out_into(
            folder, comparison.spec, acting, starts, name=policy, what=what, max_steps=n_steps,
            environments=comparison.environments, with_logs=False,
        )  # fmt: skip
        there = find_rollout(folder)
        assert there is not None
    return there


def _starts(comparison: SetsComparison, policy: str) -> tuple[list[Start], dict[int, Recording], str]:
    if policy not in FOLLOWS_RECORDINGS:
        return seed_starts(parse_seeds(comparison.seeds)), {}, comparison.seeds
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
