"""Set operations on bounded polytopes {x : G x <= g}. Linear programs go to HiGHS, hulls to Qhull.

Every operation works in coordinates scaled by the set's own bounding box, so that states in different units do no harm,
and names what it cannot work on: empty, unbounded, flat, badly scaled.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from lbmpc.sets.geometry.polytope import EmptySetError, Polytope, SetError

# Relative to the bounding box: below it, a set has no inside that floating-point numbers can tell.
FLAT = 1e-9
# Widths of a bounding box further apart than this lose too many digits.
BADLY_SCALED = 1e12
# Scaled coordinates beyond this count as infinite.
FAR = 1e6
ROWS_AT_ONCE = 400
JOGGLED = "QJ"
MOST_DIMENSIONS = 6
"""Up to here vertices are enumerated; their number grows beyond use above."""


class UnboundedSetError(SetError):
    """A set that should be bounded is not; the text names the direction."""


class FlatSetError(SetError):
    """A set has no inside, only a surface; the text names its thickness."""


class BadlyScaledError(SetError):
    """A set's widths are too far apart for floating-point numbers."""


class ConvexSet(Protocol):
    """Whatever has a support function."""

    def support(self, directions: np.ndarray) -> np.ndarray:
        """max f' w over the set for each row f of directions (r, d); (r,)."""
        ...


@dataclass(frozen=True, eq=False)
class Body:
    """A bounded set {x : G x <= g} with an inside: G is (r, d), g (r,). Its rows may be redundant.

    Build it with `body`, which checks and scales; everything here may then rely on it.
    """

    G: np.ndarray
    g: np.ndarray
    scale: np.ndarray
    """Half-widths of a box around it, or of whatever it is measured by, (d,)."""
    centre: np.ndarray
    """A point well inside, (d,): the Chebyshev centre in scaled coordinates."""
    radius: float
    """Of the largest scaled ball inside, between 0 and about 1."""

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
        """In the units of the states multiplied."""
        if self.dimension == 1:
            return float(np.ptp(self.vertices))
        return float(convex_hull(self.vertices / self.scale).volume * np.prod(self.scale))

    def contains(self, x: np.ndarray, tolerance: float = 0.0) -> np.ndarray:
        """Which of the points (..., d) are inside; (...) of bool."""
        return np.asarray((np.asarray(x) @ self.G.T <= self.g + tolerance).all(axis=-1))

    def support(self, directions: np.ndarray) -> np.ndarray:
        """max f' x over the set for each row f of directions (r, d); (r,)."""
        return np.asarray((np.asarray(directions) @ self.vertices.T).max(axis=-1))

    def includes(self, other: Body, tolerance: float = 1e-11) -> bool:
        """Whether `other` lies inside, each row moved outwards by `tolerance` of its scaled length.

        The tolerance covers the rounding of a vertex; what must be proved goes to `lbmpc.sets.check`.
        """
        allowed = self.g + tolerance * np.linalg.norm(self.G * self.scale, axis=1)
        if other.dimension <= MOST_DIMENSIONS:
            return bool((other.support(self.G) <= allowed).all())
        return all(
            support_of(other.G, other.g, row) <= bound for row, bound in zip(self.G, allowed, strict=True)
        )

    def reduced(self) -> Body:
        """The same set without redundant rows, by the hull of the dual points."""
        G, g, c = self._scaled()
        if self.dimension == 1:
            found = [int(np.argmin(np.where(s * G[:, 0] > 0, g / np.abs(G[:, 0]), np.inf))) for s in (1, -1)]
        else:
            found = convex_hull(G / (g - G @ c)[:, None]).vertices.tolist()
        keep = np.sort(np.array(found))
        return Body(self.G[keep], self.g[keep], self.scale, self.centre, self.radius)

    def _scaled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit rows, bounds and centre in scaled coordinates."""
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
    """Check {x : G x <= g} and find its scale and a point well inside.

    Args:
        G: (r, d); rows of zeros are dropped where they say nothing.
        g: (r,).
        what: its name, for messages.
        scale: half-widths to measure by, (d,); the bounding box's own by default, which takes 2 d linear programs.
        inside: another set whose centre may serve, which saves a linear program.

    Raises:
        EmptySetError: holds nothing.
        UnboundedSetError, FlatSetError, BadlyScaledError: it is not a body.
    """
    G, g = np.asarray(G, dtype=float), np.asarray(g, dtype=float)
    if not (np.isfinite(G).all() and not np.isnan(g).any()):
        raise SetError(f"{what}: its rows are not finite")
    length = np.linalg.norm(G if scale is None else G * scale, axis=1)
    silent = length <= 1e-14 * max(length.max(initial=0.0), 1e-300)
    if (g[silent] < 0).any():
        raise EmptySetError(f"{what} is empty: a row asks for 0 <= {g[silent].min():.3g}")
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
            "Leave out the state that does not move, or give every constraint some room."
        )
    return Body(G, g, scale, centre * scale, radius)


def body_of(polytope: Polytope, what: str = "the set", scale: np.ndarray | None = None) -> Body:
    """`body` of a two-sided polytope."""
    return body(*polytope.one_sided(), what, scale)


def convex_hull(points: np.ndarray) -> ConvexHull:
    """Qhull, with points moved by a hair where rounding leaves it no consistent answer."""
    try:
        return ConvexHull(points)
    except QhullError:
        return ConvexHull(points, qhull_options=JOGGLED)


def eliminate(G: np.ndarray, g: np.ndarray, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Fourier-Motzkin: {x : exists y with G (x, y) <= g}, y the last `columns` variables; rows not yet reduced.

    Every pair of a row that bounds y from above with one that bounds it from below gives a row; between two variables
    the redundant ones are dropped.
    """
    for k in range(columns):
        if k:
            found = body(G, g, "what is left after eliminating an input").reduced()
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
    """max direction' x over {G x <= g} by a linear program; inf where unbounded. Raises `EmptySetError`."""
    found = linprog(-direction, G, g, bounds=(None, None), method="highs")
    if found.status == 3 or (found.status == 4 and not found.success):
        return float("inf")
    if found.status != 0:
        raise EmptySetError("no support: the set is empty")
    return float(-found.fun)


def _smallest(values: np.ndarray) -> np.ndarray:
    """Indices of the `ROWS_AT_ONCE` smallest."""
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
        raise FlatSetError(f"{what} is flat: variable {i} only ever is {high[i]:.6g}")
    if widest / width.min() > BADLY_SCALED:
        raise BadlyScaledError(
            f"{what} is badly scaled: its widths go from {width.min():.2g} to {widest:.2g}; use other units"
        )
    return width


def _chebyshev(G: np.ndarray, g: np.ndarray, what: str) -> tuple[np.ndarray, float]:
    """Centre and radius of the largest ball in {G x <= g}.

    Of very many rows only those are shown to the linear program that some earlier answer broke.
    """
    d = G.shape[1]
    rows = np.column_stack([G, np.linalg.norm(G, axis=1)])
    seen = _smallest(g / rows[:, d])
    # A box around everything, so that the first answers are bounded; the set itself is inside it or unbounded.
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
