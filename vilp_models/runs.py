"""Which run of a model is meant: the one named, else the preset's, else the only one there is."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from vilp_data.errors import UsageError
from vilp_data.latent_runs import find_run


def default_run(root: Path, model: str, preset: str | None, action_set: str | None = None) -> Path:
    """Where a preset's run of this kind of model is made, within its dataset; of a model that learns by an action set, a run for
    each."""
    return root / "runs" / "-".join([model, preset or "default", *([action_set] if action_set else [])])


def find_model_run(
    root: Path,
    model: str,
    *,
    given: Path | None = None,
    preset: str | None = None,
    action_set: str | None = None,
    option: str = "--run",
) -> Path:
    """The folder of a trained run of this kind ("vqgan", "planner", …): `given`, else DATA/runs/<model>-<preset>, else, without
    a preset, the only one of its kind. With an action set -<set> follows, and without a preset it is that of no preset.

    `option` is how a user names another one. Raises UsageError where that folder is not there, or it is not clear which."""
    if given is not None or (preset is None and action_set is None):
        return find_run(root, given, model, option=option)
    run = default_run(root, model, preset, action_set)
    if not run.is_dir():
        there = ", ".join(path.name for path in sorted((root / "runs").glob(f"{model}*")) if path.is_dir())
        chosen = {"--preset": preset, "--set": action_set}
        words = "".join(f" {name} {value}" for name, value in chosen.items() if value is not None)
        remedy = f"train it with `vilp-models train {model}{words}`"
        sets = [
            path.name.removeprefix(f"{run.name}-") for path in sorted(run.parent.glob(f"{run.name}-*")) if path.is_dir()
        ]
        if action_set is None and sets:
            remedy += f", or take the one of an action set with --set {' or '.join(sets)}"
        if option != "--preset":
            remedy += f", or name another with {option}"
        what = f"no {model} run of preset {preset!r}" + (f" and action set {action_set!r}" if action_set else "")
        raise UsageError(what, where=run, found=there or "none", remedy=remedy)
    return run


def tags_name(where: Mapping[str, str]) -> list[str]:
    """Tags that were asked for as parts of a folder's name: `["goal_256,256,45"]`."""
    texts = (f"{tag}_{value}" for tag, value in sorted(where.items()))
    return ["".join(c if c.isalnum() or c in "-_.," else "_" for c in text) for text in texts]
