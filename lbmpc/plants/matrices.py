"""Checks of a pair of matrices with messages for a person: shapes, numbers, and modes that no input moves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from lbmpc.plants.description import Description
from lbmpc.plants.faults import numeric, shown

UNMOVED = 1e-9
"""Share of the largest singular value of (A B), in half-widths, below which a mode counts as not moved by inputs."""
MARGINAL = 1e-9
"""Share of the largest eigenvalue. A mode counts as stable if it is stable by this margin."""
LARGEST = 1e100
"""Largest number in half-widths, so that its square is finite."""
PART = 0.1
"""Share of the largest component of a mode. A state with a smaller one is not named."""


def matrix_faults(A: Any, B: Any, period: Any, states: Sequence[str], inputs: Sequence[str]) -> Iterator[str]:
    """Check shapes and numbers of dx/dt = A x + B u, or of x+ = A x + B u every `period` seconds."""
    rows = {len(matrix) if numeric(matrix) and matrix.ndim == 2 else len(states) for matrix in (A, B)}
    if len(rows) == 1 and rows != {len(states)}:
        named = f"{len(states)} states are named ({', '.join(states)})"
        yield f"{named}, but A and B have {min(rows)} rows: name each state once"
        return
    for name, matrix, columns in (("A", A, states), ("B", B, inputs)):
        shape = (len(states), len(columns))
        if not numeric(matrix):
            yield f"{name} is {shown(matrix)}: give a matrix of numbers, a row for each of {', '.join(states)}"
        elif matrix.shape != shape:
            yield (
                f"{name} has the shape {matrix.shape}: it needs {shape}, a row for each of {', '.join(states)} and a "
                f"column for each of {', '.join(columns)}"
            )
        else:
            for i, j in np.argwhere(~np.isfinite(matrix)).tolist():
                yield f"{name} is {matrix[i, j]:g} from {columns[j]} to {states[i]}: give a finite number"
    if period is not None and not (isinstance(period, int | float) and 0.0 < period < math.inf):
        yield (
            f"period is {period!r}: give the seconds from x to x+ = A x + B u, or None for dx/dt = A x + B u"
        )


def pair_faults(A: Any, B: Any) -> tuple[str, ...]:
    """Check that A and B determine the numbers of states and inputs."""
    found = []
    if not (numeric(A) and A.ndim == 2 and 0 < A.shape[0] == A.shape[1]):
        found.append(f"A is {shown(A)}: give a square matrix of numbers, a row and a column for each state")
    if not (numeric(B) and B.ndim == 2 and B.size):
        found.append(
            f"B is {shown(B)}: give a matrix of numbers, a row for each state and a column for each input; for one "
            "input, for example, [[0.0], [1.0]]"
        )
    return tuple(found)


class Mode(NamedTuple):
    """A mode that no input moves: w'x with w'A = eigenvalue w' and w'B = 0."""

    eigenvalue: complex
    states: tuple[int, ...]
    """Indices of the states in w'x, in half-widths."""


def unmoved_modes(A: np.ndarray, B: np.ndarray, x_scale: np.ndarray, u_scale: np.ndarray) -> list[Mode]:
    """Return all modes that no input moves (Hautus test); of a complex pair only the upper one."""
    a, b = A * x_scale / x_scale[:, None], B * u_scale / x_scale[:, None]
    size = max(np.linalg.norm(np.hstack([a, b]), 2), np.finfo(float).tiny)
    found: list[Mode] = []
    for eigenvalue in np.linalg.eigvals(a):
        known = any(abs(eigenvalue - one.eigenvalue) <= 1e-6 * size for one in found)
        if eigenvalue.imag < 0.0 or known:
            continue
        left, values, _ = np.linalg.svd(np.hstack([a - eigenvalue * np.eye(len(a)), b]))
        if values[-1] <= UNMOVED * size:
            parts = np.abs(left[:, -1])
            found.append(
                Mode(complex(eigenvalue), tuple(np.flatnonzero(parts > PART * parts.max()).tolist()))
            )
    return found


def mode_faults(A: np.ndarray, B: np.ndarray, period: float | None, plant: Description) -> Iterator[str]:
    """Report modes that do not decay and that no input moves, because no controller can stabilise them."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        rows = 1.0 / plant.x_scale[:, None]
        sizes = np.abs([*(A * plant.x_scale * rows).ravel(), *(B * plant.u_scale * rows).ravel(), *A.ravel()])
    if not sizes.max() < LARGEST:
        yield f"A and B have numbers above {LARGEST:g} in half-widths: use other units or bounds for the states"
        return
    largest = max(np.abs(np.linalg.eigvals(A)).max(), np.finfo(float).tiny)
    fastest = largest if period is None else 1.0 / period
    for mode in unmoved_modes(A, B, plant.x_scale, plant.u_scale):
        value = mode.eigenvalue
        # Growth per second; the logarithm gives it for discrete time.
        growth = value.real if period is None else math.log(max(abs(value), 1e-300)) / period
        if growth < -MARGINAL * fastest:
            continue
        named = ", ".join(plant.states[i] for i in mode.states)
        does = f"grows by exp({growth:.3g} t)" if growth > MARGINAL * fastest else "does not decay"
        shown_value = f"{value.real:.4g}" if value.imag == 0.0 else f"{value.real:.4g} + {value.imag:.4g}i"
        yield (
            f"no input moves {named if len(mode.states) == 1 else f'the mode of {named}'}, which {does} (eigenvalue "
            f"{shown_value} of A): A and B cannot be stabilised. Correct B, or leave out what cannot be controlled"
        )
