"""Robosuite worlds beside each other in one process."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("robosuite", reason="the simulators are not installed (make setup)")

from vilp_data.sims.hanoi import HanoiEnv  # noqa: E402
from vilp_data.sims.move_the_stack import MoveTheStackEnv  # noqa: E402


def test_a_world_draws_the_same_beside_another_and_after_another_was_closed() -> None:
    one = MoveTheStackEnv(2)
    alone = one.reset(seed=0)[0]
    another = HanoiEnv(1)
    another.reset(seed=0)
    assert np.array_equal(one.render(), np.concatenate([alone[view] for view in one.views], axis=1))
    another.close()
    assert np.array_equal(one.render(), np.concatenate([alone[view] for view in one.views], axis=1))
    one.close()
