"""The Arrange-Blocks environment: its starts, its rule of success, its pictures and its physics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vilp_data.errors import UsageError
from vilp_data.sims.arrange_blocks_table import BLOCK_SIDE, PUSHER_RADIUS, WORLD, draw_start, in_a_row, row_share

pytest.importorskip("pymunk", reason="the simulators are not installed: make setup")

from vilp_data.sims.arrange_blocks import ArrangeBlocksEnv

pytestmark = pytest.mark.sim

APART = np.array([60.0, 60.0, 200.0, 150.0, 0.0, 400.0, 240.0, 0.3, 600.0, 330.0, -0.5])
GRAY, PURPLE, BLUE = (119, 136, 153), (147, 88, 172), (65, 105, 225)


@pytest.fixture(scope="module")
def env():
    return ArrangeBlocksEnv()


def corners(state):
    """Of each block, float64 [3,4,2]."""
    half = BLOCK_SIDE / 2
    square = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    turns = [np.array([(math.cos(a), math.sin(a)), (-math.sin(a), math.cos(a))]) for a in state[2:].reshape(3, 3)[:, 2]]
    return np.stack([square @ turn + place for turn, place in zip(turns, state[2:].reshape(3, 3)[:, :2], strict=True)])


def apart(first, second):
    """Whether two convex polygons [n,2] have a line between them that is along an edge of one (separating axis)."""
    for polygon in (first, second):
        edges = np.roll(polygon, -1, axis=0) - polygon
        for axis in np.stack([-edges[:, 1], edges[:, 0]], axis=1):
            if (first @ axis).max() < (second @ axis).min() or (second @ axis).max() < (first @ axis).min():
                return True
    return False


# --- the rule ---


@pytest.mark.parametrize(
    ("y", "share"),
    [
        ((240, 240, 240), 1.0),
        ((240, 249.99, 230.01), 1.0),  # of the first block alone: the others may be 20 apart
        ((240, 250, 240), 0.5),  # "<", not "<="
        ((240, 240, 229.99), 0.5),
        ((250, 240, 240), 0.0),  # the first is the odd one
        ((100, 240, 380), 0.0),
    ],
)
def test_success_is_the_papers_rule_on_the_first_blocks_y(y, share):
    assert row_share(y) == share
    assert in_a_row(y) == (share == 1)


def test_x_and_angle_do_not_matter_to_success(env):
    row = APART.copy()
    row[[3, 6, 9]] = 200, 205, 195
    _, reward, terminated, truncated, info = ended = stepped(env, row)
    assert (reward, terminated, truncated, info["is_success"]) == (1.0, True, False, True), ended
    row[6] = 215
    _, reward, terminated, _, info = stepped(env, row)
    assert (reward, terminated, info["is_success"]) == (0.5, False, False)


def stepped(env, state):
    """One step in which the pusher stays where it is."""
    env.reset(options={"state": state})
    return env.step(state[:2])


# --- starts ---


@pytest.mark.parametrize("first", range(0, 200, 50))
def test_no_start_overlaps_or_is_solved_or_leaves_the_table(first):
    for seed in range(first, first + 50):
        state = draw_start(np.random.default_rng(seed))
        blocks = corners(state)
        assert all(apart(blocks[i], blocks[j]) for i, j in ((0, 1), (0, 2), (1, 2)))
        assert blocks.min() > PUSHER_RADIUS
        assert (blocks < np.array(WORLD) - PUSHER_RADIUS).all()
        assert np.hypot(*(state[2:].reshape(3, 3)[:, :2] - state[:2]).T).min() > BLOCK_SIDE / 2 + PUSHER_RADIUS
        assert not in_a_row(state[[3, 6, 9]])


def test_nothing_moves_at_a_start_until_something_is_pushed(env):
    for seed in range(20):
        _, info = env.reset(seed=seed)
        after = env.step(info["hold_action"])[4]["state"]
        np.testing.assert_allclose(after, info["state"], atol=1e-6)


def test_the_same_seed_gives_the_same_start_and_starts_differ_in_every_number(env):
    starts = np.array([env.reset(seed=seed)[1]["state"] for seed in range(30)])
    np.testing.assert_array_equal(env.reset(seed=7)[1]["state"], starts[7])
    assert (np.ptp(starts[:, [0, 1, 2, 3, 5, 6, 8, 9]], axis=0) > 150).all()
    assert (np.ptp(starts[:, [4, 7, 10]], axis=0) > math.pi / 4).all()
    order = {tuple(np.argsort(start[[2, 5, 8]])) for start in starts}
    assert len(order) == 6  # which block stands leftmost is drawn too


position = st.tuples(st.floats(80, 720), st.floats(80, 400), st.floats(0, 2 * math.pi, exclude_max=True))


@given(st.tuples(st.floats(20, 780), st.floats(20, 460)), st.tuples(position, position, position))
@settings(max_examples=50, deadline=None)
def test_reset_restores_any_state_exactly(pusher, blocks):
    state = np.array([*pusher, *np.ravel(blocks)])
    _, info = ArrangeBlocksEnv(cameras=False).reset(options={"state": state})
    np.testing.assert_allclose(info["state"], state, atol=1e-9)


def test_a_state_of_another_shape_and_another_colour_are_refused(env):
    with pytest.raises(UsageError, match="block3_angle"):
        env.reset(options={"state": np.zeros(5)})
    with pytest.raises(UsageError, match="purpel.*\n.*did you mean 'purple'"):
        ArrangeBlocksEnv(colour="purpel")


# --- pictures ---


@pytest.mark.parametrize(("colour", "rgb"), [("gray", GRAY), ("purple", PURPLE)])
def test_blocks_are_drawn_in_their_colour_where_the_state_says(colour, rgb):
    env = ArrangeBlocksEnv(colour=colour)
    picture = env.reset(options={"state": APART})[0]["top"]
    assert picture.shape == (96, 160, 3)
    for x, y in APART[2:].reshape(3, 3)[:, :2]:
        assert tuple(picture[round(y / 5), round(x / 5)]) == rgb
    covered = (255.0 - picture[5:-5, 20:-5]).sum(axis=2) / (
        255.0 - np.array(rgb)
    ).sum()  # neither the walls nor the pusher
    assert covered.sum() == pytest.approx(3 * (BLOCK_SIDE / 5) ** 2, rel=0.01)
    rows, columns = np.indices(covered.shape) + np.array([5.5, 20.5])[:, None, None]
    assert (columns * covered).sum() / covered.sum() * 5 == pytest.approx(APART[[2, 5, 8]].mean(), abs=0.5)
    assert (rows * covered).sum() / covered.sum() * 5 == pytest.approx(APART[[3, 6, 9]].mean(), abs=0.5)
    assert env.tags() == {"goal": "row", "object": f"{colour}_blocks"}


def test_the_pusher_is_blue_and_where_low_dim_says(env):
    observation, info = env.reset(options={"state": APART})
    picture = observation["top"].astype(int)
    blue = np.abs(picture - BLUE).sum(axis=2) < 60
    row, column = (np.argwhere(blue).mean(axis=0) + 0.5) * 5
    assert np.abs(np.array([column, row]) - observation["low_dim"]).max() < 1.5
    np.testing.assert_array_equal(observation["low_dim"], info["hold_action"])


def test_a_tenth_of_a_pixel_shows_in_the_picture(env):
    """A row is 2 px of the picture: its edges must tell much less than that."""
    moved = APART.copy()
    moved[3] += 0.5
    first, second = (env.reset(options={"state": state})[0]["top"].astype(int) for state in (APART, moved))
    upper, lower = np.split((second - first)[10:50, 30:50].sum(axis=(1, 2)), 2)  # around the first block
    assert upper.sum() > 300  # its upper edge fades, its lower one grows: 17 px by a tenth of 357 levels, about 600
    assert lower.sum() < -300


def test_the_larger_picture_is_drawn_only_where_asked_for(env):
    assert env.render() is None
    large = ArrangeBlocksEnv("rgb_array", cameras=False)
    assert set(large.reset(options={"state": APART})[0]) == {"low_dim"}
    assert large.render().shape == (480, 800, 3)
    assert tuple(large.render()[240, 400]) == GRAY


def test_observations_and_actions_fit_their_spaces(env):
    env.action_space.seed(0)
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert env.observation_space.contains(env.step(env.action_space.sample())[0])


# --- physics ---


def test_the_pusher_reaches_a_target_and_pushes_what_stands_in_its_way_straight_on(env):
    upright = APART.copy()
    upright[[4, 7, 10]] = 0
    env.reset(options={"state": upright})
    for target in ([200.0, 60.0], [200.0, 160.0]):
        for _ in range(25):
            _, _, _, _, info = env.step(np.array(target, np.float32))
    state = info["state"]
    assert np.abs(state[:2] - (200, 160)).max() < 0.5
    assert state[3] == pytest.approx(160 + PUSHER_RADIUS + BLOCK_SIDE / 2, abs=1)
    assert state[2] == pytest.approx(200, abs=1)
    np.testing.assert_allclose(state[5:], upright[5:], atol=1e-6)


def test_what_is_not_pushed_any_more_stands_still(env):
    env.reset(options={"state": APART})
    for target in ([200.0, 60.0], [200.0, 160.0], [200.0, 60.0]):
        for _ in range(15):
            _, _, _, _, info = env.step(np.array(target, np.float32))
    before = info["state"]
    after = env.step(np.array([200.0, 60.0], np.float32))[4]["state"]
    np.testing.assert_allclose(after[2:], before[2:], atol=1e-9)


def test_nothing_of_an_earlier_episode_survives_a_reset(env):
    def played():
        env.reset(options={"state": APART})
        return np.stack([env.step(np.array([210.0, 200.0], np.float32))[4]["state"] for _ in range(15)])

    first = played()  # ends in contact with a block, moving
    np.testing.assert_array_equal(played(), first)


def test_targets_beyond_the_table_are_taken_at_its_edge(env):
    env.reset(options={"state": APART})
    for _ in range(30):
        _, _, _, _, info = env.step(np.array([-500.0, 1000.0], np.float32))
    np.testing.assert_allclose(info["state"][:2], [0, 480], atol=1)
