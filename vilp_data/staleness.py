"""Why a stored file is stale: the first field by which what it was made from differs from what it would be made from today."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path

from vilp_data import shards
from vilp_data.demonstrations import CUT_TAG
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError, VilpDataError
from vilp_data.keys import first_difference
from vilp_data.latents import FrameEncoder, encoder_names, latents_path, load_encoder, stale_reason
from vilp_data.spec import TaskSpec


def stale_episodes(root: Path, spec: TaskSpec) -> dict[str, str]:
    """Episode id -> the field of the ingest spec that changed, and how. Empty where all fit `spec`."""
    fields = spec.ingest_fields()
    reasons = {}
    ranges = {row.text for row in spec.episodes.rows} if spec.episodes.kind == "ranges" else None
    for entry in EpisodeStore(root).index():
        if ranges is not None and entry.ingest.get("episodes") and entry.tags.get(CUT_TAG) not in ranges:
            was = entry.tags.get(CUT_TAG, "its range")
            reasons[entry.id] = (
                f"episodes: {was} is no longer in {spec.episodes.by}; ingest its log again, or `vilp-data remove` it"
            )
        difference = first_difference(entry.ingest, fields)
        if difference is not None:
            way = f"run `vilp-data ingest` on {entry.source} again"
            if difference.startswith("episodes"):
                way = f"another rule makes another dataset: `vilp-data ingest` {entry.source} --into another folder"
            reasons[entry.id] = f"{difference}; {way}"
    return reasons


def stale_latents(root: Path, spec: TaskSpec) -> dict[str, str]:
    """latents/<view> (or one shard of it) -> why no shard there fits the trained encoders under runs/."""
    store = EpisodeStore(root)
    reasons: dict[str, str] = {}
    for run in sorted(path for path in (root / "runs").glob("*") if path.is_dir()):
        for view in spec.views:
            try:
                encoder = run_encoder(run, view)
            except VilpDataError as error:
                reasons[str(run)] = str(error)
                continue
            if encoder is None:
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


def run_encoder(run: Path, view: str) -> FrameEncoder | None:
    """The encoder that was trained into `run`: of the kind whose name the folder begins with, as `find_run` reads it, else of
    the first kind that loads. None for the run of another model. StoreError for one that is damaged, whatever it was."""
    named = [name for name in encoder_names() if run.name.startswith(name)]
    if named:
        return load_encoder(max(named, key=len), run, view)
    for name in encoder_names():
        with contextlib.suppress(UsageError):
            return load_encoder(name, run, view)
    return None


def _against_other_keys(folder: Path, fields: Mapping[str, str]) -> str:
    """Compare with the latents that were made under another key of the same view, if there are any."""
    for shard in sorted(folder.glob("*/[!.]*.safetensors")):
        made_with = json.loads(shards.read_header(shard).metadata["encoder"])
        return f"no latents of this encoder; those under {shard.parent.name} differ in {first_difference(made_with, fields)}"
    return "not encoded yet"
