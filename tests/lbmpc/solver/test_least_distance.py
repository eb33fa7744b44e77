"""The QP of one Gauss-Newton step at the limits of its tolerances."""

from __future__ import annotations

import numpy as np
import pytest

from lbmpc.solver.least_distance import PRIMAL_TOLERANCE, Penalty, least_distance


@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_a_violation_below_the_tolerance_has_no_effect(soft: bool, scale: float) -> None:
    penalty = Penalty(np.array([soft, soft]), np.array([scale, 1.0]), 1e4)
    bounds = penalty.scale
    values = np.array([scale * (1.0 + 0.5 * PRIMAL_TOLERANCE), 0.0])
    nearest = least_distance(values, np.diag(bounds), -bounds, bounds, penalty)
    assert nearest is not None
    assert (nearest.w == 0.0).all()
    assert (nearest.values == values).all()
    assert nearest.shown.seen.size == 0
