"""The split: exact counts, no leak, nothing ever moves."""

from __future__ import annotations

import dataclasses
from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_data.duplicates import thumbnails
from vilp_data.errors import SplitError
from vilp_data.split import SplitEpisode, SplitLock, check_split, draw_split


def plain(count: int, *, start: int = 0) -> list[SplitEpisode]:
    return [SplitEpisode(f"episode-{i:03}", content_hash=f"content-{i}") for i in range(start, start + count)]


def sides(lock: SplitLock, episodes: list[SplitEpisode]) -> Counter[str]:
    return Counter(lock.assignment[episode.id] for episode in episodes)


def components(episodes: list[SplitEpisode]) -> list[set[str]]:
    """Ids joined by equal groups, contents or twin hashes, merged until nothing changes: the slow reference."""
    joined = [
        {
            e.id
            for e in episodes
            if e.group == o.group is not None
            or e.content_hash == o.content_hash
            or e.twin_hash == o.twin_hash is not None
        }
        for o in episodes
    ]
    while True:
        for a, b in combinations(joined, 2):
            if a & b:
                joined = [ids for ids in joined if ids is not a and ids is not b] + [a | b]
                break
        else:
            return joined


@st.composite
def episode_sets(draw: st.DrawFn) -> list[SplitEpisode]:
    """2 to 24 episodes with clashing groups, contents, twins and strata, that are not all one component."""
    count = draw(st.integers(2, 24))
    grouped = draw(st.booleans())
    episodes = [
        SplitEpisode(
            id=f"e{i:02}",
            content_hash=f"c{draw(st.integers(0, 30))}",
            group=f"g{draw(st.integers(0, 12))}" if grouped else None,
            strata=(draw(st.sampled_from("xyz")),),
            twin_hash=draw(st.none() | st.integers(0, 30).map("t{}".format)),
        )
        for i in range(count)
    ]
    if len(components(episodes)) == 1:
        episodes.append(SplitEpisode("other", content_hash="other", group="other" if grouped else None, strata=("x",)))
    return episodes


ratios = st.floats(0.05, 0.95)
seeds = st.integers(0, 2**32)


@given(st.integers(2, 200), ratios, seeds)
def test_validation_gets_exactly_its_share(count: int, ratio: float, seed: int) -> None:
    lock = draw_split(plain(count), ratio=ratio, seed=seed)
    assert sides(lock, plain(count))["val"] == min(max(round((1 - ratio) * count), 1), count - 1)


@given(episode_sets(), ratios, seeds)
def test_groups_and_identical_episodes_stay_together(episodes: list[SplitEpisode], ratio: float, seed: int) -> None:
    lock = draw_split(episodes, ratio=ratio, seed=seed)
    for ids in components(episodes):
        assert len({lock.assignment[id] for id in ids}) == 1
    assert set(lock.assignment.values()) == {"train", "val"}
    assert check_split(lock, episodes) == []


@given(episode_sets(), ratios, seeds)
def test_uneven_groups_come_as_near_as_whole_groups_can(episodes: list[SplitEpisode], ratio: float, seed: int) -> None:
    sizes = [len(ids) for ids in components(episodes)]
    sums = {0}
    for size in sizes:
        sums |= {total + size for total in sums}
    wanted = min(max(round((1 - ratio) * len(episodes)), 1), len(episodes) - 1)
    nearest = min(abs(total - wanted) for total in sums if 0 < total < len(episodes))
    lock = draw_split(episodes, ratio=ratio, seed=seed)
    assert abs(sides(lock, episodes)["val"] - wanted) == nearest


@given(episode_sets(), seeds, st.randoms())
def test_order_of_episodes_does_not_matter(episodes: list[SplitEpisode], seed: int, random: object) -> None:
    mixed = list(episodes)
    random.shuffle(mixed)  # type: ignore[attr-defined]
    first, second = draw_split(episodes, ratio=0.8, seed=seed), draw_split(mixed, ratio=0.8, seed=seed)
    assert first.to_json() == second.to_json()


