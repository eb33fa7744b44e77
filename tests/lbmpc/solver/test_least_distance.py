"""The QP of one Gauss-Newton step at the edges of its tolerances."""

from __future__ import annotations

import numpy as np
import pytest

from lbmpc.solver.least_distance import PRIMAL_TOLERANCE, Penalty, least_distance


@pytest.mark.parametrize("soft", [True, False])
def test_a_row_outside_by_less_than_the_tolerance_holds_nothing_back(soft: bool) -> None:
    bounds = np.ones(2)
    penalty = Penalty(np.array([True, True]), bounds, 1e4) if soft else None
    values = np.array([1.0 + 0.5 * PRIMAL_TOLERANCE, 0.0])
    nearest = least_distance(values, np.eye(2), -bounds, bounds, penalty)
    assert nearest is not None
    assert (nearest.w == 0.0).all()
    assert (nearest.values == values).all()
    assert nearest.shown.seen.size == 0
