"""Verbs that hand a dataset on: export, card."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vilp_data.cli.options import DatasetArgument, JsonOption, open_dataset, print_json, progress_bar
from vilp_data.errors import number_of

if TYPE_CHECKING:
    from vilp_data.export import ExportReport

SHOWN_IDS = 3

LicenceOption = Annotated[
    str | None, typer.Option(help="What the card says of the licence, such as CC-BY-4.0.", show_default=False)
]


def export(
    to: Annotated[Literal["lerobot", "robomimic", "diffusion-policy"], typer.Option(help="The format.")],
    dataset: DatasetArgument = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to make. Default: DATASET-FORMAT.", show_default=False)
    ] = None,
    split: Annotated[
        Literal["train", "val", "all"], typer.Option(help="One side, or all: training episodes first.")
    ] = "all",
    with_failures: Annotated[bool, typer.Option("--with-failures", help="Take episodes that failed too.")] = False,
    with_rollouts: Annotated[bool, typer.Option("--with-rollouts", help="Take a policy's own episodes too.")] = False,
    with_unlabelled: Annotated[
        bool, typer.Option("--with-unlabelled", help="Take episodes without actions too: theirs are NaN.")
    ] = False,
    masked: Annotated[
        Literal["cut", "mark", "refuse"],
        typer.Option(help="Masked steps: cut the episode there, mark them (NaN, and a column valid), or refuse."),
    ] = "cut",
    images: Annotated[
        Literal["h264", "h264-420", "lossless", "png"] | None,
        typer.Option(help="How LeRobot's frames are kept. Default: h264, in 4:4:4.", show_default=False),
    ] = None,
    crf: Annotated[
        int | None, typer.Option(help="Quality of h264, from 0, the best, to 51. Default: 18.", show_default=False)
    ] = None,
    licence: LicenceOption = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a dataset in another format, read it back, and compare it with the stored episodes.

    Example: vilp-data export data/pusht --to lerobot -o pusht-lerobot
    """
    from vilp_data.export import Choice, export_dataset

    root, _ = open_dataset(dataset)
    folder = out or Path(f"{root.resolve().name}-{to}")
    choice = Choice(
        split=split,
        with_failures=with_failures,
        with_rollouts=with_rollouts,
        with_unlabelled=with_unlabelled,
        masked=masked,
    )
    with progress_bar(f"exporting to {folder}", None) as advance:
        report = export_dataset(
            root, folder, to, choice=choice, images=images, crf=crf, licence=licence, force=force, progress=advance
        )
    if as_json:
        print_json(dataclasses.asdict(report))
    else:
        _print_report(report)


def card(
    dataset: DatasetArgument = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="The page; the contact sheet lies beside it. Default: DATASET/README.md.",
            show_default=False,
        ),
    ] = None,
    licence: LicenceOption = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a page that somebody wrote.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a dataset's card: what is in it, its split, statistics and sources, and a contact sheet.

    An earlier card is replaced; a page that somebody wrote is not.

    Example: vilp-data card data/pusht -o pusht.md --licence MIT
    """
    from vilp_data.dataset_card import write_card
    from vilp_data.episodes import EpisodeStore

    root, _ = open_dataset(dataset)
    path = out or root / "README.md"
    sheet = write_card(EpisodeStore(root), path, licence=licence, force=force)
    print_json({"card": path, "contact_sheet": sheet}) if as_json else print(
        path, *([sheet] if sheet else []), sep="\n"
    )


def _print_report(report: ExportReport) -> None:
    sides = {"train": "training", "val": "validation", "none": "on no side"}
    parts = ", ".join(f"{count} {sides[side]}" for side, count in report.sides.items())
    seconds = f"{report.bytes / 1e6:.1f} MB, written in {report.write_s:.1f} s, compared in {report.check_s:.1f} s"
    print(
        f"{report.out}: {number_of(report.episodes, 'episode')} ({parts}), {report.rows} rows at {report.rate_hz:g} Hz; {seconds}"
    )
    for view, one in report.views.items():
        near = (
            "every pixel equal"
            if one.psnr_db is None
            else f"PSNR {one.psnr_db:.1f} dB, worst frame {one.psnr_min_db:.1f} dB"
        )
        print(f"  view {view}: {one.where}, {one.coding}; {near}")
    for what in report.verified:
        print(f"  read back: {what}")
    for reason, ids in report.left_out.items():
        print(f"  left out, {reason}: {number_of(len(ids), 'episode')}, such as {', '.join(ids[:SHOWN_IDS])}")
    if report.masked:
        done = {"cut": "cut there", "mark": "marked in `valid`, their numbers NaN"}[report.masked_as]
        print(f"  masked steps: {sum(report.masked.values())} in {number_of(len(report.masked), 'episode')}; {done}")
    if report.cut_away:
        print(f"  lost between cuts: {sum(report.cut_away.values())} valid steps that stood alone")
    for what, why in report.not_carried.items():
        print(f"  not carried: {what}: {why}")
    for note in report.notes:
        print(f"  {note}")
    print("  where everything lies: README.md and export.json in the folder")
