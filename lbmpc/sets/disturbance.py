"""Rigorous outer bounds of the disturbance of a known plant,

    h(x, u) = Phi_T(x + x_e, u + u_e) - x_e - A x - B u        in deviation coordinates,

over boxes of x and u. Each box p = (x, u) in c +- r has the form h(p) in g + G (p - c) with intervals g and G from a
validated integration (`flow.py`). Branch and bound on it gives the maximum of f'h over a region to a tolerance, from
above, whenever it is stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from lbmpc.model import Model
from lbmpc.sets.flow import Flow
from lbmpc.sets.interval import Interval, up
from lbmpc.sets.interval import product as interval_product
from lbmpc.sets.series import UnsupportedOperation

Progress = Callable[[float], None]

BATCH = 256
BUDGET = 200_000
ANGLES = 16
NEGLIGIBLE = 1e-9
# A region is not cut below this fraction of its width to find out where the plant's equations hold.
FINEST = 2.0**-12
PAD = 1e-9


class DisturbanceError(ValueError):
    """The disturbance cannot be bounded as asked; the text says what, where, and what to do."""


@dataclass(frozen=True, eq=False)
class Region:
    """A box of states (d,) and inputs (m,), in deviation coordinates and the plant's units."""

    x_lower: np.ndarray
    x_upper: np.ndarray
    u_lower: np.ndarray
    u_upper: np.ndarray

    @property
    def lower(self) -> np.ndarray:
        """(d + m,), of p = (x, u)."""
        return np.concatenate([self.x_lower, self.u_lower]).astype(float)

    @property
    def upper(self) -> np.ndarray:
        """(d + m,)."""
        return np.concatenate([self.x_upper, self.u_upper]).astype(float)


@dataclass(frozen=True, eq=False)
class DisturbanceBound:
    """For all (x, u) in `region`: h(x, u) - slope_x x - slope_u u lies in conv(vertices)."""

    region: Region
    slope_x: np.ndarray
    """(d, d), zeros for a plain W."""
    slope_u: np.ndarray
    """(d, m), zeros for a plain W."""
    vertices: np.ndarray
    """(k, d), offset included, rounded outwards, in the plant's units."""
    kind: str
    """"box", "hull", "affine" (bounded here) or "given" (the user's claim)."""

    def support(self, directions: np.ndarray) -> np.ndarray:
        """max of f'w over w in conv(vertices) for every row f of `directions` (r, d), rounded up, (r,)."""
        rows = Interval.of(np.atleast_2d(np.asarray(directions, dtype=float)))
        return interval_product(rows, Interval.of(self.vertices.T)).upper.max(axis=1)


@dataclass(frozen=True, eq=False)
class _Forms:
    """h(p) in g + G (p - c), |p - c| <= r, for n boxes: c, r (n, q), g (n, d), G (n, d, q)."""

    c: np.ndarray
    r: np.ndarray
    g: Interval
    G: Interval
    trouble: tuple[str, ...]

    @property
    def proved(self) -> np.ndarray:
        return np.array([not t for t in self.trouble], dtype=bool)

    def __getitem__(self, index: np.ndarray) -> _Forms:
        return _Forms(
            self.c[index],
            self.r[index],
            self.g[index],
            self.G[index],
            tuple(self.trouble[i] for i in np.arange(len(self.trouble))[index]),
        )


class _Disturbance:
    """h of one model, over batches of boxes."""

    def __init__(self, model: Model):
        self.model = model
        try:
            self.flow = Flow.of_plant(model.plant, model.period)
        except UnsupportedOperation as error:
            raise DisturbanceError(f"{model.plant.name}: {error}") from error
        self.e = Interval.of(np.concatenate([model.plant.x_e, model.plant.u_e]))
        self.AB = Interval.of(np.hstack([model.A, model.B]))

    def forms(self, lower: np.ndarray, upper: np.ndarray) -> _Forms:
        """The affine forms of boxes lower, upper (n, q), in deviation coordinates."""
        d = self.model.d
        c = np.clip(0.5 * lower + 0.5 * upper, lower, upper)
        r = np.where(lower == upper, 0.0, np.maximum(up(upper - c), up(c - lower)))
        box, centre = Interval(lower, upper) + self.e, Interval.of(c) + self.e
        flight = self.flow.enclose(box[:, :d], box[:, d:], centre[:, :d], centre[:, d:], r)
        linear = interval_product(Interval.of(c)[:, None, :], Interval(self.AB.lower.T, self.AB.upper.T))[
            :, 0
        ]
        g = flight.centre - self.e[:d] - linear
        return _Forms(c, r, g, flight.derivative - self.AB, flight.trouble)


