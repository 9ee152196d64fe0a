"""Ways over a table: they end where they should, step by step, and keep clear where they can."""

from __future__ import annotations

import numpy as np
import pytest

from vilp_data.sims.free_way import CELL, Ways, cell_centres, clear_cost
from vilp_data.types import F64

CENTRES = cell_centres(800, 480)
START, GOAL = np.array([100.0, 240.0]), np.array([700.0, 240.0])


def nearest_approach(way: list[F64], thing: F64) -> float:
    return float(np.hypot(*(np.array([START, *way]) - thing).T).min())


def ways(*things: tuple[float, float], clear: float = 80.0) -> Ways:
    far = [(5000.0, 5000.0)]
    return Ways(START, CENTRES, clear_cost(CENTRES, np.array([*things, *far]), clear))


def test_the_grid_covers_the_table_with_x_before_y() -> None:
    assert CENTRES.shape == (24, 40, 2)
    np.testing.assert_array_equal(CENTRES[0, 0], [CELL / 2, CELL / 2])
    np.testing.assert_array_equal(CENTRES[-1, -1], [800 - CELL / 2, 480 - CELL / 2])


def test_an_empty_table_is_crossed_straight() -> None:
    way = ways().to(GOAL)
    np.testing.assert_array_equal(way[-1], GOAL)
    assert len(way) == 30
    assert all(abs(point[1] - 240) <= CELL / 2 for point in way)
    assert ways().cost_to(GOAL) == pytest.approx(29)  # 30 cells on, without the goal's own


def test_steps_lead_from_cell_to_neighbouring_cell() -> None:
    way = [START, *ways((400, 240)).to(GOAL)]
    assert np.abs(np.diff(way, axis=0)).max() <= 2 * CELL


@pytest.mark.parametrize("thing", [(400.0, 240.0), (300.0, 200.0), (500.0, 290.0)])
def test_a_way_goes_around_what_stands_in_it(thing: tuple[float, float]) -> None:
    assert nearest_approach(ways().to(GOAL), np.array(thing)) < 60
    assert nearest_approach(ways(thing).to(GOAL), np.array(thing)) >= 80 - CELL


def test_a_gap_that_is_too_narrow_is_taken_only_where_there_is_no_other_way() -> None:
    wall = [(400.0, y) for y in range(0, 480, 60)]
    way = ways(*wall).to(GOAL)
    np.testing.assert_array_equal(way[-1], GOAL)
    with_a_gap = [thing for thing in wall if not 300 < thing[1] < 440]
    crossing = [point for point in ways(*with_a_gap, clear=60).to(GOAL) if abs(point[0] - 400) < CELL]
    assert all(300 < point[1] < 440 for point in crossing)


def test_where_one_stands_already_costs_nothing_and_points_beside_the_grid_count_as_its_edge() -> None:
    assert ways().cost_to(START + 1) == 0
    np.testing.assert_array_equal(ways().to(START + 1)[-1], START + 1)
    assert ways().to(np.array([900.0, -50.0]))[-1].tolist() == [900, -50]
