"""Verifies the claim of a certificate from the claim alone, in floating point with bounds on every rounding error.

The check shares only libraries with the construction. Its argument for a piece {x : G x <= g}:

1. The piece is widened slightly, each row by a random amount of its own, so that no vertex is degenerate. A property of
   the wider set holds for the piece.
2. Qhull proposes the vertices as bases, d rows that intersect. Each basis is confirmed: it is proposed once, its rows
   are independent, their intersection lies in a ball of known radius, and it is strictly inside all other rows.
3. No vertex is missing: every edge, i.e. every d - 1 rows of a basis, occurs in exactly two different bases. The graph
   of a polyhedron's vertices is connected (Balinski 1961), so a list closed under its edges is complete. No edge is a
   ray, so the set is bounded and is the hull of its vertices.
4. Each row touches the set, so the set is the one that was written.
5. For each vertex an input is found for which all rows of the target hold for every w. The rows are linear, so convex
   combinations of these inputs serve all other states.

Rounding: |fl(a'b) - a'b| <= gamma_n |a|'|b|, gamma_n = n u / (1 - n u), u = 2^-53 (Higham 2002, (3.5)), for any order
of summation. The bounds are computed with an allowance for their own rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import HalfspaceIntersection, QhullError

from lbmpc.sets.certificate import Certificate, Piece

UNIT = 2.0**-53
# Error bounds are computed in floating point too. This factor covers their rounding for up to 10^6 terms.
ROOM = 1.0 + 1e-9
WIDEN = 1e-7
"""Random outward shift of the rows, as a share of their scaled length."""
LOOSE = 3e-4
"""Largest distance between a row and the set, as a share of the half-widths of X."""
TINY = 1e-300


@dataclass(frozen=True)
class Verdict:
    """The result of checking a certificate."""

    ok: bool
    reason: str
    """Reason for a failure with the name of the piece; empty if ok."""
    margin: float
    """The smallest slack of any target row at any vertex, as a share of the half-widths of X; negative on failure."""
    vertices: int
    """Number of confirmed vertices of all pieces."""


class Refuted(Exception):
    """A part of the claim is false or cannot be confirmed. Used inside this module only."""

    def __init__(self, reason: str, margin: float = float("nan")):
        super().__init__(reason)
        self.margin = margin


def check(
    certificate: Certificate, seed: int = 0, progress: Callable[[float], None] = lambda done: None
) -> Verdict:
    """Verify the claim. The W of each piece is assumed; everything else is verified.

    Args:
        certificate: a certificate as returned by `lbmpc.sets.certificate.decode`.
        seed: seed of the random widening.
        progress: called with the share of the work that is done.
    """
    if not certificate.certified:
        return Verdict(
            False, f"it is of the kind {certificate.kind}, which is not certified", float("nan"), 0
        )
    random = np.random.default_rng(seed)
    margin, count = np.inf, 0
    for index, piece in enumerate(certificate.pieces):
        try:
            found, vertices = _check_piece(certificate, piece, random)
        except Refuted as error:
            reason = f"piece {index} ({piece.name}): {error}"
            return Verdict(False, reason, error.margin, count)
        margin, count = min(margin, found), count + vertices
        progress((index + 1) / len(certificate.pieces))
    return Verdict(True, "", margin, count)


def _check_piece(certificate: Certificate, piece: Piece, random: np.random.Generator) -> tuple[float, int]:
    """Return the smallest margin of the piece and the number of its vertices. Raises `Refuted`."""
    model = certificate.model
    x_lower, x_upper = (np.array(bound) for bound in model.X)
    scale = _powers_of_two((x_upper - x_lower) / 2)
    # Scaling by powers of two is exact.
    G, g = np.array(piece.G) * scale, np.array(piece.g)
    points, radius = _vertices(G, g, random)
    boxes = {
        "X": (x_lower, x_upper),
        "the box where its W holds": (np.array(piece.x_lower), np.array(piece.x_upper)),
    }
    for what, (lower, upper) in boxes.items():
        _require_inside(G, g, points, radius, lower / scale, upper / scale, what)
    u_lower, u_upper = np.array(piece.u_lower), np.array(piece.u_upper)
    if (u_lower < np.array(model.U[0])).any() or (u_upper > np.array(model.U[1])).any():
        raise Refuted("it allows inputs outside U")
    _require_touched(G, g, points)
    step = _Step(certificate, piece, scale)
    inputs = step.inputs(points, u_lower, u_upper)
    if (inputs < u_lower).any() or (inputs > u_upper).any():
        raise Refuted("an input outside those allowed")  # impossible, because they are clipped
    room = step.room(points, radius, inputs)
    margin = float(room.min())
    if margin < 0.0:
        worst = points[int(np.argmin(room))] * scale
        raise Refuted(
            f"from the vertex {np.array2string(worst, precision=4)} no input found keeps the next state in piece "
            f"{piece.target} ({certificate.pieces[piece.target].name}) for every w: it is outside by "
            f"{-margin:.3g} of X's half-width",
            margin,
        )
    return margin, len(points)


class _Step:
    """Rows of the target for the next state: P x + Q u <= r - err, all scaled by powers of two."""

    def __init__(self, certificate: Certificate, piece: Piece, scale: np.ndarray):
        model, target = certificate.model, certificate.pieces[piece.target]
        self.A = (np.array(model.A) + np.array(piece.slope_x)) * scale / scale[:, None]
        self.B = (np.array(model.B) + np.array(piece.slope_u)) / scale[:, None]
        self.T, self.t = np.array(target.G) * scale, np.array(target.g)
        self.lengths = np.linalg.norm(self.T, axis=1)
        W = np.array(piece.W) / scale
        error = _gamma(W.shape[1] + 1) * (np.abs(self.T) @ np.abs(W).T)
        self.reach = np.nextafter((self.T @ W.T + error * ROOM).max(axis=1), np.inf)
        self.P, self.Q = self.T @ self.A, self.T @ self.B
        # For any order of summation: |T| (|A| |x| + |B| |u|) times gamma of all terms, including the sum A + slope.
        self._abs_P, self._abs_Q = np.abs(self.T) @ np.abs(self.A), np.abs(self.T) @ np.abs(self.B)
        self._gamma = _gamma(2 * sum(self.B.shape) + 4)

    def inputs(self, points: np.ndarray, u_lower: np.ndarray, u_upper: np.ndarray) -> np.ndarray:
        """Propose an input for each point, (k, m), with the largest slack. `room` confirms it."""
        base = (points @ self.P.T + self.reach - self.t) / self.lengths
        slope = self.Q / self.lengths[:, None]
        m = len(u_lower)
        if m == 1:
            return _best_single(base, slope[:, 0], u_lower[0], u_upper[0])[:, None]
        rows = np.column_stack([slope, -np.ones(len(slope))])
        bounds = [*zip(u_lower, u_upper, strict=True), (None, None)]
        goal = np.append(np.zeros(m), 1.0)
        found = [linprog(goal, rows, -row, bounds=bounds, method="highs") for row in base]
        return np.clip(
            [f.x[:m] if f.status == 0 else (u_lower + u_upper) / 2 for f in found], u_lower, u_upper
        )

    def room(self, points: np.ndarray, radius: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Return a lower bound on the slack in the target at each point for any w, per scaled length; (k,)."""
        value = points @ self.P.T + inputs @ self.Q.T
        size = np.abs(points) @ self._abs_P.T + np.abs(inputs) @ self._abs_Q.T
        error = (self._gamma * size + radius[:, None] * self._abs_P.sum(axis=1)) * ROOM + TINY
        room = self.t - self.reach - value - error
        # The last three operations are rounded too.
        room -= 4 * UNIT * (np.abs(self.t) + np.abs(self.reach) + np.abs(value) + error) * ROOM
        return np.asarray((room / (self.lengths * (1 + 8 * UNIT))).min(axis=1))


