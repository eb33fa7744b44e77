"""Upper bounds for the maxima of f'h over a region, to a tolerance, by branch and bound on affine forms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lbmpc.sets.enclosures.affine_forms import Disturbance, DisturbanceError, Region, nowhere
from lbmpc.sets.enclosures.flow import SMALLER
from lbmpc.sets.enclosures.interval import Interval, matrix_product, up

Progress = Callable[[float], None]

BATCH = 256
# Smallest share of a region's width at which it is searched for the domain of the plant's equations.
FINEST = 2.0**-12


class BranchAndBound:
    """Branch and bound for the maxima of f'h over a region, for all rows f of `directions` (k, d) at once.

    `upper()` is valid at any time: every discarded box has left its upper bound in `settled`.
    """

    def __init__(
        self,
        disturbance: Disturbance,
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
        """Return upper bounds of the maxima, (k,), within the tolerance if the budget of boxes is large enough."""
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
                f"{name}: after {self.evaluated} boxes the flow is still not enclosed in the whole region; use a "
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
        # The range found so far lies within the true one, so the allowed error is never too large.
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
        """Evaluate the most promising boxes and replace each by its remaining parts."""
        urgency = (self.bound - self.best[self.row]) / self._allowed()[self.row]
        count = min(BATCH, self.row.size)
        chosen = np.argpartition(-urgency, count - 1)[:count]
        rows, lower, upper, parent = (
            a[chosen] for a in (self.row, self.lower, self.upper_corner, self.bound)
        )
        # Different directions often need the same box.
        boxes, place = np.unique(np.hstack([lower, upper]), axis=0, return_inverse=True)
        place = place.ravel()
        q = lower.shape[1]
        forms = self.disturbance.forms(boxes[:, :q], boxes[:, q:])
        self.evaluated += len(boxes)
        proved = forms.proved[place]
        mine = forms[place]
        f = self.directions[rows]
        value = matrix_product(Interval.of(f)[:, None, :], mine.g[..., None])[:, 0, 0]
        slope = matrix_product(Interval.of(f)[:, None, :], mine.G)[:, 0, :]
        reach = matrix_product(Interval.of(slope.magnitude())[:, None, :], Interval.of(mine.r)[..., None])
        # A child lies in its parent, so the parent's bound holds for it.
        bound = np.where(proved, up(value.upper + reach.upper[:, 0, 0]), np.inf)
        bound = np.fmin(bound, parent)
        self._learn(rows[proved], value[proved], slope[proved], mine.r[proved])
        low, high = _faces(lower, upper, slope, proved)
        cut = self._cuts(slope, mine.r, lower, upper, low, high, proved, rows)
        middle = np.clip(0.5 * low + 0.5 * high, low, high)
        index = np.arange(len(rows))
        first_high, second_low = high.copy(), low.copy()
        first_high[index, cut], second_low[index, cut] = middle[index, cut], middle[index, cut]
        # A box that is a single point has only one half, itself.
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
        """Record values that f'h certainly attains: at the centre, and in the corner along the slope."""
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
        """Return the coordinate to halve, (n,): the one with the largest contribution of its slope's uncertainty."""
        width = self.region.upper - self.region.lower
        relative = (upper - lower) / np.where(width > 0, width, 1.0)
        if not proved.all():
            self._explain(lower[~proved], upper[~proved], relative[~proved])
        with np.errstate(invalid="ignore"):
            cost = np.where(low == high, -1.0, (slope.upper - slope.lower) * r)
        return np.where(proved[:, None], cost, relative).argmax(axis=1)

    def _explain(self, lower: np.ndarray, upper: np.ndarray, relative: np.ndarray) -> None:
        """Raise `DisturbanceError` for boxes (n, q) without enclosure if halving cannot help, as for single points."""
        c = np.clip(0.5 * lower + 0.5 * upper, lower, upper)
        points = self.disturbance.forms(c, c)
        for i, trouble in enumerate(points.trouble):
            if trouble or relative[i].max() <= FINEST:
                reason = (
                    trouble or f"the flow is enclosed from points, but only from very small boxes. {SMALLER}"
                )
                raise DisturbanceError(nowhere(self.disturbance.model, lower[i], upper[i], reason))


def _faces(
    lower: np.ndarray, upper: np.ndarray, slope: Interval, proved: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the face of each box (n, q) with the maximum: along a monotone coordinate only one end matters."""
    rising, falling = (slope.lower >= 0) & proved[:, None], (slope.upper <= 0) & proved[:, None]
    return np.where(rising, upper, lower), np.where(falling & ~rising, lower, upper)
