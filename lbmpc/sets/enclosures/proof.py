"""Proof that h of a plant stays in a given W: for all x and u of a region, h(x, u) - L x - M u in conv(W).

The proof uses interval arithmetic. The region is cut into boxes until each row of W holds on each box. The origin of W
does not matter. The enclosure of the flow is the one that constructions of W also use.
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
"""Allowed violation of a row of W, scaled by the half-widths of X. Rounding depends on the processor."""
NARROW = 1e-7
"""Share of the half-width of X. A smaller width of W in a state is replaced by this one."""
BUDGET = 100_000
"""Largest number of boxes."""


@dataclass(frozen=True)
class Proved:
    """The result of a proof."""

    reason: str
    """Where h is not proved to stay in W; empty if the proof is complete."""
    beyond: float
    """Possible distance of h from its W, as a share of the half-widths of X: the effect of HAIR at the corners of W."""
    boxes: int


@dataclass(frozen=True, eq=False)
class _Rows:
    """F w <= b, (k, d) and (k,). It holds in W, and no solution is farther than `beyond` from W."""

    F: np.ndarray
    b: np.ndarray
    beyond: float

    def on(self, forms: AffineForms, slope: np.ndarray) -> tuple[np.ndarray, Interval, np.ndarray]:
        """Evaluate all rows of h - slope p over n boxes, in scaled lengths.

        Returns:
            The certain violation at the centre (n, k), slopes in p (n, k, q), and the certain slack everywhere (n, k).
        """
        F, H = Interval.of(self.F), Interval.of(slope)
        middle = forms.g - matrix_product(H, Interval.of(forms.c)[..., None])[..., 0]
        value = matrix_product(F, middle[..., None])[..., 0]
        slopes = matrix_product(F, forms.G - H)
        reach = matrix_product(Interval.of(slopes.magnitude()), Interval.of(forms.r)[..., None])[..., 0]
        return value.lower - self.b, slopes, down(self.b - up(value.upper + reach.upper))


def _of_certificate(model: Model, said: ModelOf) -> Model:
    """Return the model with exactly the certificate's numbers, which may differ in the last digit."""
    x_e, u_e = np.array(said.x_e), np.array(said.u_e)
    plant = replace(model.plant, x_e=x_e, u_e=u_e)
    equations = replace(model.require_equations("a proof"), x_e=x_e, u_e=u_e)
    return replace(
        model, plant=plant, equations=equations, period=said.period, A=np.array(said.A), B=np.array(said.B)
    )


def prove(
    model: Model, certificate: Certificate, progress: Progress | None = None, budget: int = BUDGET
) -> Proved:
    """Prove that h - L x - M u lies in W, in every piece, for all states of X in its box and all allowed inputs.

    Raises:
        DisturbanceError: the plant's flow cannot be enclosed from some of them.
    """
    rows: list[_Rows] = []
    for piece in certificate.pieces:
        found = _rows(np.array(piece.W), model.plant.x_scale)
        if found is None:
            return Proved(
                f"in piece {piece.name}, W is flat in a direction that is not a state's axis", np.inf, 0
            )
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
    """n boxes: piece (n,), row of its W or ALL (n,), share of the piece (n,), corners (n, q)."""

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
        """Mask of the boxes of zero size, (n,)."""
        return np.asarray((self.lower == self.upper).all(axis=1))


class _Work:
    """Boxes of all pieces without a proof, largest first; each for one row of its W or for all rows."""

    def __init__(self, model: Model, certificate: Certificate, rows: list[_Rows]):
        self._disturbance, self._rows = Disturbance(model), rows
        pieces = certificate.pieces
        self._names = [piece.name for piece in pieces]
        self._slopes = [np.hstack([np.array(p.slope_x), np.array(p.slope_u)]) for p in pieces]
        # A piece lies in X; otherwise `lbmpc.sets.check` refuses it.
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
        """Evaluate a batch of boxes. Boxes without a proof are halved and added again."""
        boxes, self._boxes = self._boxes[:BATCH], self._boxes[BATCH:]
        forms = self._disturbance.forms(boxes.lower, boxes.upper)
        self.evaluated += len(boxes.piece)
        self.done += float(boxes.share.sum())
        for i in np.unique(boxes.piece):
            mine = (boxes.piece == i) & forms.proved
            self._halve_rows(boxes[mine], forms[mine], int(i))
        # Boxes without an enclosure are halved across the side that is longest relative to the piece's box.
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
        self._require_more_than_points(left, ["W has no slack for h"] * len(box))
        # If a row is monotone along a side, its maximum is at that end.
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
        # They are added at the end, because a large batch costs little more than a small one.
        for lower, upper in ((boxes.lower, first), (second, boxes.upper)):
            self._boxes = self._boxes.and_(_Boxes(boxes.piece, boxes.row, share, lower, upper))

    def _require_more_than_points(self, failed: _Boxes, why: list[str]) -> None:
        for at in np.flatnonzero(failed.points)[:1]:
            self.reason = nowhere(self._disturbance.model, failed.lower[at], failed.upper[at], why[at])


def _rows(W: np.ndarray, half: np.ndarray) -> _Rows | None:
    """Return rows that bound conv(W), with vertices (k, d); None if W is flat off the states' axes."""
    low, high = (W / half).min(axis=0), (W / half).max(axis=0)
    middle, radius = 0.5 * (low + high), 0.5 * (high - low)
    wide = np.flatnonzero(radius > NARROW)
    radius = np.maximum(radius, NARROW)
    d, narrow = len(half), len(half) - len(wide)
    # The box around W, and in the states in which W is wide the faces of its hull.
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
        # {F w <= b + HAIR} lies in W scaled about an inner point by HAIR over the distance of that point to the rows.
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
    return f"in piece {piece}, from x = {x} with u = {u}, h is outside W by {excess:.3g} of X's half-widths"
