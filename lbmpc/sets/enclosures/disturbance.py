"""Rigorous outer bounds of the disturbance of a plant given by equations,

    h(x, u) = Phi_T(x + x_e, u + u_e) - x_e - A x - B u        in deviation coordinates,

over boxes of x and u: as a box, as a hull in template directions, or as an affine form per region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from lbmpc.model import Model
from lbmpc.sets.enclosures.affine_forms import AffineForms, Disturbance, DisturbanceError, Region, nowhere
from lbmpc.sets.enclosures.branch_and_bound import BATCH, BranchAndBound, Progress
from lbmpc.sets.enclosures.interval import Interval, matrix_product

__all__ = [
    "DisturbanceBound",
    "DisturbanceError",
    "Region",
    "bound_affine",
    "bound_box",
    "bound_hull",
    "given_box",
]

BUDGET = 200_000
ANGLES = 16
NEGLIGIBLE = 1e-9
PAD = 1e-6


@dataclass(frozen=True, eq=False)
class DisturbanceBound:
    """The bound: for all (x, u) in `region`, h(x, u) - slope_x x - slope_u u lies in conv(vertices)."""

    region: Region
    slope_x: np.ndarray
    """(d, d), zeros for a plain W."""
    slope_u: np.ndarray
    """(d, m), zeros for a plain W."""
    vertices: np.ndarray
    """(k, d), offset included, rounded outwards, in the plant's units."""

    @classmethod
    def plain(cls, region: Region, vertices: np.ndarray) -> DisturbanceBound:
        """Return a bound without slopes, with vertices (k, d)."""
        d, m = len(region.x_lower), len(region.u_lower)
        return cls(region, np.zeros((d, d)), np.zeros((d, m)), vertices)

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Return max of f'w over w in conv(vertices) for every row f of `directions` (r, d), rounded up, (r,)."""
        rows = Interval.of(np.atleast_2d(np.asarray(directions, dtype=float)))
        return matrix_product(rows, Interval.of(self.vertices.T)).upper.max(axis=1)


def bound_box(
    model: Model,
    region: Region,
    tolerance: float = 0.01,
    progress: Progress | None = None,
    budget: int = BUDGET,
) -> DisturbanceBound:
    """Return the smallest box around h over the region. Each side is within `tolerance` of the range of h.

    The box always contains h. `progress` is called with the share of the work that is done. If `budget` boxes are not
    enough, the bound is wider, and still rigorous.

    Raises:
        DisturbanceError: the region does not fit this plant, or includes points outside the domain of its equations.
    """
    _check(model, region)
    disturbance = Disturbance(model)
    low, high = _extent(disturbance, region, tolerance, progress, budget)
    return DisturbanceBound.plain(region, _corners(low, high))


def bound_hull(
    model: Model,
    region: Region,
    directions: np.ndarray | None = None,
    tolerance: float = 0.01,
    progress: Progress | None = None,
    budget: int = BUDGET,
) -> DisturbanceBound:
    """Return a polytope around h over the region, tight in template directions.

    directions (k, d) are in units of the half-widths of the box around h. The default is 16 directions in every plane
    of two components of h that are not negligible (wider than 1e-9 of the width of X). Negligible components keep their
    box.

    Raises:
        DisturbanceError: as for `bound_box`.
    """
    _check(model, region)
    disturbance = Disturbance(model)
    low, high = _extent(disturbance, region, tolerance, _part(progress, 0.0, 0.3), budget)
    half = 0.5 * (high - low)
    live = np.flatnonzero(high - low > NEGLIGIBLE * _width_of_x(region))
    template = _template(live, model.d) if directions is None else np.asarray(directions, dtype=float)
    if template.ndim != 2 or template.shape[1] != model.d or not np.isfinite(template).all():
        raise DisturbanceError(
            f"{model.plant.name}: template directions have the shape {template.shape}; give rows of {model.d} finite "
            "numbers"
        )
    # A negligible component has its own bounds already, so it is removed from the directions.
    template = template[:, live] if live.size else np.zeros((0, 0))
    template = template[np.count_nonzero(template, axis=1) > 1]
    if live.size < 2 or not len(template):
        return DisturbanceBound.plain(region, _corners(low, high))
    scale = half[live]
    rows = np.zeros((len(template), model.d))
    rows[:, live] = template / scale
    floor = tolerance * 1e-3 * np.linalg.norm(template, axis=1)
    search = BranchAndBound(disturbance, region, rows, tolerance, floor)
    support = search.run(budget, _part(progress, 0.3, 1.0))
    flat = _vertices(rows[:, live], support, low[live], high[live])
    rest = np.setdiff1d(np.arange(model.d), live)
    tiny = _corners(low[rest], high[rest])
    vertices = np.zeros((len(flat) * len(tiny), model.d))
    vertices[:, live], vertices[:, rest] = np.repeat(flat, len(tiny), axis=0), np.tile(tiny, (len(flat), 1))
    return DisturbanceBound.plain(region, vertices)


