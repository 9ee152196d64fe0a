"""Which run of a model is meant: the one named, else the preset's, else the only one there is."""

from __future__ import annotations

from pathlib import Path

from vilp_data.errors import UsageError
from vilp_data.latent_runs import find_run


def default_run(root: Path, model: str, preset: str | None) -> Path:
    """Where a preset's run of this kind of model is made, within its dataset."""
    return root / "runs" / f"{model}-{preset or 'default'}"


def find_model_run(
    root: Path, model: str, *, given: Path | None = None, preset: str | None = None, option: str = "--run"
) -> Path:
    """The folder of a trained run of this kind ("vqgan", "planner", …): `given`, else DATA/runs/<model>-<preset>, else, without
    a preset, the only one of its kind.

    `option` is how a user names another one. Raises UsageError where that folder is not there, or it is not clear which."""
    if given is not None or preset is None:
        return find_run(root, given, model, option=option)
    run = default_run(root, model, preset)
    if not run.is_dir():
        there = ", ".join(path.name for path in sorted((root / "runs").glob(f"{model}*")) if path.is_dir())
        remedy = f"train it with `vilp-models train {model} --preset {preset}`"
        if option != "--preset":
            remedy += f", or name another with {option}"
        raise UsageError(f"no {model} run of preset {preset!r}", where=run, found=there or "none", remedy=remedy)
    return run