class _Search:
    """Branch and bound for the maxima of f'h over a region, for all rows f of `directions` (k, d) at once.

    At any time `upper()` holds: every box ever set aside has left its upper bound in `settled`.
    """

    def __init__(
        self,
        disturbance: _Disturbance,
        region: Region,
        directions: np.ndarray,
        tolerance: float,
        floor: np.ndarray,
    ):
        self.disturbance, self.region = disturbance, region
        self.directions = directions
        self.tolerance, self.floor = tolerance, floor
        k = len(directions)
        self.best = np.full(k, -np.inf)
        self.least = np.full(k, np.inf)
        self.settled = np.full(k, -np.inf)
        self.evaluated = 0
        self.row = np.arange(k)
        self.lower = np.tile(region.lower, (k, 1))
        self.upper_corner = np.tile(region.upper, (k, 1))
        self.bound = np.full(k, np.inf)

    def run(self, budget: int, progress: Progress | None) -> np.ndarray:
        """Upper bounds of the maxima, (k,); within the tolerance of them if the budget of boxes sufficed."""
        shown = 0.0
        first_gap: np.ndarray | None = None
        while self.row.size and self.evaluated < budget:
            self._round()
            self._settle()
            if progress is not None:
                gap = np.maximum(self._upper() - self.best, 1e-300) / self._allowed()
                if first_gap is None and np.isfinite(gap).all():
                    first_gap = np.maximum(gap, 1.0 + 1e-9)
                if first_gap is not None:
                    left = np.log(np.maximum(gap, 1.0)) / np.log(first_gap)
                    shown = max(shown, float(1.0 - np.clip(left, 0.0, 1.0).mean()))
                    progress(shown)
        result = self._upper()
        if not np.isfinite(result).all():
            name = self.disturbance.model.plant.name
            raise DisturbanceError(
                f"{name}: after {self.evaluated} boxes the flow is still not enclosed in all of the region; take a "
                "smaller region, a shorter period, or a larger budget"
            )
        if progress is not None:
            progress(1.0)
        return result

    def _upper(self) -> np.ndarray:
        result = self.settled.copy()
        np.maximum.at(result, self.row, self.bound)
        return result

    def _allowed(self) -> np.ndarray:
        # The range seen so far is within the true one: what is allowed is never more than was asked for.
        with np.errstate(invalid="ignore"):
            seen = self.best - self.least
        return np.maximum(self.tolerance * np.where(np.isfinite(seen), seen, 0.0), self.floor)

    def _settle(self) -> None:
        done = self.bound <= self.best[self.row] + self._allowed()[self.row]
        np.maximum.at(self.settled, self.row[done], self.bound[done])
        self._keep(~done)

    def _keep(self, which: np.ndarray) -> None:
        self.row, self.bound = self.row[which], self.bound[which]
        self.lower, self.upper_corner = self.lower[which], self.upper_corner[which]

    def _round(self) -> None:
        """Evaluate the most promising boxes, and put what is left of each in its place."""
        urgency = (self.bound - self.best[self.row]) / self._allowed()[self.row]
        count = min(BATCH, self.row.size)
        chosen = np.argpartition(-urgency, count - 1)[:count]
        rows, lower, upper, parent = (
            a[chosen] for a in (self.row, self.lower, self.upper_corner, self.bound)
        )
        # Different directions often ask for the same box.
        boxes, place = np.unique(np.hstack([lower, upper]), axis=0, return_inverse=True)
        place = place.ravel()
        q = lower.shape[1]
        forms = self.disturbance.forms(boxes[:, :q], boxes[:, q:])
        self.evaluated += len(boxes)
        proved = forms.proved[place]
        mine = forms[place]
        f = self.directions[rows]
        value = interval_product(Interval.of(f)[:, None, :], mine.g[..., None])[:, 0, 0]
        slope = interval_product(Interval.of(f)[:, None, :], mine.G)[:, 0, :]
        reach = interval_product(Interval.of(slope.magnitude())[:, None, :], Interval.of(mine.r)[..., None])
        # A child lies in its parent, whose bound holds for it too.
        bound = np.where(proved, up(value.upper + reach.upper[:, 0, 0]), np.inf)
        bound = np.fmin(bound, parent)
        self._learn(rows[proved], value[proved], slope[proved], mine.r[proved])
        low, high = _faces(lower, upper, slope, proved)
        cut = self._cuts(slope, mine.r, lower, upper, low, high, proved, rows)
        middle = np.clip(0.5 * low + 0.5 * high, low, high)
        index = np.arange(len(rows))
        first_high, second_low = high.copy(), low.copy()
        first_high[index, cut], second_low[index, cut] = middle[index, cut], middle[index, cut]
        # A box that is a single point has one half, itself.
        point = (low == high).all(axis=1) & proved
        settled = (lower == upper).all(axis=1) & proved
        np.maximum.at(self.settled, rows[settled], bound[settled])
        keep = np.ones(self.row.size, dtype=bool)
        keep[chosen] = False
        self._keep(keep)
        for first, last, which in ((low, first_high, ~settled), (second_low, high, ~point)):
            self.row = np.concatenate([self.row, rows[which]])
            self.bound = np.concatenate([self.bound, bound[which]])
            self.lower = np.vstack([self.lower, first[which]])
            self.upper_corner = np.vstack([self.upper_corner, last[which]])

    def _learn(self, rows: np.ndarray, value: Interval, slope: Interval, r: np.ndarray) -> None:
        """What f'h certainly reaches: in the middle, and in the corner to which the slope points."""
        m = slope.middle()
        sure = np.maximum(np.abs(m) - slope.radius(m), 0.0)
        np.maximum.at(self.best, rows, value.lower + (sure * r).sum(axis=1) * (1 - 1e-12))
        np.minimum.at(self.least, rows, value.upper - (sure * r).sum(axis=1) * (1 - 1e-12))

    def _cuts(
        self,
        slope: Interval,
        r: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        proved: np.ndarray,
        rows: np.ndarray,
    ) -> np.ndarray:
        """The coordinate to halve, (n,): the one whose uncertain slope costs most."""
        width = self.region.upper - self.region.lower
        relative = (upper - lower) / np.where(width > 0, width, 1.0)
        if not proved.all():
            self._explain(lower[~proved], upper[~proved], relative[~proved])
        with np.errstate(invalid="ignore"):
            cost = np.where(low == high, -1.0, (slope.upper - slope.lower) * r)
        return np.where(proved[:, None], cost, relative).argmax(axis=1)

    def _explain(self, lower: np.ndarray, upper: np.ndarray, relative: np.ndarray) -> None:
        """Go on with boxes (n, q) that are not enclosed only while halving may help: not where a mere point fails."""
        c = np.clip(0.5 * lower + 0.5 * upper, lower, upper)
        points = self.disturbance.forms(c, c)
        for i, trouble in enumerate(points.trouble):
            if trouble or relative[i].max() <= FINEST:
                reason = trouble or "the flow is enclosed from points, but from no box that is not tiny"
                raise DisturbanceError(_nowhere(self.disturbance.model, lower[i], upper[i], reason))