def bound_affine(model: Model, regions: Sequence[Region], cuts: int = 2) -> list[DisturbanceBound]:
    """Return a slope and a box around the remainder of h for every region; 2^cuts parts share the slope.

    The size of the box is of second order in the size of the region. Its second-order part is overestimated by about
    1 / 2^cuts.

    Raises:
        DisturbanceError: as for `bound_box`, for the first such region.
    """
    if not regions:
        return []
    for region in regions:
        _check(model, region)
    disturbance = Disturbance(model)
    lower, upper = np.array([r.lower for r in regions]), np.array([r.upper for r in regions])
    owner = np.arange(len(regions))
    for cut in range(cuts + 1):
        forms = _all_proved(disturbance, lower, upper)
        if cut < cuts:
            lower, upper, owner = _halve(forms, lower, upper, owner)
    return [_affine(model, region, forms[owner == i]) for i, region in enumerate(regions)]


def given_box(model: Model, half_widths: np.ndarray, region: Region) -> DisturbanceBound:
    """Return a user's W, |h_i| <= half_widths[i], (d,), for the region. It is not verified here.

    Raises:
        DisturbanceError: W does not consist of d finite, nonnegative numbers.
    """
    _check(model, region)
    half = require_half_widths(model, half_widths)
    return DisturbanceBound.plain(region, _corners(-half, half))


def require_half_widths(model: Model, half_widths: np.ndarray) -> np.ndarray:
    """Return the half-widths, (d,). Raises `DisturbanceError` unless they are d finite, nonnegative numbers."""
    half = np.asarray(half_widths, dtype=float)
    if half.shape != (model.d,) or not np.isfinite(half).all() or (half < 0).any():
        raise DisturbanceError(
            f"{model.plant.name}: W is {half.tolist()}; give {model.d} half-widths, one per state "
            f"({', '.join(model.plant.states)}), finite and not negative"
        )
    return half


