"""The maximal robust control invariant set: from each of its states some input keeps the next one in it, whatever w.

The predecessor iteration (Bertsekas 1972; Blanchini 1999):  C_0 = X,  C_{j+1} = C_j with Pre(C_j), where

    Pre(C) = {x : there is u in U with A x + B u + w in C for all w in W}
           = {x : there is u with G (A x + B u) <= g - h_W(G)},  the input eliminated by Fourier-Motzkin.

The iteration runs with W + eps S, S the ball of X's half-widths. As soon as C_j - eps S lies in C_{j+1}, C_{j+1} is
invariant for W itself: from x in C_{j+1} some u leads into C_j - eps S for every w in W. So it ends, and what it ends
with is invariant, not nearly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lbmpc.sets.geometry.operations import Body, ConvexSet, body, eliminate
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope, SetError

WIDE = 1e3
LEFT_TO_CHECKER = 0.05
"""How much of the slack an invariant stage leaves, for the rounding of whoever checks it."""
COPY_SHARES = tuple(np.arange(0.95, 0.0, -0.05).tolist())
"""Sizes of the smaller copies that are tried, the largest first."""


@dataclass(frozen=True, eq=False)
class UncertainSystem:
    """x+ = A x + B u + w, w in W, u in U; A (d, d), B (d, m)."""

    A: np.ndarray
    B: np.ndarray
    W: ConvexSet
    U: Polytope


@dataclass(frozen=True, eq=False)
class Stage:
    """One step of the iteration; `excess` is how far C_j - eps S still sticks out of C_{j+1}, in scaled lengths."""

    step: int
    set: Body
    excess: float
    slack: float
    """eps of this step."""

    @property
    def invariant(self) -> bool:
        return self.excess <= -LEFT_TO_CHECKER * self.slack


def predecessor(
    target: Body, plant: UncertainSystem, slack: float = 0.0, scale: np.ndarray | float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (G, g) of Pre(target), redundant ones among them; W is widened by slack times the ball of `scale`, (d,).

    With several inputs those of a box that is `WIDE` times the target are among them.
    """
    d = target.dimension
    reach = plant.W.support(target.G) + slack * np.linalg.norm(target.G * scale, axis=1)
    G_u, g_u = plant.U.one_sided()
    parts = [
        np.column_stack([target.G @ plant.A, target.G @ plant.B]),
        np.column_stack([np.zeros((len(G_u), d)), G_u]),
    ]
    bounds = [target.g - reach, g_u]
    m = plant.B.shape[1]
    if m > 1:
        # What is forgotten within a period is bounded by no row of the target; between two inputs bounds are needed.
        box = Polytope.box(target.centre - WIDE * target.scale, target.centre + WIDE * target.scale, ())
        G_box, g_box = box.one_sided()
        parts.append(np.column_stack([G_box, np.zeros((2 * d, m))]))
        bounds.append(g_box)
    return eliminate(np.vstack(parts), np.concatenate(bounds), m)


def predecessor_iteration(
    X: Body, plant: UncertainSystem, slack: float = 3e-4, patience: int = 150, start: Stage | None = None
) -> Iterator[Stage]:
    """The predecessor iteration, stage by stage, until one is invariant.

    Args:
        X: the states allowed.
        slack: eps, as a share of X's half-widths. A larger one ends sooner, with a smaller set.
        patience: steps after which a smaller copy of the set reached is looked for that is invariant, so that an
            iteration that converges too slowly still ends with a certified set.
        start: a stage to go on from, after an interruption.

    Raises:
        EmptySetError: nothing is left; names the step.
        SetError: out of patience, and no smaller copy is invariant.
    """
    current, first = (X.reduced(), 0) if start is None else (start.set, start.step)
    eps = slack if start is None else start.slack
    step = first
    while True:
        step += 1
        if step > patience:
            yield Stage(step, _smaller_copy(current, plant, eps, X.scale, patience), -eps, eps)
            return
        G, g = predecessor(current, plant, eps, X.scale)
        try:
            new = body(
                np.vstack([current.G, G]),
                np.concatenate([current.g, g]),
                f"the set of states that can be kept in X for {step} steps",
                X.scale,
                current,
            )
        except EmptySetError as error:
            raise EmptySetError(
                f"no robust control invariant set exists for this X, U and W: {error}. "
                "A smaller W (a smaller region, or bounds by region), a shorter period or a larger U would help."
            ) from error
        new = new.reduced()
        yield (stage := Stage(step, new, _excess(current, new, eps, X.scale), eps))
        if stage.invariant:
            return
        current = new


def _smaller_copy(
    current: Body, plant: UncertainSystem, eps: float, scale: np.ndarray, patience: int
) -> Body:
    """The largest of some copies of a set, shrunk about the equilibrium, that is invariant for W + eps S."""
    for share in COPY_SHARES:
        try:
            copy = body(current.G, share * current.g, "a smaller copy", scale)
            G, g = predecessor(copy, plant, eps, scale)
            before = body(np.vstack([copy.G, G]), np.concatenate([copy.g, g]), "what stays in it", scale)
        except EmptySetError:
            continue
        if before.includes(copy, 0.0):
            return copy
    raise SetError(
        f"the iteration has not converged after {patience} steps, and no smaller copy of the set it reached is "
        "invariant; allow more steps, or more slack"
    )


def _excess(before: Body, after: Body, eps: float, scale: np.ndarray) -> float:
    """How far `before` drawn in by eps sticks out of `after`, in scaled lengths; at most 0 when it does not."""
    lengths = np.linalg.norm(before.G * scale, axis=1)
    try:
        shrunk = body(before.G, before.g - eps * lengths, "the set drawn in", scale, before)
    except EmptySetError:
        return -np.inf
    reach = after.G @ shrunk.vertices.T
    return float(((reach.max(axis=1) - after.g) / np.linalg.norm(after.G * scale, axis=1)).max())
