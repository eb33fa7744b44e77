"""Proof that a plant's h stays in a given W: for all x and u of a region, h(x, u) - L x - M u in conv(W).

By interval arithmetic, with the region cut into boxes until each row of W holds on each of them. Who made W, and how,
does not matter; the enclosure of the flow is what constructions of W use too.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

from lbmpc.model import Model
from lbmpc.sets.certificate import Certificate, ModelOf
from lbmpc.sets.enclosures.affine_forms import AffineForms, Disturbance, nowhere
from lbmpc.sets.enclosures.branch_and_bound import BATCH, Progress
from lbmpc.sets.enclosures.interval import Interval, down, matrix_product, up

HAIR = 1e-9
"""What a row of W may be exceeded by, in lengths scaled by X's half-widths: another processor rounds otherwise."""
NARROW = 1e-7
"""A W that is narrower than this in a state, as a share of X's half-width, is taken for as wide as this there."""
BUDGET = 100_000
"""Boxes at most."""


@dataclass(frozen=True)
class Proved:
    """What came of the proof."""

    reason: str
    """Where h is not proved to stay in W; empty where it is everywhere."""
    beyond: float
    """How far outside of its W h may still be, as a share of X's half-widths: what HAIR is at W's corners."""
    boxes: int


@dataclass(frozen=True, eq=False)
class _Rows:
    """F w <= b, (k, d) and (k,), which holds in W, and beyond it only `beyond` from it."""

    F: np.ndarray
    b: np.ndarray
    beyond: float

    def on(self, forms: AffineForms, slope: np.ndarray) -> tuple[np.ndarray, Interval, np.ndarray]:
        """Over n boxes, of every row over h - slope p: by how much it is certainly broken in the middle (n, k), its
        slopes in p (n, k, q), and the room that certainly is left everywhere (n, k); in scaled lengths."""
        F, H = Interval.of(self.F), Interval.of(slope)
        middle = forms.g - matrix_product(H, Interval.of(forms.c)[..., None])[..., 0]
        value = matrix_product(F, middle[..., None])[..., 0]
        slopes = matrix_product(F, forms.G - H)
        reach = matrix_product(Interval.of(slopes.magnitude()), Interval.of(forms.r)[..., None])[..., 0]
        return value.lower - self.b, slopes, down(self.b - up(value.upper + reach.upper))


def _of_certificate(model: Model, said: ModelOf) -> Model:
    """The model with the very numbers that a certificate has; they may differ in the last digit."""
    x_e, u_e = np.array(said.x_e), np.array(said.u_e)
    plant = replace(model.plant, x_e=x_e, u_e=u_e)
    equations = replace(model.require_equations("a proof"), x_e=x_e, u_e=u_e)
    return replace(
        model, plant=plant, equations=equations, period=said.period, A=np.array(said.A), B=np.array(said.B)
    )


def prove(
    model: Model, certificate: Certificate, progress: Progress | None = None, budget: int = BUDGET
) -> Proved:
    """Whether h - L x - M u lies in W, in every piece, for all states of X in its box and all inputs allowed there.

    Raises:
        DisturbanceError: nothing is known of the plant's flow from some of them.
    """
    rows: list[_Rows] = []
    for piece in certificate.pieces:
        found = _rows(np.array(piece.W), model.plant.x_scale)
        if found is None:
            return Proved(f"in piece {piece.name}, W is flat in a direction that is no state's", np.inf, 0)
        rows.append(found)
    work = _Work(_of_certificate(model, certificate.model), certificate, rows)
    while work.left and not work.reason:
        if work.evaluated >= budget:
            work.reason = f"not decided after {budget} boxes: h comes too close to W's boundary"
        else:
            work.take()
        if progress is not None:
            progress(min(work.done / len(rows), 1.0))
    return Proved(work.reason, max(row.beyond for row in rows), work.evaluated)


ALL = -1


@dataclass(frozen=True, eq=False)
class _Boxes:
    """n boxes: whose piece (n,), for which row of its W or ALL (n,), what share of the piece (n,), corners (n, q)."""

    piece: np.ndarray
    row: np.ndarray
    share: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def __getitem__(self, index: np.ndarray | slice) -> _Boxes:
        return _Boxes(*(getattr(self, one.name)[index] for one in fields(self)))

    def and_(self, more: _Boxes) -> _Boxes:
        return _Boxes(
            *(np.concatenate([getattr(self, one.name), getattr(more, one.name)]) for one in fields(self))
        )

    @property
    def points(self) -> np.ndarray:
        """Those of no extent, (n,)."""
        return np.asarray((self.lower == self.upper).all(axis=1))