def _faces(
    lower: np.ndarray, upper: np.ndarray, slope: Interval, proved: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The face of each box (n, q) that holds the maximum: where f'h is monotone, only an end counts."""
    rising, falling = (slope.lower >= 0) & proved[:, None], (slope.upper <= 0) & proved[:, None]
    return np.where(rising, upper, lower), np.where(falling & ~rising, lower, upper)


def bound_box(
    model: Model,
    region: Region,
    tolerance: float = 0.01,
    progress: Progress | None = None,
    budget: int = BUDGET,
) -> DisturbanceBound:
    """The smallest box around h over the region, each side within `tolerance` of h's range, never inside it.

    `progress` is called with the fraction done. After `budget` boxes the bound is what it is then: wider, as rigorous.

    Raises:
        DisturbanceError: the region is no region of this plant, or reaches where its equations do not hold.
    """
    disturbance = _prepare(model, region)
    low, high = _extent(disturbance, region, tolerance, progress, budget)
    return _plain(model, region, _corners(low, high), "box")


def bound_hull(
    model: Model,
    region: Region,
    directions: np.ndarray | None = None,
    tolerance: float = 0.01,
    progress: Progress | None = None,
    budget: int = BUDGET,
) -> DisturbanceBound:
    """A polytope around h over the region, tight in template directions.

    directions (k, d) are in units of the half-widths of h's box. By default: 16 in every plane of two components of h
    that are not negligible (wider than 1e-9 of X's width). The components that are keep their tiny box.

    Raises:
        DisturbanceError: as `bound_box`.
    """
    disturbance = _prepare(model, region)
    low, high = _extent(disturbance, region, tolerance, _part(progress, 0.0, 0.3), budget)
    half = 0.5 * (high - low)
    live = np.flatnonzero(high - low > NEGLIGIBLE * _width_of_x(region))
    template = _template(live, model.d) if directions is None else np.asarray(directions, dtype=float)
    if template.ndim != 2 or template.shape[1] != model.d or not np.isfinite(template).all():
        raise DisturbanceError(
            f"{model.plant.name}: template directions have the shape {template.shape}; give rows of {model.d} finite "
            "numbers"
        )
    # A component that is negligible has its own bounds already, whatever direction it is part of.
    template = template[:, live] if live.size else np.zeros((0, 0))
    template = template[np.count_nonzero(template, axis=1) > 1]
    if live.size < 2 or not len(template):
        return _plain(model, region, _corners(low, high), "hull")
    scale = half[live]
    rows = np.zeros((len(template), model.d))
    rows[:, live] = template / scale
    floor = tolerance * 1e-3 * np.linalg.norm(template, axis=1)
    search = _Search(disturbance, region, rows, tolerance, floor)
    support = search.run(budget, _part(progress, 0.3, 1.0))
    flat = _vertices(rows[:, live], support, low[live], high[live])
    rest = np.setdiff1d(np.arange(model.d), live)
    tiny = _corners(low[rest], high[rest])
    vertices = np.zeros((len(flat) * len(tiny), model.d))
    vertices[:, live], vertices[:, rest] = np.repeat(flat, len(tiny), axis=0), np.tile(tiny, (len(flat), 1))
    return _plain(model, region, vertices, "hull")


def bound_affine(model: Model, regions: Sequence[Region], cuts: int = 2) -> list[DisturbanceBound]:
    """For every region a slope and a box around what it leaves of h; 2^cuts pieces share the slope.

    The box is of second order in the region's size, its second-order part overestimated by about 1 / 2^cuts.

    Raises:
        DisturbanceError: as `bound_box`, for the first region it holds for.
    """
    if not regions:
        return []
    disturbance = _prepare(model, regions[0])
    for region in regions[1:]:
        _check(model, region)
    lower, upper = np.array([r.lower for r in regions]), np.array([r.upper for r in regions])
    owner = np.arange(len(regions))
    for cut in range(cuts + 1):
        forms = _all_proved(disturbance, lower, upper)
        if cut < cuts:
            lower, upper, owner = _halve(forms, lower, upper, owner)
    return [_affine(model, region, forms[owner == i]) for i, region in enumerate(regions)]


def given_box(model: Model, half_widths: np.ndarray, region: Region) -> DisturbanceBound:
    """The user's own W: |h_i| <= half_widths[i], (d,), claimed for the region and not verified here.

    Raises:
        DisturbanceError: not d finite numbers that are not negative.
    """
    _check(model, region)
    half = np.asarray(half_widths, dtype=float)
    if half.shape != (model.d,) or not np.isfinite(half).all() or (half < 0).any():
        raise DisturbanceError(
            f"{model.plant.name}: W is {half.tolist()}; give {model.d} half-widths, one per state "
            f"({', '.join(model.plant.states)}), finite and not negative"
        )
    return _plain(model, region, _corners(-half, half), "given")


def _extent(
    disturbance: _Disturbance, region: Region, tolerance: float, progress: Progress | None, budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest value of every component of h, (d,) each, rounded outwards."""
    d = disturbance.model.d
    floor = np.tile(NEGLIGIBLE * _width_of_x(region), 2)
    search = _Search(disturbance, region, np.vstack([np.eye(d), -np.eye(d)]), tolerance, floor)
    bounds = search.run(budget, progress)
    return -bounds[d:], bounds[:d]


def _affine(model: Model, region: Region, forms: _Forms) -> DisturbanceBound:
    d = model.d
    whole = Interval(forms.G.lower.min(axis=0), forms.G.upper.max(axis=0))
    slope = whole.middle()
    # h - H p in g - H c + (G - H)(p - c)
    linear = interval_product(Interval.of(slope), Interval.of(forms.c)[..., None])[..., 0]
    spread = interval_product(forms.G - slope, Interval(-forms.r, forms.r)[..., None])[..., 0]
    left = forms.g - linear + spread
    corners = _corners(left.lower.min(axis=0), left.upper.max(axis=0))
    return DisturbanceBound(region, slope[:, :d], slope[:, d:], corners, "affine")


def _halve(
    forms: _Forms, lower: np.ndarray, upper: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each box in two, across the coordinate that widens h's enclosure most (components relative to their own)."""
    cost = (forms.G.upper - forms.G.lower) * forms.r[:, None, :]
    total = cost.sum(axis=2, keepdims=True)
    # Components that are linear but for rounding have no say.
    share = np.where(total > 1e-9 * forms.r.max(axis=1)[:, None, None], cost / np.maximum(total, 1e-300), 0.0)
    cut = share.sum(axis=1).argmax(axis=1)
    index = np.arange(len(lower))
    first, second = upper.copy(), lower.copy()
    first[index, cut] = second[index, cut] = forms.c[index, cut]
    return np.vstack([lower, second]), np.vstack([first, upper]), np.concatenate([owner, owner])


def _all_proved(disturbance: _Disturbance, lower: np.ndarray, upper: np.ndarray) -> _Forms:
    parts = [
        disturbance.forms(lower[i : i + BATCH], upper[i : i + BATCH]) for i in range(0, len(lower), BATCH)
    ]
    forms = _Forms(
        np.vstack([p.c for p in parts]),
        np.vstack([p.r for p in parts]),
        Interval(np.vstack([p.g.lower for p in parts]), np.vstack([p.g.upper for p in parts])),
        Interval(np.vstack([p.G.lower for p in parts]), np.vstack([p.G.upper for p in parts])),
        tuple(t for p in parts for t in p.trouble),
    )
    for i, trouble in enumerate(forms.trouble):
        if trouble:
            raise DisturbanceError(_nowhere(disturbance.model, lower[i], upper[i], trouble))
    return forms


def _plain(model: Model, region: Region, vertices: np.ndarray, kind: str) -> DisturbanceBound:
    return DisturbanceBound(
        region, np.zeros((model.d, model.d)), np.zeros((model.d, model.m)), vertices, kind
    )


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.array(list(product(*zip(low, high, strict=True)))).reshape(2 ** len(low), len(low))


def _template(live: np.ndarray, d: int) -> np.ndarray:
    """ANGLES directions in every plane of two live components, less the axes, which the box has."""
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
    """Points (k, n) whose hull contains {w: rows w <= support, low <= w <= high}.

    Qhull's vertices are rounded. Moving every face outwards by PAD, in units in which the box is [-1, 1]^n and faces
    have unit normals, adds a ball of radius PAD; if every vertex of that larger polytope is off by less than PAD, the
    hull of the rounded vertices still contains the smaller one. That they are is checked: every face of the hull,
    found anew from the rounded vertices, is compared by a linear programme with the smaller polytope. Otherwise the
    box is returned, which contains it too.
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
    if max(reach) > 0:
        return _corners(low, high)
    return points * half + middle


def _width_of_x(region: Region) -> np.ndarray:
    return np.maximum(np.asarray(region.x_upper) - np.asarray(region.x_lower), 1e-12)


def _part(progress: Progress | None, start: float, end: float) -> Progress | None:
    if progress is None:
        return None
    return lambda fraction: progress(start + (end - start) * fraction)


def _prepare(model: Model, region: Region) -> _Disturbance:
    _check(model, region)
    return _Disturbance(model)


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


def _nowhere(model: Model, lower: np.ndarray, upper: np.ndarray, reason: str) -> str:
    plant = model.plant
    e = np.concatenate([plant.x_e, plant.u_e])
    names = plant.states + plant.inputs
    where = ", ".join(
        f"{name} in [{low:.6g}, {high:.6g}]"
        for name, low, high in zip(names, lower + e, upper + e, strict=True)
    )
    return (
        f"{plant.name}: no bound of h for {where} over a period of {model.period:g} s: {reason}. Take a smaller "
        "region of x and u, or a shorter period"
    )
