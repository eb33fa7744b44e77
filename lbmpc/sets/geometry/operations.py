"""Set operations on bounded polytopes {x : G x <= g}. HiGHS solves linear programs, Qhull computes hulls.

Every operation scales coordinates by the set's own bounding box, so that states can have different units. Sets that are
empty, unbounded, flat or badly scaled are reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from lbmpc.sets.geometry.polytope import EmptySetError, Polytope, SetError

# Relative to the bounding box. A thinner set has no interior in floating point.
FLAT = 1e-9
# Largest ratio of the widths of a bounding box. Larger ones lose too many digits.
BADLY_SCALED = 1e12
# Scaled coordinates above this count as infinite.
FAR = 1e6
ROWS_AT_ONCE = 400
JOGGLED = "QJ"
MOST_DIMENSIONS = 6
"""Largest dimension in which vertices are enumerated. In higher dimensions there are too many."""


class UnboundedSetError(SetError):
    """A set that must be bounded is not. The text names the direction."""


class FlatSetError(SetError):
    """A set has no interior. The text gives its thickness."""


class BadlyScaledError(SetError):
    """The widths of a set differ too much for floating point."""


class ConvexSet(Protocol):
    """A set with a support function."""

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Return max f' w over the set for each row f of directions (r, d); (r,)."""
        ...


