"""Why a stored file is stale: the first field by which what it was made from differs from what it would be made from today."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vilp_data import shards
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import VilpDataError
from vilp_data.latents import latents_path, load_encoder, stale_reason
from vilp_data.spec import TaskSpec


def stale_episodes(root: Path, spec: TaskSpec) -> dict[str, str]:
    """Episode id -> the field of the ingest spec that changed, and how. Empty where all fit `spec`."""
    fields = spec.ingest_fields()
    reasons = {}
    for entry in EpisodeStore(root).index():
        difference = first_difference(entry.ingest, fields)
        if difference is not None:
            reasons[entry.id] = f"{difference}; run `vilp-data ingest` on {entry.source} again"
    return reasons


def stale_latents(root: Path, spec: TaskSpec) -> dict[str, str]:
    """latents/<view> (or one shard of it) -> why no shard there fits the trained encoders under runs/."""
    store = EpisodeStore(root)
    reasons: dict[str, str] = {}
    for run in sorted(path for path in (root / "runs").glob("*-*") if path.is_dir()):
        for view in spec.views:
            try:
                encoder = load_encoder(run.name.split("-")[0], run, view)
            except VilpDataError as error:
                reasons[str(run)] = str(error)
                continue
            folder = root / "latents" / view / encoder.key
            if not folder.is_dir():
                reasons[str(folder)] = (
                    _against_other_keys(root / "latents" / view, encoder.key_fields)
                    + f"; run `vilp-data latents --run {run}`"
                )
                continue
            for entry in store.index():
                why = stale_reason(root, entry, view, encoder.key)
                if why is not None:
                    reasons[str(latents_path(root, view, encoder.key, entry.id))] = (
                        f"{why}; run `vilp-data latents --run {run}`"
                    )
    return reasons


def first_difference(old: Any, new: Any, path: str = "") -> str | None:
    """`views.front.height: 96 -> 128`, for the first place in sorted order where plain data differs; None where nothing does."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in sorted({*old, *new}):
            place = f"{path}.{key}" if path else str(key)
            if key not in old or key not in new:
                return f"{place}: {'added' if key not in old else 'removed'}"
            difference = first_difference(old[key], new[key], place)
            if difference is not None:
                return difference
        return None
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        differences = (first_difference(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip(old, new, strict=True)))
        return next((difference for difference in differences if difference is not None), None)
    return None if old == new else f"{path}: {json.dumps(old)} -> {json.dumps(new)}"


def _against_other_keys(folder: Path, fields: Mapping[str, str]) -> str:
    """Compare with the latents that were made under another key of the same view, if there are any."""
    for shard in sorted(folder.glob("*/[!.]*.safetensors")):
        made_with = json.loads(shards.read_header(shard).metadata["encoder"])
        return f"no latents of this encoder; those under {shard.parent.name} differ in {first_difference(made_with, fields)}"
    return "not encoded yet"