def _extent(
    disturbance: Disturbance, region: Region, tolerance: float, progress: Progress | None, budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum and maximum of every component of h, (d,) each, rounded outwards."""
    d = disturbance.model.d
    floor = np.tile(NEGLIGIBLE * _width_of_x(region), 2)
    search = BranchAndBound(disturbance, region, np.vstack([np.eye(d), -np.eye(d)]), tolerance, floor)
    bounds = search.run(budget, progress)
    return -bounds[d:], bounds[:d]


def _affine(model: Model, region: Region, forms: AffineForms) -> DisturbanceBound:
    d = model.d
    whole = Interval(forms.G.lower.min(axis=0), forms.G.upper.max(axis=0))
    slope = whole.middle()
    # h - H p in g - H c + (G - H)(p - c)
    linear = matrix_product(Interval.of(slope), Interval.of(forms.c)[..., None])[..., 0]
    spread = matrix_product(forms.G - slope, Interval(-forms.r, forms.r)[..., None])[..., 0]
    left = forms.g - linear + spread
    corners = _corners(left.lower.min(axis=0), left.upper.max(axis=0))
    return DisturbanceBound(region, slope[:, :d], slope[:, d:], corners)


def _halve(
    forms: AffineForms, lower: np.ndarray, upper: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Halve each box across the coordinate that widens the enclosure of h most, relative per component."""
    cost = (forms.G.upper - forms.G.lower) * forms.r[:, None, :]
    total = cost.sum(axis=2, keepdims=True)
    # Components that are linear up to rounding are ignored.
    share = np.where(total > 1e-9 * forms.r.max(axis=1)[:, None, None], cost / np.maximum(total, 1e-300), 0.0)
    cut = share.sum(axis=1).argmax(axis=1)
    index = np.arange(len(lower))
    first, second = upper.copy(), lower.copy()
    first[index, cut] = second[index, cut] = forms.c[index, cut]
    return np.vstack([lower, second]), np.vstack([first, upper]), np.concatenate([owner, owner])


def _all_proved(disturbance: Disturbance, lower: np.ndarray, upper: np.ndarray) -> AffineForms:
    parts = [
        disturbance.forms(lower[i : i + BATCH], upper[i : i + BATCH]) for i in range(0, len(lower), BATCH)
    ]
    forms = AffineForms(
        np.vstack([p.c for p in parts]),
        np.vstack([p.r for p in parts]),
        Interval(np.vstack([p.g.lower for p in parts]), np.vstack([p.g.upper for p in parts])),
        Interval(np.vstack([p.G.lower for p in parts]), np.vstack([p.G.upper for p in parts])),
        tuple(t for p in parts for t in p.trouble),
    )
    for i, trouble in enumerate(forms.trouble):
        if trouble:
            raise DisturbanceError(nowhere(disturbance.model, lower[i], upper[i], trouble))
    return forms


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.array(list(product(*zip(low, high, strict=True)))).reshape(2 ** len(low), len(low))


def _template(live: np.ndarray, d: int) -> np.ndarray:
    """Return ANGLES directions in every plane of two components, without the axes, which the box covers."""
    angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
    angles = angles[np.arange(ANGLES) % (ANGLES // 4) != 0]
    rows = []
    for i, j in combinations(live, 2):
        for angle in angles:
            row = np.zeros(d)
            row[i], row[j] = np.cos(angle), np.sin(angle)
            rows.append(row)
    return np.array(rows).reshape(-1, d)


def _vertices(rows: np.ndarray, support: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return points (k, n) whose hull contains {w: rows w <= support, low <= w <= high}.

    Qhull's vertices are rounded. Every face is therefore moved outwards by PAD, in units in which the box is [-1, 1]^n
    and faces have unit normals. This adds a ball of radius PAD. If every vertex of the larger polytope is off by less
    than PAD, the hull of the rounded vertices contains the original polytope. A linear programme checks this for every
    face of the hull, which is computed again from the rounded vertices. If the check fails, the result is the box,
    which contains the polytope too.
    """
    n = len(low)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    scaled, length = rows * half, np.linalg.norm(rows * half, axis=1)
    a = np.vstack([scaled / length[:, None], np.eye(n), -np.eye(n)])
    b = np.concatenate([(support - rows @ middle) / length, np.ones(2 * n)]) + 1e-12
    try:
        centre = linprog(
            np.r_[np.zeros(n), -1.0],
            A_ub=np.column_stack([a, np.ones(len(a))]),
            b_ub=b,
            bounds=[(None, None)] * n + [(0, None)],
        )
        points = HalfspaceIntersection(np.column_stack([a, -(b + PAD)]), centre.x[:n]).intersections
        hull = ConvexHull(points)
    except QhullError:
        return _corners(low, high)
    points = points[hull.vertices]
    faces = np.unique(np.round(hull.equations, 14), axis=0)
    reach = [-linprog(-face[:n], A_ub=a, b_ub=b, bounds=[(None, None)] * n).fun + face[n] for face in faces]
    # Half of the ball is reserved for rounding in the programmes and in the conversion to the plant's units.
    if max(reach) > -0.5 * PAD:
        return _corners(low, high)
    return points * half + middle


def _width_of_x(region: Region) -> np.ndarray:
    return np.maximum(np.asarray(region.x_upper) - np.asarray(region.x_lower), 1e-12)


def _part(progress: Progress | None, start: float, end: float) -> Progress | None:
    if progress is None:
        return None
    return lambda fraction: progress(start + (end - start) * fraction)


def _check(model: Model, region: Region) -> None:
    names = model.plant.states + model.plant.inputs
    lower, upper = region.lower, region.upper
    if lower.shape != (len(names),) or upper.shape != (len(names),):
        raise DisturbanceError(
            f"{model.plant.name}: a region needs bounds of {model.d} states and {model.m} inputs, this one has "
            f"{lower.size} lower and {upper.size} upper bounds in all"
        )
    for name, low, high in zip(names, lower, upper, strict=True):
        if not (np.isfinite(low) and np.isfinite(high) and low <= high):
            raise DisturbanceError(
                f"{model.plant.name}: the region has {name} in [{low:g}, {high:g}]; bounds must be finite and in order"
            )
