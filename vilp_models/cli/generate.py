"""`vilp-models generate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vilp_data.cli.options import PresetOption, progress_bar
from vilp_models.cli.options import (
    DataOption,
    DenoisingStepsOption,
    ModelRunOption,
    NoiseSeedOption,
    SamplerOption,
    TaskOption,
    VqganOption,
    dataset_of,
)
from vilp_models.runs import find_model_run


def generate(
    task: TaskOption = None,
    preset: PresetOption = None,
    data: DataOption = None,
    run: ModelRunOption = None,
    vqgan: VqganOption = None,
    episodes: Annotated[int, typer.Option(min=1, help="How many videos, spread over the validation episodes.")] = 6,
    long: Annotated[
        int | None,
        typer.Option(
            min=1, help="Feed the last imagined frame back until there are this many; needs planners without low_dim."
        ),
    ] = None,
    denoising_steps: DenoisingStepsOption = None,
    sampler: SamplerOption = None,
    seed: NoiseSeedOption = 0,
    out: Annotated[Path | None, typer.Option(help="Folder. Default: DATA/generated/RUN.", show_default=False)] = None,
) -> None:
    """Imagine from validation starts: real, reconstructed, imagined and error as video (.mp4), picture (.png) and recording (.rrd).

    Example: vilp-models generate --data data/pusht --preset cpu --long 60
    """
    from vilp_models.evaluate import Sampling, generate_videos

    root, spec = dataset_of(data, task, preset)
    folder = find_model_run(root, "planner", given=run, preset=preset)
    vqgan_run = find_model_run(root, "vqgan", given=vqgan, preset=preset, option="--vqgan")
    target = out or root / "generated" / folder.name
    with progress_bar("imagining", episodes) as advance:
        lines = generate_videos(
            root, spec, folder, vqgan_run, target,
            n_videos=episodes, long_frames=long, sampling=Sampling(seed, denoising_steps, sampler), progress=advance,
        )  # fmt: skip
    print("\n".join([*lines, f"in {target}; `rerun FILE.rrd` opens a recording"]))