def _best_single(base: np.ndarray, slope: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return argmin over u of the max over rows of base + slope u, per row of base (k, r), one input; by bisection."""
    best = np.full(len(base), (low + high) / 2)
    up, down = slope > 0, slope < 0
    for part in np.array_split(np.arange(len(base)), max(1, base.size // 500_000)):
        highs, lows = base[part][:, up] / slope[up], base[part][:, down] / slope[down]
        per_up, per_down = 1.0 / slope[up], 1.0 / slope[down]
        t_low, t_high = np.full(len(part), -2.0), np.full(len(part), 2.0)
        for _ in range(40):
            t = (t_low + t_high)[:, None] / 2
            highest = (t * per_up - highs).min(axis=1, initial=high)
            lowest = (t * per_down - lows).max(axis=1, initial=low)
            fits = lowest <= highest
            best[part] = np.where(fits, (lowest + highest) / 2, best[part])
            t_high, t_low = np.where(fits, t[:, 0], t_high), np.where(fits, t_low, t[:, 0])
    return np.clip(best, low, high)


def _vertices(G: np.ndarray, g: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return balls in the maximum norm, points (k, d) and radii (k,), around all vertices of a slightly wider set.

    Raises:
        Refuted: the list of vertices cannot be confirmed as complete.
    """
    d = G.shape[1]
    lengths = np.linalg.norm(G, axis=1)
    if not (lengths > 0).all():
        raise Refuted("it has a row of zeros")
    wide = np.nextafter(g + WIDEN * lengths * (1 + random.random(len(g))), np.inf)
    ball = np.append(np.zeros(d), -1.0)
    inside = linprog(ball, np.column_stack([G, lengths]), g, bounds=(None, None), method="highs")
    if inside.status != 0 or inside.x[d] <= 0.0:
        raise Refuted("it is empty, flat or unbounded")
    bases = _distinct(_bases(G, wide, inside.x[:d]), G.shape)
    rows, bounds = G[bases], wide[bases]
    try:
        points = np.linalg.solve(rows, bounds[..., None])[..., 0]
        inverses = np.linalg.inv(rows)
    except np.linalg.LinAlgError as error:
        raise Refuted("rows that should meet in a point do not") from error
    off = np.abs(np.eye(d) - inverses @ rows) + _gamma(d + 1) * (np.abs(inverses) @ np.abs(rows)) * ROOM
    theta = off.sum(axis=2).max(axis=1) * ROOM
    residual = np.abs(bounds - (rows @ points[..., None])[..., 0])
    residual = (
        residual + _gamma(d + 2) * ((np.abs(rows) @ np.abs(points)[..., None])[..., 0] + np.abs(bounds))
    ) * ROOM
    if not (theta < 0.5).all():
        raise Refuted("rows that should meet in a point are almost parallel")
    radius = (np.abs(inverses) @ residual[..., None])[..., 0].max(axis=1) / (1 - theta) * ROOM + TINY
    _require_strict(G, wide, bases, points, radius)
    _require_closed(bases)
    return points, radius


def _bases(G: np.ndarray, g: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the d rows that intersect in each vertex, (k, d), as proposed by Qhull."""
    if G.shape[1] == 1:  # Qhull needs d > 1; take the tightest row of each sign
        bounds = np.divide(g, np.abs(G[:, 0]))
        return np.array([[np.where(side, bounds, np.inf).argmin()] for side in (G[:, 0] > 0, G[:, 0] < 0)])
    try:
        # An unbounded set has a vertex at infinity, which is detected below.
        with np.errstate(divide="ignore", invalid="ignore"):
            found = HalfspaceIntersection(np.column_stack([G, -g]), inside)
    except QhullError as error:
        raise Refuted(f"Qhull cannot list its vertices: {str(error).splitlines()[0]}") from error
    if any(len(facet) != G.shape[1] for facet in found.dual_facets):
        raise Refuted("two vertices are too close to be distinguished")
    return np.array(found.dual_facets)


def _distinct(bases: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the sorted bases, (k, d). A repeated basis would repeat all its edges and hide a missing neighbour."""
    rows, d = shape
    if bases.shape[1:] != (d,) or not ((bases >= 0) & (bases < rows)).all():
        raise Refuted(f"a vertex is not given by {d} of its {rows} rows")
    bases = np.sort(bases, axis=1)
    if len(np.unique(bases, axis=0)) != len(bases):
        raise Refuted("a vertex is listed twice, which could hide that another is missing")
    return bases


def _require_strict(
    G: np.ndarray, g: np.ndarray, bases: np.ndarray, points: np.ndarray, radius: np.ndarray
) -> None:
    """Raise `Refuted` unless every vertex is strictly inside every row except its own."""
    d = G.shape[1]
    value, size = points @ G.T, np.abs(points) @ np.abs(G).T
    error = (_gamma(d + 2) * (size + np.abs(g)) + radius[:, None] * np.abs(G).sum(axis=1)) * ROOM
    room = g - value - error
    np.put_along_axis(room, bases, np.inf, axis=1)
    for vertex, row in np.argwhere(~(room > 0.0)):
        # The intersection of almost parallel rows is inaccurate in floating point.
        if not _inside_exactly(G, g, bases[vertex], row):
            raise Refuted("one of its rows cuts off what should be a vertex")


def _inside_exactly(G: np.ndarray, g: np.ndarray, basis: np.ndarray, row: int) -> bool:
    """Return whether the intersection of the basis is strictly inside another row, in rational arithmetic."""
    system = [[Fraction(float(a)) for a in G[i]] + [Fraction(float(g[i]))] for i in basis]
    d = len(system)
    for k in range(d):
        pivot = next((i for i in range(k, d) if system[i][k] != 0), None)
        if pivot is None:
            raise Refuted("rows that should meet in a point do not")
        system[k], system[pivot] = system[pivot], system[k]
        system[k] = [a / system[k][k] for a in system[k]]
        for i in range(d):
            if i != k and system[i][k] != 0:
                system[i] = [a - system[i][k] * b for a, b in zip(system[i], system[k], strict=True)]
    reached = sum(Fraction(float(a)) * line[d] for a, line in zip(G[row], system, strict=True))
    return bool(reached < Fraction(float(g[row])))


def _require_closed(bases: np.ndarray) -> None:
    """Raise `Refuted` unless every edge joins two vertices of the list."""
    d = bases.shape[1]
    if d == 1:  # an interval is its own edge
        counts = np.array([len(bases)])
    else:
        edges = np.concatenate([np.delete(bases, i, axis=1) for i in range(d)])
        _, counts = np.unique(edges, axis=0, return_counts=True)
    if not (counts == 2).all():
        raise Refuted(f"{int((counts != 2).sum())} of its edges do not end at a known vertex")


def _require_touched(G: np.ndarray, g: np.ndarray, points: np.ndarray) -> None:
    """Raise `Refuted` unless every row touches the set. A row outside has no effect, so it indicates an error."""
    lengths = np.linalg.norm(G, axis=1)
    gap = np.full(len(g), np.inf)
    for part in np.array_split(points, 1 + points.shape[0] * len(g) // 4_000_000):
        gap = np.minimum(gap, ((g - part @ G.T) / lengths).min(axis=0))
    worst = int(np.argmax(gap))
    if gap[worst] > LOOSE:
        raise Refuted(f"row {worst} has no effect: no state of the set is nearer to it than {gap[worst]:.2g}")


def _require_inside(
    G: np.ndarray,
    g: np.ndarray,
    points: np.ndarray,
    radius: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    what: str,
) -> None:
    """Raise `Refuted` unless the piece lies in a box, by a row of its own or because all its vertices do."""
    for i in range(G.shape[1]):
        alone = (G != 0.0).sum(axis=1) == 1
        for sign, bound in ((1.0, upper[i]), (-1.0, -lower[i])):
            said = alone & (sign * G[:, i] > 0)
            # g / |G| <= bound without the rounding of a quotient. |G| is 1 for bounds; otherwise the vertices decide.
            if (said & (np.abs(G[:, i]) * bound >= g) & (np.frexp(np.abs(G[:, i]))[0] == 0.5)).any():
                continue
            reached = float((sign * points[:, i] + radius).max())
            if reached > bound:
                raise Refuted(
                    f"it leaves {what} in state {i} by {reached - bound:.3g} of X's half-width",
                    bound - reached,
                )


def _powers_of_two(values: np.ndarray) -> np.ndarray:
    return np.asarray(2.0 ** np.round(np.log2(values)))


def _gamma(n: int) -> float:
    """Return gamma_n of Higham, rounded up."""
    return float(np.nextafter(n * UNIT / (1 - n * UNIT), np.inf))
