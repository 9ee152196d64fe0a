"""Task TOMLs: what is derived, what is refused, and how the refusal helps."""

from __future__ import annotations

from pathlib import Path

import pytest

from vilp_data import keys
from vilp_data.errors import SpecError
from vilp_data.spec import PRESETS
from vilp_data.task_toml import load_task, parse_task, task_from_dict, task_names

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
        ("[record.variants.purple]\nepisodes = 3\noptions = {}", "record.variants.purple.first_seed"),
        ("[presets]\ntiny = 3", "`presets.tiny` is a table"),
        ("[record.variants.'a/b']\nepisodes = 3\nfirst_seed = 0\noptions = {}", "part of a file's name"),
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


def variant(name: str, first_seed: int, episodes: int = 10) -> str:
    return f"[record.variants.{name}]\nepisodes = {episodes}\nfirst_seed = {first_seed}\noptions = {{}}\n"


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        (variant("a", 1000), r"\[record.variants.a\] and \[record\] (.|\n)*1000 to 1009 and 1000 to 1023(.|\n)*such as 1024"),
        (variant("a", 1023), r"1023 to 1032 and 1000 to 1023"),
        (variant("a", 991), r"991 to 1000 and 1000 to 1023"),
        ("[record]\nepisodes = 5000\n" + variant("a", 5000), r"5000 to 5009 and 1000 to 5999(.|\n)*first_seed for"),
        (variant("a", 5000) + variant("b", 5009), r"variants.a\] and \[record.variants.b\](.|\n)*such as 5019"),
    ],
)  # fmt: skip
def test_episodes_that_are_told_apart_are_not_recorded_from_the_same_seeds(tables: str, said: str) -> None:
    with pytest.raises(SpecError, match=rf"^task.toml: (.|\n)*{said}"):
        parse_task(GOOD + tables, where="task.toml")


def test_seeds_beside_each_other_are_apart_and_a_preset_counts_with_what_it_changes() -> None:
    text = GOOD + variant("a", 990) + variant("b", 1024) + "[presets.paper.record]\nepisodes = 25\n"
    assert parse_task(text, where="x").record.variants["b"].seeds == range(1024, 1034)
    assert parse_task(text, where="x", preset="tiny").record.seeds == range(1000, 1024)
    with pytest.raises(SpecError, match="1024 to 1033 and 1000 to 1024"):
        parse_task(text, where="x", preset="paper")


def test_a_dataset_of_a_task_whose_seeds_overlap_can_still_be_read() -> None:
    table = parse_task(GOOD + variant("a", 5000), where="x").model_dump(mode="json", by_alias=True)
    table["record"]["variants"]["a"]["first_seed"] = 1000
    assert task_from_dict(table, where="dataset.json").record.variants["a"].first_seed == 1000


@pytest.mark.parametrize("preset", [None, *PRESETS])
@pytest.mark.parametrize("name", task_names())
def test_no_built_in_task_records_the_starts_that_policies_are_tuned_and_judged_on(
    name: str, preset: str | None
) -> None:
    record = load_task(name, preset=preset).record
    for one in (record, *record.variants.values()):
        assert not {*one.seeds} & {*range(50), *range(100_000, 100_050)}


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
