"""Task TOMLs: what is derived, what is refused, and how the refusal helps."""

from __future__ import annotations

from pathlib import Path

import pytest

from vilp_data import keys
from vilp_data.errors import SpecError
from vilp_data.spec import PRESETS
from vilp_data.task_toml import load_task, parse_task, task_names

GOOD = 'name = "x"\n[views.front]\ntopic = "/a"\nheight = 8\nwidth = 8\n'


@pytest.mark.parametrize("task", task_names())
@pytest.mark.parametrize("preset", [None, *PRESETS])
def test_every_built_in_task_is_valid_under_every_preset(task: str, preset: str | None) -> None:
    assert load_task(task, preset=preset).name == task


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ("[views.side]\ntopic = '/b'\nheigth = 8\nwidth = 8", "did you mean 'height'"),
        ("[splt]\nratio = 0.9", "did you mean 'split'"),
        ("[split]\nratio = 1.5", "split.ratio"),
        ("[action.a]\ntopic = '/c'\nfrom = 'arm'", "exactly one of"),
        ("[action.a]\nfrom = 'arm'", "no low_dim part"),
        ("[action.a]\ntopic = '/c'\nholds = 'arm'", "holds = 'arm' is no low_dim part"),
        ("[low_dim.arm]\ntopic = '/d'\n[action.a]\ntopic = '/c'\nkind = 'delta'\nholds = 'arm'", "absolute commands"),
        ("[action.a]\ntopic = '/c'\nkind = 'delta_rotation'", "composes differently"),
        ("[low_dim.a]\ntopic = '/a'\nclock = 'log'", "read by two clocks"),
        ("[presets.cppu]", "did you mean 'cpu'"),
        ("[record.variants.purple]\nepisodes = 3\noptoins = {}", "did you mean 'options'"),
        ("[record.variants.purple]\nepisodes = 3", "record.variants.purple.options"),
        ("[record.variants.'a/b']\nepisodes = 3\noptions = {}", "part of a file's name"),
        ("name = 3 = 4", "not valid TOML"),
    ],
)
def test_a_wrong_table_is_refused_with_its_place_and_a_remedy(extra: str, said: str) -> None:
    with pytest.raises(SpecError) as refused:
        parse_task(GOOD + extra, where="task.toml")
    assert said in str(refused.value)
    assert "task.toml" in str(refused.value)
    assert refused.value.exit_code == 2


def test_an_unknown_task_names_the_nearest() -> None:
    with pytest.raises(SpecError, match="did you mean 'hanoi'"):
        load_task("hannoi")
    with pytest.raises(SpecError, match="no such task file"):
        load_task("missing.toml")


def test_a_preset_overrides_table_by_table(tmp_path: Path) -> None:
    path = tmp_path / "task.toml"
    path.write_text(GOOD + "[record]\nepisodes = 20\nfirst_seed = 3\n[presets.tiny.record]\nepisodes = 2\n")
    assert load_task(str(path)).record.episodes == 20
    tiny = load_task(str(path), preset="tiny").record
    assert (tiny.episodes, tiny.first_seed) == (2, 3)


def test_a_variant_changes_options_of_the_simulator_and_keeps_the_others() -> None:
    text = '[sim]\nenv = "e"\nmax_steps = 7\noptions = { colour = "gray", size = 3 }\n'
    variant = '[record.variants.off_target]\nepisodes = 2\nfirst_seed = 9\noptions = { colour = "purple" }\n'
    spec = parse_task(GOOD + text + variant, where="task.toml")
    sim = spec.simulated_as("off_target")
    assert (sim.env, sim.max_steps, sim.options) == ("e", 7, {"colour": "purple", "size": 3})
    assert spec.sim is not None
    assert spec.sim.options == {"colour": "gray", "size": 3}
    with pytest.raises(SpecError, match="did you mean 'off_target'"):
        spec.simulated_as("of_target")


def test_the_order_of_an_action_s_parts_is_part_of_the_ingest_fields() -> None:
    a, b = "[action.a]\ntopic = '/c'\n", "[action.b]\ntopic = '/d'\n"
    one, other = (parse_task(GOOD + parts, where="x").ingest_fields() for parts in (a + b, b + a))
    assert keys.digest(one) != keys.digest(other)


def test_what_does_not_touch_the_stored_bytes_is_not_part_of_the_ingest_fields() -> None:
    changed = parse_task(GOOD + "[split]\nratio = 0.5\n[window]\nn_plan_frames = 3", where="x").ingest_fields()
    assert changed == parse_task(GOOD, where="x").ingest_fields()
    parts = "[low_dim.arm]\ntopic = '/d'\n[action.a]\ntopic = '/c'\n"
    held = parse_task(GOOD + parts + "holds = 'arm'", where="x").ingest_fields()
    assert held == parse_task(GOOD + parts, where="x").ingest_fields()
    assert changed != parse_task(GOOD.replace("height = 8", "height = 16"), where="x").ingest_fields()