@dataclass(frozen=True, eq=False)
class Body:
    """A bounded set {x : G x <= g} with an interior: G is (r, d), g (r,). Its rows may be redundant.

    Build it with `body`, which checks and scales. The methods rely on that.
    """

    G: np.ndarray
    g: np.ndarray
    scale: np.ndarray
    """Half-widths of a box around it, or of its scale of measurement, (d,)."""
    centre: np.ndarray
    """An inner point, (d,): the Chebyshev centre in scaled coordinates."""
    radius: float
    """Radius of the largest scaled ball inside, between 0 and about 1."""

    @property
    def dimension(self) -> int:
        return self.G.shape[1]

    @cached_property
    def vertices(self) -> np.ndarray:
        """All vertices, (k, d). Raises `SetError` above 6 dimensions."""
        if self.dimension > MOST_DIMENSIONS:
            raise SetError(
                f"vertices of a set of {self.dimension} dimensions: only up to {MOST_DIMENSIONS} are enumerated"
            )
        if self.dimension == 1:
            high = (self.g[self.G[:, 0] > 0] / self.G[self.G[:, 0] > 0, 0]).min()
            low = (self.g[self.G[:, 0] < 0] / self.G[self.G[:, 0] < 0, 0]).max()
            return np.array([[low], [high]])
        G, g, c = self._scaled()
        rows = np.column_stack([G, -g])
        try:
            points = HalfspaceIntersection(rows, c).intersections
        except QhullError:
            points = HalfspaceIntersection(rows, c, qhull_options=JOGGLED).intersections
        return np.unique(np.round(points, 12), axis=0) * self.scale

    @property
    def volume(self) -> float:
        """Volume in the product of the units of the states."""
        if self.dimension == 1:
            return float(np.ptp(self.vertices))
        return float(convex_hull(self.vertices / self.scale).volume * np.prod(self.scale))

    def contains(self, x: np.ndarray, tolerance: float = 0.0) -> np.ndarray:
        """Return which of the points (..., d) are inside; (...) of bool."""
        return np.asarray((np.asarray(x) @ self.G.T <= self.g + tolerance).all(axis=-1))

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Return max f' x over the set for each row f of directions (r, d); (r,)."""
        return np.asarray((np.asarray(directions) @ self.vertices.T).max(axis=-1))

    def includes(self, other: Body, tolerance: float = 1e-11) -> bool:
        """Return whether `other` lies inside, with each row moved outwards by `tolerance` of its scaled length.

        The tolerance covers the rounding of a vertex. For a proof, use `lbmpc.sets.check`.
        """
        allowed = self.g + tolerance * np.linalg.norm(self.G * self.scale, axis=1)
        if other.dimension <= MOST_DIMENSIONS:
            return bool((other.support(self.G) <= allowed).all())
        return all(
            support_of(other.G, other.g, row) <= bound for row, bound in zip(self.G, allowed, strict=True)
        )

    def reduced(self) -> Body:
        """Return the same set without redundant rows, by the hull of the dual points."""
        G, g, c = self._scaled()
        if self.dimension == 1:
            found = [int(np.argmin(np.where(s * G[:, 0] > 0, g / np.abs(G[:, 0]), np.inf))) for s in (1, -1)]
        else:
            found = convex_hull(G / (g - G @ c)[:, None]).vertices.tolist()
        keep = np.sort(np.array(found))
        return Body(self.G[keep], self.g[keep], self.scale, self.centre, self.radius)

    def _scaled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return unit rows, bounds and centre in scaled coordinates."""
        G = self.G * self.scale
        lengths = np.linalg.norm(G, axis=1)
        return G / lengths[:, None], self.g / lengths, self.centre / self.scale


def body(
    G: np.ndarray,
    g: np.ndarray,
    what: str = "the set",
    scale: np.ndarray | None = None,
    inside: Body | None = None,
) -> Body:
    """Check {x : G x <= g}, and find its scale and an inner point.

    Args:
        G: (r, d); rows of zeros without effect are dropped.
        g: (r,).
        what: name of the set for messages.
        scale: half-widths as scale of measurement, (d,); by default those of the bounding box, from 2 d linear
        programs. inside: another set whose centre may be used, which saves a linear program.

    Raises:
        EmptySetError: the set is empty.
        UnboundedSetError, FlatSetError, BadlyScaledError: the set is not a body.
    """
    G, g = np.asarray(G, dtype=float), np.asarray(g, dtype=float)
    if not (np.isfinite(G).all() and not np.isnan(g).any()):
        raise SetError(f"{what}: its rows are not finite")
    length = np.linalg.norm(G if scale is None else G * scale, axis=1)
    silent = length <= 1e-14 * max(length.max(initial=0.0), 1e-300)
    if (g[silent] < 0).any():
        raise EmptySetError(f"{what} is empty: a row requires 0 <= {g[silent].min():.3g}")
    keep = ~silent & np.isfinite(g)
    G, g = G[keep], g[keep]
    if scale is None:
        scale = _bounding_scale(G, g, what)
    G_scaled = G * scale
    if inside is not None:
        room = float(((g - G @ inside.centre) / np.linalg.norm(G_scaled, axis=1)).min())
        if room > 0.2 * inside.radius:
            return Body(G, g, scale, inside.centre, room)
    centre, radius = _chebyshev(G_scaled, g, what)
    if radius <= FLAT:
        raise FlatSetError(
            f"{what} is flat: the largest ball inside has {max(radius, 0.0):.2g} of its width. "
            "Remove the state that does not move, or widen the constraints."
        )
    return Body(G, g, scale, centre * scale, radius)


def body_of(polytope: Polytope, what: str = "the set", scale: np.ndarray | None = None) -> Body:
    """Return `body` of a two-sided polytope."""
    return body(*polytope.one_sided(), what, scale)


def convex_hull(points: np.ndarray) -> ConvexHull:
    """Return Qhull's hull, with slightly moved points if rounding gives no consistent result otherwise."""
    try:
        return ConvexHull(points)
    except QhullError:
        return ConvexHull(points, qhull_options=JOGGLED)


