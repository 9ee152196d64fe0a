"""Quaternions with w last turn as rotation matrices do, whichever of their two signs they come with."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vilp_data import rotations
from vilp_data.types import F64

NUMBER = st.floats(-3, 3)
VECTORS = st.tuples(NUMBER, NUMBER, NUMBER).map(np.array)
UNIT = (
    st.tuples(NUMBER, NUMBER, NUMBER, NUMBER)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(rotations.unit)
)


def matrix(q: F64) -> F64:
    """The rotation matrix of a unit quaternion, written down from the textbook."""
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@given(UNIT, UNIT, VECTORS)
def test_products_conjugates_and_turned_vectors_are_those_of_matrices(a: F64, b: F64, v: F64) -> None:
    np.testing.assert_allclose(matrix(rotations.product(a, b)), matrix(a) @ matrix(b), atol=1e-12)
    np.testing.assert_allclose(matrix(rotations.conjugate(a)), matrix(a).T, atol=1e-12)
    np.testing.assert_allclose(rotations.turned(a, v), matrix(a) @ v, atol=1e-12)


@given(VECTORS)
def test_an_axis_angle_goes_through_a_quaternion_and_back(v: F64) -> None:
    angle = np.linalg.norm(v)
    back = rotations.to_axis_angle(rotations.from_axis_angle(v))
    if angle <= np.pi:
        np.testing.assert_allclose(back, v, atol=1e-9)
    else:  # the short way round
        np.testing.assert_allclose(back, v * (1 - 2 * np.pi / angle), atol=1e-9)


@given(st.lists(st.tuples(VECTORS, st.sampled_from([-1.0, 1.0])), min_size=1, max_size=20))
def test_signs_that_flip_become_continuous_and_the_first_stays(turns: list[tuple[F64, float]]) -> None:
    small = [rotations.from_axis_angle(v / 20) for v, _ in turns]  # at most half a radian apart
    signs = np.array([sign for _, sign in turns])
    found = rotations.continuous(np.array(small) * signs[:, None])
    np.testing.assert_array_equal(found, np.array(small) * signs[0])


def test_quaternions_that_were_never_set_are_no_numbers_and_are_passed_over() -> None:
    q = np.array([[0, 0, 0, 1.0], [0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1], [0, 0, 0.1, -1]])
    found = rotations.continuous(q)
    assert np.isfinite(found).all(axis=1).tolist() == [True, False, False, False, True]
    assert found[4].tolist() == [0, 0, -0.1, 1]
    assert np.isnan(rotations.unit(q[1])).all()
    assert rotations.continuous(np.zeros((0, 4))).shape == (0, 4)
    assert np.isnan(rotations.continuous(np.zeros((3, 4)))).all()
