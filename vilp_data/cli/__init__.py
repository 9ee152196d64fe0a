"""`vilp-data`: one verb for each thing it makes. Thin: its files parse, call, print."""

from __future__ import annotations

import sys
from typing import Any

import typer
from typer.core import TyperGroup

from vilp_data.cli import actions, check, datasets, export, history, logs, render, salvage, surgery, view
from vilp_data.errors import UsageError, VilpDataError

INTERRUPTED = 130

NO_VERBS = {
    "redo": "`vilp-data undo --operation N` brings again what undo N took; `vilp-data log` has the numbers",
    "add": "`vilp-data ingest LOGS…` adds to the dataset in use",
}
"""Verbs that people look for, and what does it."""


class _Verbs(TyperGroup):
    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] in NO_VERBS:
            raise UsageError(f"there is no verb {args[0]!r}", remedy=NO_VERBS[args[0]])
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=_Verbs,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Episode logs in, latent shards out.",
)
# The order of --help: the walk of an episode.
for verb in (
    logs.record,
    render.render,
    logs.inspect,
    check.check,
    salvage.salvage,
    logs.ingest,
    datasets.split,
    actions.actions,
    datasets.latents,
    datasets.why_stale,
    view.view,
    export.export,
    export.card,
    surgery.remove,
    surgery.trim,
    surgery.relabel,
    surgery.merge,
    history.log,
    history.diff,
    history.undo,
    history.gc,
):
    app.command(verb.__name__.replace("_", "-"))(verb)


def main() -> None:
    """Run the command line `vilp-data`."""
    run_app(app, "vilp-data")


def run_app(commands: typer.Typer, name: str) -> None:
    """Run a command line whose errors end in words, not in a traceback.

    Exit codes: 0 done, 1 findings or partial loss, 2 wrong use, 130 stopped by Ctrl-C."""
    try:
        commands()
    except VilpDataError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            print(
                f"{name}: stopped; anything it had finished is kept, run the same command again to go on",
                file=sys.stderr,
            )
        raise
