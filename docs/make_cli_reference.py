"""Write docs/cli.md from the `--help` of every command; with --check, say whether it is stale."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import typer
from typer.testing import CliRunner

from vilp_data.cli import app as data_app
from vilp_models.cli import app as models_app

PAGE = Path(__file__).parent / "cli.md"


def reference() -> str:
    """The whole page."""
    parts = ["# Commands\n", "Exit codes: 0 done, 1 findings or partial loss, 2 wrong use, 130 stopped by Ctrl-C.\n"]
    for name, app in (("vilp-data", data_app), ("vilp-models", models_app)):
        parts += [f"## {name}\n", *_pages(name, app, [])]
    return "\n".join(parts)


def _pages(program: str, app: typer.Typer, path: list[str]) -> Iterator[str]:
    result = CliRunner(env={"COLUMNS": "110", "TERM": "dumb"}).invoke(app, [*path, "--help"], prog_name=program)
    title = f"### {' '.join([program, *path])}\n\n" if path else ""
    yield f"{title}```\n{result.output.rstrip()}\n```\n"
    for command in _subcommands(app, path):
        yield from _pages(program, app, [*path, command])


def _subcommands(app: typer.Typer, path: list[str]) -> list[str]:
    command = typer.main.get_command(app)
    for name in path:
        command = command.commands[name]  # type: ignore[attr-defined]
    return sorted(getattr(command, "commands", {}))


if __name__ == "__main__":
    page = reference()
    if "--check" in sys.argv:
        raise SystemExit(0 if PAGE.read_text(encoding="utf-8") == page else "docs/cli.md is stale: run `make docs`")
    PAGE.write_text(page, encoding="utf-8")
