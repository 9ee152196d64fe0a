"""Stored files that no episode's own look opens: latents, which planners read without a checksum, and files that wait for an undo."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from vilp_data import shards
from vilp_data.check.findings import Finding, Place
from vilp_data.episode_files import INGEST_AGAIN
from vilp_data.episodes import EpisodeEntry
from vilp_data.errors import StoreError, VilpDataError
from vilp_data.latents import stale_reason

ENCODE_AGAIN = "delete it, and run `vilp-data latents` again"


def latent_findings(root: Path, entries: Sequence[EpisodeEntry]) -> Iterator[Finding]:
    """Latents of stored episodes whose bytes changed since they were written, or that are of other frames than the episode has."""
    stored = {entry.id: entry for entry in entries}
    for path in sorted((root / "latents").glob("*/*/*.safetensors")):
        view, key, entry = path.parts[-3], path.parts[-2], stored.get(path.stem)
        if entry is None or view not in entry.frames_sha256:
            continue  # nobody reads it: for `vilp-data gc`
        try:
            shards.verify_shard(path)
        except StoreError as error:
            yield damaged(error, str(root), entry.id, remedy=ENCODE_AGAIN)
            continue
        why = stale_reason(root, entry, view, key)
        if why is not None:
            yield Finding(
                severity="warning", kind="stale-latents", place=Place(source=str(root), topic=f"view {view}", episode=entry.id),
                what=f"its latents do not fit: {why}", evidence={"file": str(path)}, remedy="`vilp-data latents` makes them anew",
            )  # fmt: skip
    for path in sorted((root / "latents").glob("*/*/*.json")):
        try:
            json.loads(path.read_bytes())
        except (OSError, ValueError) as error:
            unreadable = StoreError("statistics that cannot be read", where=path, found=error)
            yield damaged(unreadable, str(root), None, remedy=ENCODE_AGAIN)


def held_findings(root: Path) -> Iterator[Finding]:
    """Files that wait for an undo and would come back damaged."""
    held = root / "history" / "held"
    for path in sorted(held.glob("[0-9]*/**/*.safetensors")):
        try:
            shards.verify_shard(path)
        except StoreError as error:
            number = int(path.relative_to(held).parts[0])
            yield Finding(
                severity="warning", kind="damaged-held", place=Place(source=str(root)),
                what=f"a file that waits for the undo of operation {number} is damaged: {error.what}",
                evidence={"file": str(path), "found": str(error.found)},
                remedy=f"what operation {number} took away cannot come back whole; restore the file from a copy if it is needed",
            )  # fmt: skip


def damaged(error: VilpDataError, source: str, episode: str | None, *, remedy: str | None = None) -> Finding:
    """A stored file that cannot be read as it was written: an error."""
    evidence = {"found": str(error.found), "file": str(error.where)}
    return Finding(
        severity="error", kind="damaged", place=Place(source=source, episode=episode), what=error.what, evidence=evidence,
        remedy=remedy or error.remedy or INGEST_AGAIN,
    )  # fmt: skip
