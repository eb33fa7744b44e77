"""The maximal robust control invariant set: from each state some input keeps the next state in the set for every w.

The predecessor iteration (Bertsekas 1972; Blanchini 1999):  C_0 = X,  C_{j+1} = C_j with Pre(C_j), where

    Pre(C) = {x : there is u in U with A x + B u + w in C for all w in W}
           = {x : there is u with G (A x + B u) <= g - h_W(G)},  the input eliminated by Fourier-Motzkin.

The iteration uses W + eps S, where S is the ball of X's half-widths. As soon as C_j - eps S lies in C_{j+1}, C_{j+1} is
exactly invariant for W: from x in C_{j+1} some u leads into C_j - eps S for every w in W. The iteration therefore ends
after finitely many steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lbmpc.sets.geometry.operations import Body, ConvexSet, body, eliminate
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope, SetError

WIDE = 1e3
LEFT_TO_CHECKER = 0.05
"""Share of the slack that an invariant stage keeps for the rounding of the checker."""
COPY_SHARES = tuple(np.arange(0.95, 0.0, -0.05).tolist())
"""Sizes of the smaller copies that are tried, largest first."""


@dataclass(frozen=True, eq=False)
class UncertainSystem:
    """The system x+ = A x + B u + w, w in W, u in U; A (d, d), B (d, m)."""

    A: np.ndarray
    B: np.ndarray
    W: ConvexSet
    U: Polytope


@dataclass(frozen=True, eq=False)
class Stage:
    """One step of the iteration; `excess` is the part of C_j - eps S outside C_{j+1}, in scaled lengths."""

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
    """Return rows (G, g) of Pre(target), which may be redundant; W is enlarged by slack times the ball of `scale`,
    (d,).

    With several inputs the rows include those of a box of `WIDE` times the size of the target.
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
        # Rows of the target do not bound directions that decay within a period, but elimination needs bounds.
        box = Polytope.box(target.centre - WIDE * target.scale, target.centre + WIDE * target.scale, ())
        G_box, g_box = box.one_sided()
        parts.append(np.column_stack([G_box, np.zeros((2 * d, m))]))
        bounds.append(g_box)
    return eliminate(np.vstack(parts), np.concatenate(bounds), m)


def predecessor_iteration(
    X: Body, plant: UncertainSystem, slack: float = 3e-4, patience: int = 150, start: Stage | None = None
) -> Iterator[Stage]:
    """Run the predecessor iteration, stage by stage, until one is invariant.

    Args:
        X: the allowed states.
        plant: the uncertain system.
        slack: eps, as a share of X's half-widths. A larger value ends sooner, with a smaller set.
        patience: number of steps after which a smaller invariant copy of the present set is searched, so that a slowly
            converging iteration ends with a certified set.
        start: a stage to continue from after an interruption.

    Raises:
        EmptySetError: the set is empty. The text names the step.
        SetError: the iteration did not converge, and no smaller copy is invariant.
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
                "A smaller W (a smaller region, or bounds by region), a shorter period or a larger U may help."
            ) from error
        new = new.reduced()
        yield (stage := Stage(step, new, _excess(current, new, eps, X.scale), eps))
        if stage.invariant:
            return
        current = new


def _smaller_copy(
    current: Body, plant: UncertainSystem, eps: float, scale: np.ndarray, patience: int
) -> Body:
    """Return the largest of some scaled copies of a set, about the equilibrium, that is invariant for W + eps S."""
    for share in COPY_SHARES:
        try:
            copy = body(current.G, share * current.g, "a smaller copy", scale)
            G, g = predecessor(copy, plant, eps, scale)
            before = body(np.vstack([copy.G, G]), np.concatenate([copy.g, g]), "its invariant part", scale)
        except EmptySetError:
            continue
        if before.includes(copy, 0.0):
            return copy
    raise SetError(
        f"the iteration has not converged after {patience} steps, and no smaller copy of the set it reached is "
        "invariant; allow more steps, or more slack"
    )


def _excess(before: Body, after: Body, eps: float, scale: np.ndarray) -> float:
    """Return how far `before`, shrunk by eps, extends beyond `after`, in scaled lengths; at most 0 if it does not."""
    lengths = np.linalg.norm(before.G * scale, axis=1)
    try:
        shrunk = body(before.G, before.g - eps * lengths, "the shrunk set", scale, before)
    except EmptySetError:
        return -np.inf
    reach = after.G @ shrunk.vertices.T
    return float(((reach.max(axis=1) - after.g) / np.linalg.norm(after.G * scale, axis=1)).max())