class _Work:
    """Boxes of all pieces on which W is not proved yet, the largest first; each for all rows of its W, or for one."""

    def __init__(self, model: Model, certificate: Certificate, rows: list[_Rows]):
        self._disturbance, self._rows = Disturbance(model), rows
        pieces = certificate.pieces
        self._names = [piece.name for piece in pieces]
        self._slopes = [np.hstack([np.array(p.slope_x), np.array(p.slope_u)]) for p in pieces]
        # A piece lies in X, or `lbmpc.sets.check` refuses it.
        (x_low, x_high), (u_low, u_high) = certificate.model.X, certificate.model.U
        lower = np.array([np.maximum([*p.x_lower, *p.u_lower], [*x_low, *u_low]) for p in pieces])
        upper = np.array([np.minimum([*p.x_upper, *p.u_upper], [*x_high, *u_high]) for p in pieces])
        self._width = np.maximum(upper - lower, 1e-300)
        self._boxes = _Boxes(
            np.arange(len(pieces)), np.full(len(pieces), ALL), np.ones(len(pieces)), lower, upper
        )
        self.evaluated, self.done, self.reason = 0, 0.0, ""

    @property
    def left(self) -> int:
        return len(self._boxes.piece)

    def take(self) -> None:
        """Look at a batch of boxes; what is not proved on them comes back in halves."""
        boxes, self._boxes = self._boxes[:BATCH], self._boxes[BATCH:]
        forms = self._disturbance.forms(boxes.lower, boxes.upper)
        self.evaluated += len(boxes.piece)
        self.done += float(boxes.share.sum())
        for i in np.unique(boxes.piece):
            mine = (boxes.piece == i) & forms.proved
            self._halve_rows(boxes[mine], forms[mine], int(i))
        # Where nothing is enclosed, across the side that is the longest beside the piece's box.
        rest, trouble = boxes[~forms.proved], [text for text in forms.trouble if text]
        self._require_more_than_points(rest, trouble)
        self._halve(rest, (rest.upper - rest.lower) / self._width[rest.piece])

    def _halve_rows(self, boxes: _Boxes, forms: AffineForms, i: int) -> None:
        broken, slopes, room = self._rows[i].on(forms, self._slopes[i])
        asked = (boxes.row[:, None] == ALL) | (boxes.row[:, None] == np.arange(broken.shape[1]))
        if (broken[asked] > 0.0).any():
            at = int(broken.max(axis=1).argmax())
            self.reason = _outside(
                self._disturbance.model, self._names[i], forms.c[at], float(broken[at].max())
            )
            return
        box, row = np.nonzero(asked & ~(room >= 0.0))
        slope, left = slopes[box, row], boxes[box]
        self._require_more_than_points(left, ["W leaves no room beyond h"] * len(box))
        # Where a row rises or falls all along a side, its maximum is at that end.
        low = np.where(slope.lower >= 0.0, left.upper, left.lower)
        high = np.where((slope.upper <= 0.0) & (slope.lower < 0.0), left.lower, left.upper)
        share = left.share / np.bincount(box, minlength=len(boxes.piece))[box]
        cost = (slope.upper - slope.lower) * forms.r[box]
        self._halve(_Boxes(left.piece, row, share, low, high), cost)

    def _halve(self, boxes: _Boxes, cost: np.ndarray) -> None:
        self.done -= float(boxes.share.sum())
        points = boxes.points
        self._boxes = self._boxes.and_(boxes[points])
        boxes, cost = boxes[~points], np.where(boxes.lower == boxes.upper, -1.0, cost)[~points]
        index, cut = np.arange(len(cost)), cost.argmax(axis=1)
        low, high = boxes.lower[index, cut], boxes.upper[index, cut]
        middle = 0.5 * low + 0.5 * high
        first, second = boxes.upper.copy(), boxes.lower.copy()
        first[index, cut] = second[index, cut] = middle
        share = boxes.share / 2
        # Behind the others: a large batch costs little more than a small one.
        for lower, upper in ((boxes.lower, first), (second, boxes.upper)):
            self._boxes = self._boxes.and_(_Boxes(boxes.piece, boxes.row, share, lower, upper))

    def _require_more_than_points(self, failed: _Boxes, why: list[str]) -> None:
        for at in np.flatnonzero(failed.points)[:1]:
            self.reason = nowhere(self._disturbance.model, failed.lower[at], failed.upper[at], why[at])


def _rows(W: np.ndarray, half: np.ndarray) -> _Rows | None:
    """Rows that bound conv(W), of vertices (k, d); None where W is flat in a direction that is no state's."""
    low, high = (W / half).min(axis=0), (W / half).max(axis=0)
    middle, radius = 0.5 * (low + high), 0.5 * (high - low)
    wide = np.flatnonzero(radius > NARROW)
    radius = np.maximum(radius, NARROW)
    d, narrow = len(half), len(half) - len(wide)
    # The box around W, and in the states where W is wide the faces of its hull.
    F, b = np.vstack([np.eye(d), -np.eye(d)]), np.concatenate([middle + radius, radius - middle])
    if len(wide) > 1:
        try:
            faces = ConvexHull(((W / half - middle) / radius)[:, wide]).equations
        except QhullError:
            return None
        rows = np.zeros((len(faces), d))
        rows[:, wide] = faces[:, :-1] / radius[wide]
        rows = np.unique(np.round(rows / np.linalg.norm(rows, axis=1)[:, None], 12), axis=0)
        F, b = np.vstack([F, rows]), np.concatenate([b, ((W / half) @ rows.T).max(axis=0)])
    beyond = 2 * NARROW * np.sqrt(narrow)
    if len(wide):
        # {F w <= b + HAIR} lies in W blown up about a point inside by HAIR over that point's distance to the rows.
        bounding = np.abs(F[:, wide]).max(axis=1) > 0
        rows = np.column_stack([F[bounding][:, wide], np.ones(bounding.sum())])
        inside = linprog(np.append(np.zeros(len(wide)), -1.0), rows, b[bounding], bounds=(None, None))
        if inside.status != 0 or inside.x[-1] < 10 * HAIR:
            return None
        beyond += 2 * HAIR / float(inside.x[-1]) * float(np.linalg.norm(high - low))
    return _Rows(F / half, b + HAIR, beyond)


def _outside(model: Model, piece: str, point: np.ndarray, excess: float) -> str:
    e = np.concatenate([model.plant.x_e, model.plant.u_e])
    x, u = (np.array2string(part, precision=6) for part in np.split(point + e, [model.d]))
    return (
        f"in piece {piece}, from x = {x} with u = {u}, h is outside of W by {excess:.3g} of X's half-widths"
    )
