"""Verbs about datasets: split, latents, why-stale."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from vilp_data.cli.options import (
    DatasetArgument,
    JsonOption,
    PresetOption,
    WorkersOption,
    latent_bar,
    open_dataset,
    print_json,
)
from vilp_data.engine import cpu_count
from vilp_data.errors import number_of, some_of
from vilp_data.task_toml import load_task


def split(
    dataset: DatasetArgument = None,
    ratio: Annotated[
        float | None, typer.Option(help="Share of training episodes. Default: the task's (0.9).", show_default=False)
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the draw. Default: the task's.", show_default=False)] = None,
    redraw: Annotated[bool, typer.Option(help="Forget the present assignment and draw anew.")] = False,
    check: Annotated[bool, typer.Option(help="Change nothing; say what is wrong with the split.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Assign every episode to training or validation, for good: later runs place only what is new.

    Example: vilp-data split --ratio 0.9
    """
    from vilp_data.dataset_split import check_dataset_split, find_split, lock_path, update_split
    from vilp_data.split import leaks

    root, spec = open_dataset(dataset)
    if check:
        findings = check_dataset_split(root)
        print_json(findings) if as_json else print("\n".join(findings) or f"{lock_path(root)}: nothing wrong")
        raise typer.Exit(1 if findings else 0)
    kept = not redraw and find_split(root) is not None
    lock = update_split(
        root,
        ratio=spec.split.ratio if ratio is None else ratio,
        ratio_from="task" if ratio is None else "command line",
        seed=spec.split.seed if seed is None else seed,
        group_by=spec.split.group_by,
        strata=spec.split.strata,
        redraw=redraw,
    )
    if as_json:
        print(lock.to_json().decode())
        return
    train, val = lock.ids("train"), lock.ids("val")
    drawn = f"ratio {lock.ratio:g} from the {lock.ratio_from}, seed {lock.seed}"
    print(f"{lock_path(root)}: {len(train)} training, {len(val)} validation episodes ({drawn})")
    if kept:
        print("  episodes placed before stay where they are; --redraw draws anew")
    for group in lock.duplicates:
        print(f"  identical, kept on one side: {', '.join(group)}")
    if twins := lock.twin_groups:
        alike = number_of(len(twins), "group")
        print(
            f"  the same actions under other pictures, one episode to the split: {alike}, such as {some_of(twins[0], 5)}"
        )
    for leak in leaks(lock, ()):
        print(f"  {leak}; `vilp-data split --redraw` draws anew")
    crossing = [pair for pair in lock.near_duplicates if lock.assignment[pair.first] != lock.assignment[pair.second]]
    if crossing:
        closest = f"{crossing[0].first} and {crossing[0].second}"
        print(f"  nearly alike, across the sides: {number_of(len(crossing), 'pair')}, closest {closest}; see the lock")


def latents(
    dataset: DatasetArgument = None,
    run: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the trained frame encoder. Default: that of --preset, else the only one under DATASET/runs.",
            show_default=False,
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(help="The preset whose encoder is meant: DATASET/runs/ENCODER-PRESET.", show_default=False),
    ] = None,
    encoder: Annotated[
        str, typer.Option(help="Kind of frame encoder, as registered under vilp.frame_encoders.")
    ] = "vqgan",
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Encode every stored frame once, with a trained frame encoder.

    Example: vilp-data latents data/hanoi --run data/hanoi/runs/vqgan-cpu
    """
    from vilp_data.latent_runs import encode_dataset, find_run

    root, spec = open_dataset(dataset)
    folder = find_run(root, run, encoder, preset=preset)
    with latent_bar() as progress:
        done = encode_dataset(root, spec, encoder, folder, workers=workers or cpu_count(), progress=progress)
    if as_json:
        print_json(dataclasses.asdict(done))
        return
    for view, key in done.keys.items():
        print(
            f"{root}/latents/{view}/{key}: {number_of(done.shards[view], 'shard')}"
            + ("" if done.written[view] else ", all there already")
        )
    if done.frames:
        bare = f"{done.ratio:.0%} of the bare forward loop ({done.bare_frames_per_s:.0f} frames/s)"
        print(f"{number_of(done.frames, 'frame')} encoded at {done.frames_per_s:.0f} frames/s, {bare}")
    if done.unseen:
        print(f"  training episodes that are new to the encoder: {some_of(done.unseen, 5)}")


def why_stale(
    dataset: DatasetArgument = None,
    task: Annotated[
        str | None, typer.Option(help="Compare with this task's spec instead of the dataset's own.", show_default=False)
    ] = None,
    preset: PresetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Name the field that makes stored episodes, latents or generated episodes stale.

    Example: vilp-data why-stale data/hanoi --task hanoi
    """
    from vilp_data.generated_episode import stale_generated
    from vilp_data.staleness import stale_episodes, stale_latents

    root, spec = open_dataset(dataset)
    spec = load_task(task, preset=preset) if task else spec
    reasons = stale_episodes(root, spec) | stale_latents(root, spec) | stale_generated(root)
    if as_json:
        print_json(reasons)
    else:
        print("\n".join(f"{what}: {why}" for what, why in sorted(reasons.items())) or f"{root}: nothing is stale")
    raise typer.Exit(1 if reasons else 0)
