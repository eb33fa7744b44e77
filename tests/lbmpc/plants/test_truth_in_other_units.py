"""The tolerance of the integration is relative to the half-widths, so it does not depend on units."""

from __future__ import annotations

import numpy as np

from lbmpc.plants import Truth
from tests.helpers.plants.pendulum import PENDULUM
from tests.helpers.rescaled import rescaled


def test_a_state_of_a_billionth_is_integrated_like_a_state_of_one() -> None:
    x, u = np.array([0.5, -0.5]), np.array([0.3])
    tiny = Truth(rescaled(PENDULUM, [1e-9, 1e-9], [1.0])).step(x * 1e-9, u, 1.0)
    np.testing.assert_allclose(tiny / 1e-9, Truth(PENDULUM).step(x, u, 1.0), rtol=0, atol=1e-10)
