"""A fixture with a family of sets that is constructed once."""

from __future__ import annotations

import numpy as np
import pytest

from lbmpc.sets.certificate import Certificate
from lbmpc.sets.construct import construct
from tests.helpers.plants.pendulum import pendulum

MODEL = pendulum()
START = np.array([0.62, 0.0])


@pytest.fixture(scope="session")
def family() -> Certificate:
    """Return a base set and a chain of pieces from a state outside of it."""
    found = construct(MODEL, "regions", START)
    assert len(found.pieces) > 3
    return found
