"""Twins: the same motion beside other pictures."""

from __future__ import annotations

import numpy as np

from vilp_data.twins import twin_hash


def steps(**changed: np.ndarray) -> dict[str, np.ndarray]:
    ramp = np.arange(12, dtype=np.float32).reshape(6, 2)
    return {"action": ramp, "low_dim": ramp + 1, "valid": np.ones(6, bool), **changed}


def test_the_same_motion_is_the_same_and_any_other_number_is_not() -> None:
    assert twin_hash(steps()) == twin_hash(steps(valid=np.zeros(6, bool)))
    for name in ("action", "low_dim"):
        other = steps()[name].copy()
        other[3, 1] += 1e-5
        assert twin_hash(steps(**{name: other})) != twin_hash(steps())


def test_what_has_no_labels_to_give_away_has_no_twins() -> None:
    """Robots that stand still all do the same."""
    still = np.full((6, 2), 0.5, np.float32)
    assert twin_hash(steps(action=still, low_dim=still)) is None
    assert twin_hash({name: array for name, array in steps().items() if name != "action"}) is None
    assert twin_hash(steps(action=still)) is not None
    unknown = np.full((6, 2), np.nan, np.float32)
    assert twin_hash(steps(action=unknown, low_dim=still)) is not None