def eliminate(G: np.ndarray, g: np.ndarray, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Eliminate variables by Fourier-Motzkin: {x : exists y with G (x, y) <= g}, y the last `columns` variables.

    Every pair of an upper and a lower bound of y gives a row. Redundant rows are dropped between two variables, and not
    at the end.
    """
    for k in range(columns):
        if k:
            found = body(G, g, "the set after eliminating an input").reduced()
            G, g = found.G, found.g
        b = G[:, -1]
        rest = np.abs(G[:, :-1]).max(axis=1, initial=0.0)
        up, down = b > FLAT * np.maximum(rest, FLAT), b < -FLAT * np.maximum(rest, FLAT)
        none = ~(up | down)
        # Per unit of y: y <= g_up - G_up x and y >= G_down x - g_down.
        G_up, g_up = G[up, :-1] / b[up, None], g[up] / b[up]
        G_down, g_down = G[down, :-1] / -b[down, None], g[down] / -b[down]
        paired = (G_up[:, None] + G_down[None]).reshape(-1, G.shape[1] - 1)
        G = np.vstack([G[none, :-1], paired])
        g = np.concatenate([g[none], (g_up[:, None] + g_down[None]).ravel()])
    return G, g


def support_of(G: np.ndarray, g: np.ndarray, direction: np.ndarray) -> float:
    """Return max direction' x over {G x <= g} by a linear program; inf if unbounded. Raises `EmptySetError`."""
    found = linprog(-direction, G, g, bounds=(None, None), method="highs")
    if found.status == 3 or (found.status == 4 and not found.success):
        return float("inf")
    if found.status != 0:
        raise EmptySetError("no support: the set is empty")
    return float(-found.fun)


def _smallest(values: np.ndarray) -> np.ndarray:
    """Return the indices of the `ROWS_AT_ONCE` smallest values."""
    if len(values) <= ROWS_AT_ONCE:
        return np.arange(len(values))
    return np.argpartition(values, ROWS_AT_ONCE)[:ROWS_AT_ONCE]


def _bounding_scale(G: np.ndarray, g: np.ndarray, what: str) -> np.ndarray:
    d = G.shape[1]
    high, low = np.zeros(d), np.zeros(d)
    for i, unit in enumerate(np.eye(d)):
        try:
            high[i], low[i] = support_of(G, g, unit), -support_of(G, g, -unit)
        except EmptySetError as error:
            raise EmptySetError(f"{what} is empty") from error
        if not (np.isfinite(high[i]) and np.isfinite(low[i])):
            raise UnboundedSetError(f"{what} is unbounded in variable {i}: give it bounds")
    width = (high - low) / 2
    widest = width.max(initial=0.0)
    if (width <= FLAT * np.maximum(np.abs(high), np.abs(low))).any() or widest <= 0.0:
        i = int(np.argmin(width))
        raise FlatSetError(f"{what} is flat: variable {i} is fixed at {high[i]:.6g}")
    if widest / width.min() > BADLY_SCALED:
        raise BadlyScaledError(
            f"{what} is badly scaled: its widths go from {width.min():.2g} to {widest:.2g}; use other units"
        )
    return width


def _chebyshev(G: np.ndarray, g: np.ndarray, what: str) -> tuple[np.ndarray, float]:
    """Return centre and radius of the largest ball in {G x <= g}.

    If there are many rows, the linear program uses only those that an earlier solution violated.
    """
    d = G.shape[1]
    rows = np.column_stack([G, np.linalg.norm(G, axis=1)])
    seen = _smallest(g / rows[:, d])
    # A box around everything keeps the first solutions bounded. The set is inside it, or is unbounded.
    wide = [(-FAR, FAR)] * d + [(None, FAR)]
    while True:
        found = linprog(np.append(np.zeros(d), -1.0), rows[seen], g[seen], bounds=wide, method="highs")
        if found.status != 0:
            raise EmptySetError(f"{what} is empty")
        broken = rows @ found.x - g
        worst = _smallest(-broken)
        worst = np.setdiff1d(worst[broken[worst] > 1e-12 * (1 + np.abs(g[worst]))], seen)
        if worst.size == 0:
            break
        seen = np.concatenate([seen, worst])
    radius = float(found.x[d])
    if np.abs(found.x).max() >= 0.99 * FAR:
        raise UnboundedSetError(f"{what} is unbounded")
    if radius < 0:
        raise EmptySetError(
            f"{what} is empty: its constraints contradict each other by {-radius:.3g} of its width"
        )
    return found.x[:d], radius
