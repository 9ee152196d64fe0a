"""`vilp-models`: train, evaluate, imagine, roll out, compare. Thin: one file a verb, which parses, calls, prints."""

from __future__ import annotations

import typer

from vilp_data.cli import run_app
from vilp_models.cli import compare, evaluate, generate, rollout, train

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Train and judge the models on a dataset.",
)
app.add_typer(train.app, name="train")
app.add_typer(evaluate.app, name="evaluate")
app.command()(generate.generate)
app.command()(rollout.rollout)
app.command()(compare.compare)


def main() -> None:
    """Run the command line; exit codes as of `vilp-data`."""
    run_app(app, "vilp-models")
