"""Relaxation of soft rows in order of priority: successive QPs (lexicographic; Kerrigan and Maciejowski 2002).

The violation of a row does not depend on less important rows. The less important rows are left out at first. The
violations of the important rows are then granted as hard bounds, and the next priority is added. With weights instead
of QPs, the weights would have to grow with every priority, with the horizon and with the angles between rows.

If all rows are soft with one weight, and no violation could be reduced by relaxing a less important row, the solution
is the same. This case is checked first, so only a conflict of two priorities needs more than one QP.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lbmpc.solver.least_distance import NO_ROWS, Nearest, Penalty, least_distance, violation

AT_ONCE = 1e-7
"""Share of a row's scale. A row counts as active within this distance of its bound, and as violated beyond it."""
GRANTED = 1e-8
"""Share of a row's scale that is granted in addition to the violation, so that the next QP is feasible."""


class Eased(NamedTuple):
    """The bounds, (rows,) each, with the relaxations granted to violated rows."""

    lower: np.ndarray
    upper: np.ndarray


def contradicts(
    values: np.ndarray, lower: np.ndarray, upper: np.ndarray, scale: np.ndarray, levels: np.ndarray
) -> bool:
    """Return whether a row is violated while a less important one, with a larger level, is active or violated."""
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
    """Return the minimiser and the relaxed bounds; None if the numbers are not finite.

    Arguments as for `least_distance`. levels: (rows,), the priority of soft rows, -1 for hard rows.
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
