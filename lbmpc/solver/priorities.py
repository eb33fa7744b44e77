"""Soft rows that give way in order: successive QPs, one a priority (lexicographic; Kerrigan and Maciejowski 2002).

A row is violated as it would be if there were no rows of less importance. So they are left out at first; what the more
important rows are then violated by is granted to them as bounds, which from there on are hard, and the next priority
joins. Weights would have to grow with every priority, with the horizon and with how steep rows are to each other.

Where all are soft with one weight and nothing that is violated could be mended by a row of less importance, that is
the same solution. It is looked at first, so that only a contradiction of two priorities costs more than one QP.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lbmpc.solver.least_distance import NO_ROWS, Nearest, Penalty, least_distance, violation

AT_ONCE = 1e-7
"""Of a row's scale: nearer to its bound a row counts as holding something up, further beyond it as violated."""
GRANTED = 1e-8
"""Of a row's scale, more than it was violated by: so that the next QP has a solution."""


class Eased(NamedTuple):
    """The bounds, (rows,) each, with what was granted to violated rows."""

    lower: np.ndarray
    upper: np.ndarray


def contradicts(
    values: np.ndarray, lower: np.ndarray, upper: np.ndarray, scale: np.ndarray, levels: np.ndarray
) -> bool:
    """Whether a row is violated while one of less importance, a larger level, is at its bound or beyond."""
    beyond = np.maximum(lower - values, values - upper) / scale
    violated, holding = levels[(beyond > AT_ONCE) & (levels >= 0)], levels[beyond > -AT_ONCE]
    return bool(violated.size and violated.min() < holding.max(initial=-1))


def in_order(
    y: np.ndarray,
    M: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    penalty: Penalty,
    levels: np.ndarray,
) -> tuple[Nearest, Eased] | None:
    """The minimiser, and the bounds with what it grants; None where the numbers are unusable.

    Arguments as for `least_distance`. levels: (rows,), the priority of soft rows, -1 of hard ones.
    """
    found, hint = None, NO_ROWS
    for level in sorted(set(levels[levels >= 0].tolist())):
        own, later = levels == level, levels > level
        low, high = np.where(later, -np.inf, lower), np.where(later, np.inf, upper)
        found = least_distance(y, M, low, high, replace(penalty, soft=own), hint)
        if found is None:
            return None
        hint = found.shown.seen
        outside = violation(found.values, low, high)
        granted = np.where(own & (outside > 0.0), outside + GRANTED * penalty.scale, 0.0)
        beyond = found.values > upper
        lower, upper = np.where(beyond, lower, lower - granted), np.where(beyond, upper + granted, upper)
    return None if found is None else (found, Eased(lower, upper))