@given(episode_sets(), st.integers(0, 12), ratios, seeds)
def test_split_is_stable_when_episodes_are_added(
    episodes: list[SplitEpisode], added: int, ratio: float, seed: int
) -> None:
    before = draw_split(episodes, ratio=ratio, seed=seed)
    grouped = episodes[0].group is not None
    more = [dataclasses.replace(e, group=e.id if grouped else None) for e in plain(added)]
    after = draw_split(episodes + more, ratio=ratio, seed=seed + 1, previous=before)
    assert {id: after.assignment[id] for id in before.assignment} == before.assignment
    assert set(after.assignment) == {episode.id for episode in episodes + more}


def test_split_with_nothing_new_is_the_same_bytes() -> None:
    lock = draw_split(plain(30), ratio=0.9, seed=3)
    assert draw_split(plain(30), ratio=0.9, seed=99, previous=lock).to_json() == lock.to_json()


def test_additions_come_nearest_to_the_ratio_over_all_episodes() -> None:
    lock = draw_split(plain(10), ratio=0.9, seed=0)
    for count in (11, 19, 20, 37, 60):
        lock = draw_split(plain(count), ratio=0.9, seed=0, previous=lock)
        assert sides(lock, plain(count))["val"] == round(0.1 * count)


def test_another_seed_draws_another_split() -> None:
    drawn = {tuple(draw_split(plain(40), ratio=0.8, seed=seed).ids("val")) for seed in range(8)}
    assert len(drawn) == 8


def test_every_episode_validates_equally_often_over_seeds() -> None:
    counts = Counter(id for seed in range(400) for id in draw_split(plain(10), ratio=0.8, seed=seed).ids("val"))
    assert len(counts) == 10
    assert all(50 < count < 115 for count in counts.values())  # 80 expected, 4.4 standard deviations


def test_strata_share_validation_by_largest_remainder() -> None:
    strata = ["left"] * 50 + ["right"] * 27 + ["rare"] * 13 + ["once"] + ["unique"]
    episodes = [dataclasses.replace(e, strata=(s,)) for e, s in zip(plain(92), strata, strict=True)]
    lock = draw_split(episodes, ratio=0.8, seed=5)
    validates = Counter(stratum for e, stratum in zip(episodes, strata, strict=True) if lock.assignment[e.id] == "val")
    # round(0.2 * 92) = 18: exact shares 9.78, 5.28, 2.54 and, for the two singletons pooled, 0.39
    assert [validates[s] for s in ("left", "right", "rare")] == [10, 5, 3]
    assert validates["once"] + validates["unique"] == 0


def test_a_copy_under_another_name_follows_the_original() -> None:
    lock = draw_split(plain(20), ratio=0.5, seed=0)
    for original in plain(20):
        copy = SplitEpisode("copy", content_hash=original.content_hash)
        after = draw_split([*plain(20), copy], ratio=0.5, seed=0, previous=lock)
        assert after.assignment["copy"] == lock.assignment[original.id]
        assert after.duplicates == (("copy", original.id),)


def test_vanished_episodes_keep_their_side_even_when_renamed() -> None:
    lock = draw_split(plain(20), ratio=0.5, seed=0)
    without = draw_split(plain(20)[5:], ratio=0.5, seed=0, previous=lock)
    assert without.assignment == lock.assignment
    renamed = [dataclasses.replace(e, id=f"renamed-{e.id}") for e in plain(5)]
    after = draw_split(renamed + plain(20)[5:], ratio=0.5, seed=0, previous=without)
    assert [after.assignment[e.id] for e in renamed] == [lock.assignment[e.id] for e in plain(5)]
    assert "episode-000, " in check_split(without, plain(20)[5:])[0]


def test_a_newcomer_that_joins_both_sides_is_refused() -> None:
    lock = draw_split(plain(10), ratio=0.5, seed=0)
    train, val = lock.ids("train")[0], lock.ids("val")[0]
    by_id = {e.id: e for e in plain(10)}
    newcomer = SplitEpisode("new", content_hash=by_id[train].content_hash, group=val)
    with pytest.raises(SplitError, match=r"both sides(.|\n)*--redraw"):
        draw_split([*plain(10), newcomer], ratio=0.5, seed=0, previous=lock)


