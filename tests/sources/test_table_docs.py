"""The tasks shown in docs/table_logs.md are tasks."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vilp_data.cli import app
from vilp_data.task_toml import parse_task

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "table_logs.md").read_text(encoding="utf-8")
TASKS = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("text", TASKS)
def test_a_task_shown_is_a_task_of_at_most_20_lines(text: str) -> None:
    assert parse_task(text, where="docs/table_logs.md").low_dim
    assert len(text.splitlines()) <= 20


def test_every_option_shown_is_one() -> None:
    for line in re.findall(r"^    vilp-data (.*)$", PAGE, re.MULTILINE):
        verb, *words = line.split()
        told = CliRunner().invoke(app, [verb, "--help"], env={"COLUMNS": "300"}).output
        for option in (word for word in words if word.startswith("-")):
            assert re.search(rf"(?<!\S){option}\b", told), (verb, option)
