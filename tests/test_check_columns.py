"""Columns that a check judges go by their log's names, and whatever a log calls them can be printed and stored."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from tests.lerobot_folders import write_v21
from vilp_data.check.columns import columns_of
from vilp_data.cli import app

HOSTILE = "\x1b[31mred\x07\ud800\u202e two\nlines"


def test_the_numbers_of_an_array_keep_their_place_and_get_their_name() -> None:
    columns = columns_of(np.array([1.0, 2.0, 3.0]), ["hip", HOSTILE, ""])
    assert columns is not None
    assert columns.names == ("[0] hip", "[1] [31mred two lines", "[2]")
    assert list(columns.read(np.array([4.0, 5.0, 6.0]))) == [4, 5, 6]


@pytest.mark.parametrize("names", [(), ("hip",), ("hip", "knee", "toe")])
def test_names_that_are_not_as_many_as_the_numbers_name_none(names: tuple[str, ...]) -> None:
    columns = columns_of(np.zeros(2), names)
    assert columns is not None
    assert columns.names == ("[0]", "[1]")


def test_members_joints_and_items_are_named_in_printable_letters() -> None:
    joints = [{"name": HOSTILE, "angle": 1.0}]
    columns = columns_of({"name": [HOSTILE, "knee"], "position": [1.0, 2.0], "joints": joints, "a\x1b": 3})
    assert columns is not None
    assert columns.names == ("position.[31mred two lines", "position.knee", "joints.angle.[31mred two lines", "a")


@pytest.mark.parametrize("options", [[], ["--json"]])
@pytest.mark.parametrize("name", ["two", HOSTILE])
def test_a_finding_about_a_table_s_column_can_be_printed_whatever_it_is_called(
    tmp_path: Path, name: str, options: list[str]
) -> None:
    folder = write_v21(tmp_path / "log", lengths=(60,), images="image")
    states = folder.table(0)
    table = pq.read_table(states)
    rows = np.array(table["observation.state"].to_pylist(), np.float32)
    rows[3, 1] = np.nan
    place = table.column_names.index("observation.state")
    array = pa.array(rows.tolist(), table.schema.field(place).type)
    pq.write_table(table.set_column(place, table.schema.field(place), array), states)
    info = folder.path / "meta/info.json"
    info.write_text(info.read_text().replace('"two"', json.dumps(name)))
    result = CliRunner().invoke(app, ["check", str(folder.path), *options])
    assert result.exit_code == 0
    assert "[1] two" in result.output if name == "two" else "[1] [31mred two lines" in result.output
    assert result.output.replace("\n", "").isprintable()


def test_what_inspect_says_of_a_table_s_names_is_printable(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "log", images="image")
    info = folder.path / "meta/info.json"
    info.write_text(info.read_text().replace('"two"', json.dumps(HOSTILE)))
    result = CliRunner().invoke(app, ["inspect", str(folder.path)])
    assert result.exit_code == 0
    assert "one, [31mred two lines" in result.output
    assert result.output.replace("\n", "").isprintable()