def test_a_ratio_from_the_command_line_outranks_the_task_from_then_on() -> None:
    first = draw_split(plain(40), ratio=0.9, seed=0)
    told = draw_split(plain(40), ratio=0.5, seed=0, ratio_from="command line", previous=first, redraw=True)
    assert sides(told, plain(40))["val"] == 20
    later = draw_split(plain(80), ratio=0.9, seed=0, previous=told)
    assert (later.ratio, later.ratio_from) == (0.5, "command line")
    assert sides(later, plain(80))["val"] == 40
    redrawn = draw_split(plain(80), ratio=0.9, seed=0, previous=later, redraw=True)
    assert redrawn.ratio == 0.5


def test_a_new_ratio_moves_nothing_and_the_check_says_so() -> None:
    lock = draw_split(plain(40), ratio=0.9, seed=0)
    told = draw_split(plain(40), ratio=0.5, seed=0, ratio_from="command line", previous=lock)
    assert told.assignment == lock.assignment
    assert check_split(told, plain(40)) == [
        "4 of 40 episodes validate where ratio 0.5 asks for 20: "
        "locked episodes never move; `vilp-data split --redraw` starts over"
    ]


def test_redraw_forgets_the_assignment() -> None:
    lock = draw_split(plain(40), ratio=0.5, seed=0)
    again = draw_split(plain(40)[3:], ratio=0.5, seed=1, previous=lock, redraw=True)
    assert again.to_json() == draw_split(plain(40)[3:], ratio=0.5, seed=1).to_json()


@given(episode_sets(), ratios)
def test_lock_survives_its_file(episodes: list[SplitEpisode], ratio: float) -> None:
    lock = draw_split(episodes, ratio=ratio, seed=1, group_by="operator", strata=("object",))
    back = SplitLock.from_json(lock.to_json())
    assert back == lock
    assert back.to_json() == lock.to_json()


def test_check_reports_a_changed_assignment() -> None:
    lock = draw_split(plain(10), ratio=0.5, seed=0)
    text = lock.to_json().replace(b'"episode-000": "train"', b'"episode-000": "val"', 1)
    if text == lock.to_json():
        text = lock.to_json().replace(b'"episode-000": "val"', b'"episode-000": "train"', 1)
    changed = SplitLock.from_json(text)
    assert not changed.is_intact
    assert "changed by hand" in check_split(changed, plain(10))[0]


def test_check_reports_unassigned_episodes() -> None:
    lock = draw_split(plain(10), ratio=0.5, seed=0)
    assert check_split(lock, plain(12)) == ["episode-010, episode-011 without a side: run `vilp-data split`"]


def test_twins_follow_each_other_also_where_one_has_vanished() -> None:
    known = [dataclasses.replace(e, twin_hash=f"actions-{e.id}") for e in plain(20)]
    lock = draw_split(known, ratio=0.5, seed=0)
    assert lock.assignment == draw_split(plain(20), ratio=0.5, seed=0).assignment  # no two of them are twins
    for original in known:
        twin = SplitEpisode("twin", content_hash="other pictures", twin_hash=original.twin_hash)
        for there in (known, [e for e in known if e is not original]):
            after = draw_split([*there, twin], ratio=0.5, seed=0, previous=lock)
            assert after.assignment["twin"] == lock.assignment[original.id]
            assert after.twin_groups == [[original.id, "twin"]]
            assert after.duplicates == ()


def test_twins_that_an_older_split_put_on_both_sides_stay_and_are_told() -> None:
    lock = draw_split(plain(10), ratio=0.5, seed=0)
    assert b"twins" not in lock.to_json()
    train, val = lock.ids("train")[0], lock.ids("val")[0]
    twins = [dataclasses.replace(e, twin_hash="same" if e.id in (train, val) else None) for e in plain(10)]
    told = [f"identical actions 'same' on both sides: {train} in training, {val} in validation"]
    assert check_split(lock, twins) == told
    after = draw_split(twins, ratio=0.5, seed=0, previous=lock)
    assert (after.assignment, after.hash) == (lock.assignment, lock.hash)
    assert check_split(after, plain(10)) == told  # it remembers
    apart = draw_split(twins, ratio=0.5, seed=0, previous=lock, redraw=True)
    assert apart.assignment[train] == apart.assignment[val]


