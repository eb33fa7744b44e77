"""Helpers for tests of rigorous bounds: exact comparison, and a plant with given equations."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from lbmpc.plants.equations import Plant
from lbmpc.sets.enclosures.interval import Interval

# Error of the integrator of the truth, relative to the size of the state.
TRUTH = 1e-11


def holds(bound: Interval, i: int, exact: Fraction) -> bool:
    """Return whether the bound contains the exact value; infinity bounds everything on its side."""
    low, high = float(bound.lower[i]), float(bound.upper[i])
    return (low == -np.inf or Fraction(low) <= exact) and (high == np.inf or exact <= Fraction(high))


def a_plant(
    rhs, name: str = "textbook", low: float = -1.0, high: float = 1.0, x_e=(0.0, 0.0), u_e=0.0
) -> Plant:
    two = np.ones(2)
    return Plant(
        name=name,
        states=("a", "b"),
        inputs=("u",),
        units={"a": "1", "b": "1", "u": "1", "t": "s"},
        rhs=rhs,
        x_e=np.array(x_e),
        u_e=np.array([u_e]),
        x_min=low * two,
        x_max=high * two,
        u_min=np.array([low]),
        u_max=np.array([high]),
        W=two,
        x0=np.zeros(2),
        safe_input=np.zeros(1),
        performance=(0,),
        kernel=("a",),
    )
