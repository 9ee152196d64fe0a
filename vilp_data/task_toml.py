"""A task TOML as it is read: found by name or path, a preset's tables over the rest, and told in words where it cannot be used."""

from __future__ import annotations

import difflib
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from vilp_data.episodes_spec import EpisodesSpec, read_ranges
from vilp_data.errors import SpecError, nearest
from vilp_data.spec import (
    PRESETS,
    ActionSpec,
    DepthSpec,
    RecordSpec,
    SimSpec,
    SplitSpec,
    TaskSpec,
    VariantSpec,
    VectorSpec,
    ViewSpec,
    WindowSpec,
)


def load_task(name_or_path: str, *, preset: str | None = None) -> TaskSpec:
    """The task called `name_or_path` (a built-in name such as "hanoi", or a path to a TOML), with a preset's overrides applied."""
    if name_or_path.endswith(".toml"):
        path = Path(name_or_path)
        if not path.is_file():
            raise SpecError(
                "no such task file", where=path, remedy="give a path to a TOML, or one of: " + ", ".join(task_names())
            )
        task = parse_task(path.read_text(encoding="utf-8"), where=str(path), preset=preset)
        return _with_ranges(task, path.parent)
    if name_or_path not in task_names():
        raise SpecError(
            f"no task called {name_or_path!r}",
            remedy=nearest(name_or_path, task_names()) + "; or give a path ending in .toml",
        )
    text = (resources.files("pipelines") / f"{name_or_path}.toml").read_text(encoding="utf-8")
    return parse_task(text, where=f"pipelines/{name_or_path}.toml", preset=preset)


def _with_ranges(task: TaskSpec, folder: Path) -> TaskSpec:
    """The task with the rows of its ranges file, which lies beside the TOML unless its path says otherwise."""
    if task.episodes.kind != "ranges":
        return task
    path = folder / task.episodes.by
    try:
        rows = read_ranges(path.read_text(encoding="utf-8"), where=str(path))
    except (OSError, UnicodeDecodeError) as error:
        found = getattr(error, "strerror", None) or "not text in UTF-8"
        remedy = "episodes.by is a path from the task TOML's folder"
        raise SpecError("the ranges file cannot be read", where=path, found=found, remedy=remedy) from error
    return task.model_copy(update={"episodes": task.episodes.model_copy(update={"rows": rows})})


def task_names() -> list[str]:
    """The built-in tasks."""
    return sorted(
        entry.name.removesuffix(".toml")
        for entry in resources.files("pipelines").iterdir()
        if entry.name.endswith(".toml")
    )


def parse_task(text: str, *, where: str, preset: str | None = None) -> TaskSpec:
    """Parse a task TOML. `[presets.NAME]` tables override the rest, table by table; SpecError says what and where, also where episodes
    that are told apart would be recorded from the same seeds: a dataset that holds such ones can still be read."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SpecError("not valid TOML", where=where, found=str(error), remedy="correct that line") from error
    task = _validated(with_preset(table, preset, where=where), where)
    for name, variant in task.record.variants.items():
        task.record.require_apart(name, variant.seeds, where=where)
    return task


def with_preset(table: dict[str, Any], preset: str | None, *, where: str) -> dict[str, Any]:
    """A TOML without its `[presets]`, those of `preset` in place of what they override. SpecError for what is none."""
    presets = table.pop("presets", {})
    if not isinstance(presets, dict):
        raise SpecError("`presets` holds tables", where=where, found=presets, remedy="such as [presets.tiny.record]")
    for name, over in presets.items():
        if name not in PRESETS:
            raise SpecError(f"unknown preset [presets.{name}]", where=where, remedy=nearest(name, PRESETS))
        if not isinstance(over, dict):
            raise SpecError(
                f"`presets.{name}` is a table", where=where, found=over, remedy=f"such as [presets.{name}.…]"
            )
    if preset is None:
        return table
    if preset not in PRESETS:
        raise SpecError(f"unknown preset {preset!r}", where=where, remedy=nearest(preset, PRESETS))
    return _merged(table, presets.get(preset, {}))


def task_from_dict(table: dict[str, Any], *, where: str) -> TaskSpec:
    """A resolved spec read back from dataset.json or a run's recipe."""
    return _validated(table, where)


def _validated(table: dict[str, Any], where: str) -> TaskSpec:
    try:
        return TaskSpec.model_validate(table)
    except ValidationError as error:
        raise SpecError(
            "the task cannot be used",
            where=where,
            found="\n          ".join(_complaints(error)),
            remedy="docs/task_toml.md lists every key",
        ) from error


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in over.items():
        out[key] = _merged(out[key], value) if isinstance(value, dict) and isinstance(out.get(key), dict) else value
    return out


def _complaints(error: ValidationError) -> list[str]:
    lines = []
    for item in error.errors():
        place = ".".join(str(part) for part in item["loc"]) or "(top level)"
        if item["type"] == "extra_forbidden":
            known = _known_keys(item["loc"])
            close = difflib.get_close_matches(str(item["loc"][-1]), known, n=1, cutoff=0.5)
            hint = f"; did you mean {close[0]!r}?" if close else f"; known here: {', '.join(known)}"
            lines.append(f"unknown key {place}{hint}")
        else:
            lines.append(f"{place}: {item['msg']}")
    return lines


def _known_keys(location: tuple[int | str, ...]) -> list[str]:
    """Keys allowed in the table that holds the key at `location`."""
    tables: dict[str, type[BaseModel]] = {
        "views": ViewSpec, "low_dim": VectorSpec, "action": ActionSpec, "state": VectorSpec,
        "episodes": EpisodesSpec, "split": SplitSpec, "window": WindowSpec, "sim": SimSpec, "record": RecordSpec,
    }  # fmt: skip
    table = tables.get(str(location[0]), TaskSpec) if len(location) > 1 else TaskSpec
    if table is ViewSpec and location[2:3] == ("depth",) and len(location) > 3:
        table = DepthSpec
    if table is RecordSpec and location[1:2] == ("variants",) and len(location) > 3:
        table = VariantSpec
    return sorted(info.alias or name for name, info in table.model_fields.items())