@pytest.mark.parametrize("what", ["group", "identical content", "identical actions"])
def test_check_reports_leaks(what: str) -> None:
    lock = draw_split(plain(10), ratio=0.5, seed=0)
    train, val = lock.ids("train")[0], lock.ids("val")[0]
    fields = {"group": "group", "identical content": "content_hash", "identical actions": "twin_hash"}
    episodes = [dataclasses.replace(e, **{fields[what]: "both"}) if e.id in (train, val) else e for e in plain(10)]
    assert check_split(lock, episodes) == [f"{what} 'both' on both sides: {train} in training, {val} in validation"]


def test_check_reports_an_empty_side() -> None:
    lock = draw_split(plain(10), ratio=0.9, seed=0)
    left = [e for e in plain(10) if lock.assignment[e.id] == "train"]
    assert "no val episode is left" in check_split(lock, left)[-1]
    with pytest.raises(SplitError, match="would be empty"):
        draw_split(left, ratio=0.9, seed=0, previous=lock)


def test_near_identical_episodes_are_reported_and_not_moved() -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, 9, 48, 64, 3), dtype=np.uint8)
    recoded = np.clip(frames[0].astype(int) + rng.integers(-2, 3, frames[0].shape), 0, 255).astype(np.uint8)
    shots = [*frames, recoded]
    episodes = [dataclasses.replace(e, thumbnails=thumbnails(f)) for e, f in zip(plain(3), shots, strict=True)]
    lock = draw_split(episodes, ratio=0.5, seed=0)
    assert lock.assignment == draw_split(plain(3), ratio=0.5, seed=0).assignment
    assert [(pair.first, pair.second) for pair in lock.near_duplicates] == [("episode-000", "episode-002")]
    assert 0 < lock.near_duplicates[0].distance < 1


def test_thumbnails_are_cell_means_of_first_middle_and_last() -> None:
    frames = np.zeros((5, 16, 24, 3), np.uint8)
    frames[0], frames[2, :2, :3], frames[4, -2:, -3:] = 10, 200, 100
    small = thumbnails(frames)
    assert small.shape == (3, 8, 8)
    assert (small[0] == 10).all()
    assert small[1, 0, 0] == 200
    assert small[1].sum() == 200
    assert small[2, 7, 7] == 100


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "at least two episodes"),
        (plain(1), "at least two episodes"),
        (plain(2) + plain(1), "two episodes of one name"),
        ([dataclasses.replace(e, group="one") for e in plain(9)], "would be empty"),
    ],
)
def test_what_cannot_be_split_is_refused_with_a_remedy(episodes: list[SplitEpisode], message: str) -> None:
    with pytest.raises(SplitError, match=message) as caught:
        draw_split(episodes, ratio=0.9, seed=0)
    assert caught.value.remedy


@pytest.mark.parametrize("ratio", [0.0, 1.0, -1.0, 2.0, float("nan")])
def test_a_ratio_outside_0_to_1_is_refused(ratio: float) -> None:
    with pytest.raises(SplitError, match="between 0 and 1"):
        draw_split(plain(9), ratio=ratio, seed=0)


@pytest.mark.parametrize("data", [b"", b"\xff", b"[]", b"{}", b'{"format": 2}', b'{"format": 1, "assignment": {}}'])
def test_what_is_no_lock_is_refused(data: bytes) -> None:
    with pytest.raises(SplitError, match="--redraw"):
        SplitLock.from_json(data)


def test_a_lock_with_an_unknown_side_is_refused() -> None:
    text = draw_split(plain(4), ratio=0.5, seed=0).to_json().replace(b'"val"', b'"test"')
    with pytest.raises(SplitError, match="'test' is none of train, val"):
        SplitLock.from_json(text)
