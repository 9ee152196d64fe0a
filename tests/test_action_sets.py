"""Action sets: which episodes a recipe chooses, how its samples are weighed, and what is said where it cannot choose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_data.action_sets import (
    ActionRecipe,
    Candidate,
    choose,
    effective_epochs,
    parse_recipe,
    recipe_from_dict,
    repeats,
)
from vilp_data.dataset_action_sets import load_recipe, recipe_names
from vilp_data.errors import ActionSetError, SpecError
from vilp_data.task_toml import load_task

ON_TARGET, OFF_TARGET = {"object": "gray", "goal": "row"}, {"object": "purple", "goal": "row"}


def episodes(
    count: int, tags: dict[str, str] = ON_TARGET, *, prefix: str = "e", mute: int = 0, masked: int = 0
) -> list[Candidate]:
    """`count` of these tags, the first `mute` of them without actions, the last `masked` without a valid step."""
    return [Candidate(f"{prefix}{i:03}", tags, i >= mute, 9 * (i < count - masked)) for i in range(count)]


def recipe(**sources: dict[str, Any]) -> ActionRecipe:
    return recipe_from_dict({"source": sources}, where="test")


# --- the choice


candidates = st.lists(st.tuples(st.sampled_from(["gray", "purple"]), st.booleans()), min_size=1, max_size=30).map(
    lambda rows: [Candidate(f"e{i:02}", {"object": colour}, acts, 9) for i, (colour, acts) in enumerate(rows)]
)


@given(candidates, st.integers(1, 20), st.integers(0, 3), st.randoms())
def test_a_source_gets_as_many_fitting_episodes_with_actions_as_it_asks_for_or_says_how_many_there_are(
    there: list[Candidate], count: int, seed: int, random: Any
) -> None:
    wanted = recipe(some={"where": {"object": "gray"}, "count": count, "seed": seed})
    fitting = {one.id for one in there if one.tags["object"] == "gray" and one.has_action}
    if len(fitting) < count:
        with pytest.raises(ActionSetError, match="found"):
            choose(wanted, there, where="data")
        return
    chosen = choose(wanted, there, where="data")["some"]
    assert len(chosen) == len(set(chosen)) == count
    assert set(chosen) <= fitting
    shuffled = list(there)
    random.shuffle(shuffled)
    assert choose(wanted, shuffled, where="data")["some"] == chosen == tuple(sorted(chosen))


@given(st.integers(1, 9), st.integers(0, 5))
def test_a_source_that_asks_for_more_holds_what_it_held_before(count: int, seed: int) -> None:
    fewer, more = (
        set(choose(recipe(s={"count": n, "seed": seed}), episodes(10), where="data")["s"]) for n in (count, count + 1)
    )
    assert fewer < more


def test_a_source_is_the_same_episodes_whatever_else_the_recipe_and_the_dataset_hold() -> None:
    gray, purple = episodes(20), episodes(9, OFF_TARGET, prefix="p")
    source = {"where": {"object": "gray"}, "count": 5}
    alone = choose(recipe(gray=source), gray, where="data")["gray"]
    both = recipe(gray=source, purple={"where": {"object": "purple"}})
    assert choose(both, gray + purple, where="data") == {"gray": alone, "purple": tuple(one.id for one in purple)}


def test_seeds_choose_differently() -> None:
    chosen = {choose(recipe(s={"count": 3, "seed": seed}), episodes(30), where="data")["s"] for seed in range(5)}
    assert len(chosen) > 1


def test_an_episode_that_fits_two_sources_belongs_to_the_first_that_takes_it() -> None:
    both = choose(recipe(few={"count": 4}, rest={}), episodes(10), where="data")
    assert (len(both["few"]), len(both["rest"])) == (4, 6)
    assert not {*both["few"]} & {*both["rest"]}
    with pytest.raises(
        ActionSetError, match=r"'rest': there are too few for 7 episodes(.|\n)*6 of 10(.|\n)*4 more are in a"
    ):
        choose(recipe(few={"count": 4}, rest={"count": 7}), episodes(10), where="data")


def test_other_values_of_a_tag_are_asked_for_without_naming_them() -> None:
    there = episodes(3) + episodes(2, OFF_TARGET, prefix="p") + episodes(2, {"goal": "row"}, prefix="untagged")
    assert choose(recipe(s={"where_not": {"object": "gray"}}), there, where="data")["s"] == ("p000", "p001")
    several = recipe(s={"where": {"object": ["gray", "purple"]}})
    assert len(choose(several, there, where="data")["s"]) == 5


@pytest.mark.parametrize(
    ("source", "there", "said"),
    [
        ({"where": {"colour": "gray"}}, episodes(3), r"'s': no training episode has the tag 'colour'(.|\n)*goal, object, of 3"),
        ({"where_not": {"pose": "x"}}, episodes(3, {}), r"no training episode has the tag 'pose'(.|\n)*tags \(none\), of 3"),
        ({"where": {"object": "grey"}}, episodes(3), r"no training episode has object = grey(.|\n)*object = gray \(3\)"),
        ({"count": 4}, episodes(3), r"too few for 4 episodes(.|\n)*3 of 3 training episodes with any tags(.|\n)*--preset tiny"),
        ({"count": 2}, episodes(3, mute=2), r"1 of 3 training episodes with any tags; 2 more have no actions"),
        ({"count": 2}, episodes(3, masked=2), r"1 of 3 training episodes with any tags; 2 more have no valid step"),
        ({"count": 2}, episodes(4, mute=1, masked=2), r"1 of 4 .* any tags; 1 more have no actions; 2 more have no valid step\n"),
        ({"where_not": {"object": "gray"}}, episodes(3), r"too few for one episode(.|\n)*0 of 3(.|\n)*object not gray"),
    ],
)  # fmt: skip
def test_what_cannot_be_chosen_is_said_with_what_there_is(
    source: dict[str, Any], there: Sequence[Candidate], said: str
) -> None:
    with pytest.raises(ActionSetError, match=rf"^data/x: (.|\n)*{said}"):
        choose(recipe(s=source), there, where="data/x")


# --- weights


weights = st.lists(st.integers(1, 12), min_size=1, max_size=5)


@given(weights)
def test_repeats_are_the_smallest_whole_numbers_in_the_ratio_of_the_weights(given_weights: list[int]) -> None:
    times = repeats(given_weights)
    assert math.gcd(*times) == 1
    assert all(a * times[0] == b * given_weights[0] for a, b in zip(given_weights, times, strict=True))


@given(st.data(), weights)
def test_effective_epochs_account_for_every_sample_that_is_drawn(data: st.DataObject, given_weights: list[int]) -> None:
    sizes = data.draw(st.lists(st.integers(1, 99), min_size=len(given_weights), max_size=len(given_weights)))
    for drawn in (None, 1000):
        epochs = effective_epochs(sizes, given_weights, drawn=drawn)
        total = sum(n * over for n, over in zip(sizes, epochs, strict=True))
        assert total == pytest.approx(sum(sizes) if drawn is None else drawn)
    assert effective_epochs(sizes, [3] * len(sizes)) == pytest.approx([1.0] * len(sizes))


# --- recipes


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("source = 3", "source: "),
        ("", "source: Field required"),
        ("[source]", "a recipe needs a source"),
        ("[source.a]\ncuont = 3", r"unknown key source.a.cuont; did you mean 'count'"),
        ("sauce = 3\n[source.a]", r"unknown key sauce; did you mean 'source'"),
        ("[source.a]\ncount = 0", "source.a.count: "),
        ("[source.a]\nweight = 0", "source.a.weight: "),
        ("[source.a]\ncount = true", "source.a.count: "),
        ("[source.a]\ncount = 2.0", "source.a.count: "),
        ('[source.a]\nweight = "3"', "source.a.weight: "),
        ("[source.a]\nseed = false", "source.a.seed: "),
        ("video = true\n[source.a]", "video: "),
        ("presets = 3\n[source.a]", "`presets` holds tables"),
        ("[source.a]\nwhere = { success = true }", r'tags are text, such as success = "true"'),
        ("[source.a", "not valid TOML"),
    ],
)
def test_a_recipe_that_cannot_be_used_is_refused_in_words(text: str, said: str) -> None:
    with pytest.raises(SpecError, match=rf"mine.toml: (.|\n)*{said}"):
        parse_recipe(text, where="mine.toml")


PAPER = {  # task: (episodes of the small set, what hybrid adds, episodes of video)
    "arrange_blocks": (16, [60], 610),
    "nut_assembly": (10, [75, 75], 200),
    "pusht": (20, [None], None),
}


@pytest.mark.parametrize("task", PAPER)
def test_the_recipes_hold_the_papers_numbers_and_hybrid_is_small_and_off_target(task: str) -> None:
    assert recipe_names(task) == ["hybrid", "off_target", "small"]
    small, hybrid, off_target = (load_recipe(name, task)[1] for name in ("small", "hybrid", "off_target"))
    few, added, video = PAPER[task]
    assert [source.count for source in small.source.values()] == [few]
    assert [source.count for source in off_target.source.values()] == added
    assert hybrid.source == small.source | off_target.source
    assert list(hybrid.source) == [*small.source, *off_target.source]
    assert {small.video, hybrid.video, off_target.video} == {video}


def test_a_preset_overrides_a_recipe() -> None:
    text = "[source.a]\ncount = 9\nweight = 2\n[presets.tiny.source.a]\ncount = 1\n"
    assert parse_recipe(text, where="x").source["a"].count == 9
    tiny = parse_recipe(text, where="x", preset="tiny").source["a"]
    assert (tiny.count, tiny.weight) == (1, 2)
    with pytest.raises(SpecError, match=r"unknown preset \[presets.tinny\](.|\n)*did you mean 'tiny'"):
        parse_recipe(text.replace("tiny", "tinny"), where="x")


@pytest.mark.parametrize("preset", [None, "tiny", "cpu"])
@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("[presets.tiny.source.zz]\nweight = 3", r"\[presets.tiny\]: it has no source 'zz'(.|\n)*known: gray"),
        ("[presets.tiny.source.grey]\ncount = 1", r"no source 'grey' for a preset to change(.|\n)*did you mean 'gray'"),
        ("[presets.tiny.source.gray]\ncnt = 1", r"\[presets.tiny\]: (.|\n)*unknown key source.gray.cnt; did you mean 'count'"),
        ("[presets.cpu.source.gray]\ncount = 0", r"\[presets.cpu\]: (.|\n)*source.gray.count"),
    ],
)  # fmt: skip
def test_every_preset_is_proved_whenever_its_recipe_is_read(table: str, said: str, preset: str | None) -> None:
    with pytest.raises(SpecError, match=rf"mine.toml, (.|\n)*{said}"):
        parse_recipe(f"[source.gray]\ncount = 2\n{table}\n", where="mine.toml", preset=preset)


RECORDED = {  # task: what its own episodes are tagged, and those of its variants
    "arrange_blocks": {None: {"object": "gray_blocks"}, "off_target": {"object": "purple_blocks"}},
    "nut_assembly": {
        None: {"goal": "square_peg", "object": "square_nut"},
        "other_goals": {"goal": "round_peg", "object": "square_nut"},
        "other_objects": {"goal": "round_peg", "object": "round_nut"},
    },
    "pusht": {None: {"goal": "256,256,45"}, "off_target": {"goal": "356,356,45"}},
}


@pytest.mark.parametrize("preset", ["tiny", None])
@pytest.mark.parametrize("name", ["small", "hybrid", "off_target"])
@pytest.mark.parametrize("task", RECORDED)
def test_the_recipes_fit_what_is_recorded(task: str, name: str, preset: str | None) -> None:
    record, trains = load_task(task, preset=preset).record, []
    for variant, tags in RECORDED[task].items():
        n = record.episodes if variant is None else record.variants[variant].episodes
        trains += episodes(n - max(1, round(0.1 * n)), tags, prefix=variant or "e")  # the others validate
    recipe = load_recipe(name, task, preset=preset)[1]
    for source, chosen in choose(recipe, trains, where="data").items():
        assert len(chosen) >= (recipe.source[source].count or 1)


def test_a_recipe_that_is_not_there_names_those_there_are() -> None:
    with pytest.raises(SpecError, match=r"'pusht' has no recipe called 'hybird'(.|\n)*did you mean 'hybrid'"):
        load_recipe("hybird", "pusht")
    with pytest.raises(SpecError, match=r"'hanoi' has no recipe called 'small'(.|\n)*a path ending in .toml"):
        load_recipe("small", "hanoi")
    with pytest.raises(SpecError, match=r"no_such.toml: the recipe cannot be read"):
        load_recipe("no_such.toml", "hanoi")


def test_the_published_push_t_stores_get_the_tags_that_its_recipes_ask_for() -> None:
    task, hybrid = load_task("pusht"), load_recipe("hybrid", "pusht")[1]
    original, moved = (task.tags_of(name) for name in ("pusht_cchi_v7_replay.zarr", "pusht_keypoint_x356_y356.zarr"))
    assert hybrid.source["on_target"].fits(original)
    assert not hybrid.source["moved_goal"].fits(original)
    assert hybrid.source["moved_goal"].fits(moved)
    assert task.tags_of("mine.zarr") == {}
