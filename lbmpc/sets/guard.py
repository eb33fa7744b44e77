"""Bounds on the first input v_0 that keep the plant in a certified family of sets, for a given state.

From x in a piece, the next state is in the piece's target for every w in W if

    T (A + slope_x) x + T (B + slope_u) v_0 <= t - h_W(T),          {x : T x <= t} the target.

For a single input this is an interval, for any number of facets. For several inputs it is a polytope in v_0, and the
box around its best-centred input is used. The box is smaller and equally safe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.sets.certificate import Certificate
from lbmpc.sets.geometry.linear_program import linprog, load

ROW_ROUNDING = 1e-10
"""Allowance in scaled lengths, so that rounding does not put a state outside that was steered onto its facet."""
SHARE, MOST = 0.5, 0.04
"""The bounds keep this share of the largest possible distance from the target's boundary. Distances above MOST, a share
of X's half-widths, count as MOST. The certificate does not need this reserve. It covers late commands and measurement
errors, which are not part of W. From every state of the family some input keeps the margin that `lbmpc.sets.check`
found, so half of that margin is kept everywhere."""
ROUNDS = 100
"""Largest number of Newton iterations. Usually three are enough."""


Bounds = tuple[np.ndarray, np.ndarray]
"""Lower and upper bounds, (m,) each."""


@dataclass(frozen=True, eq=False)
class FirstInputs:
    """The bounds of v_0 in a state.

    Inside the family, every input between `lower` and `upper`, (m,) each, keeps the plant in it, at some distance from
    the boundary. Outside, nothing is certified. The bounds then lead into the target of the nearest piece, as if the
    state were inside. If no input does, both bounds are the input that leads least far out. `margin` is the distance to
    the nearest facet as a share of X's half-widths, negative outside. `piece` is the index of the piece that contains
    x, -1 outside.
    """

    lower: np.ndarray
    upper: np.ndarray
    margin: float
    piece: int


class InputRows:
    """Rows of one piece's target in (x, v_0): P x + Q v_0 <= r."""

    def __init__(self, certificate: Certificate, index: int, scale: np.ndarray):
        piece, model = certificate.pieces[index], certificate.model
        target = certificate.pieces[piece.target]
        T, t = np.array(target.G), np.array(target.g)
        # Unit rows in scaled coordinates, so that one tolerance suits all rows.
        lengths = np.linalg.norm(T * scale, axis=1)
        T, t = T / lengths[:, None], t / lengths
        self.P = T @ (np.array(model.A) + np.array(piece.slope_x))
        self.Q = T @ (np.array(model.B) + np.array(piece.slope_u))
        self.r = t - (T @ np.array(piece.W).T).max(axis=1) - ROW_ROUNDING
        self.low, self.high = np.array(piece.u_lower), np.array(piece.u_upper)
        self.single = self.Q.shape[1] == 1
        if self.single:
            slope = self.Q[:, 0]
            self._up, self._down = slope > 0, slope < 0
            self._per_up, self._per_down = 1 / slope[self._up], 1 / slope[self._down]
            self._none = slope == 0
        else:
            load()

    def room(self, x: np.ndarray) -> np.ndarray:
        """Return the slack of each row for Q v_0 in the state x, (d,); (rows,)."""
        return np.asarray(self.r - self.P @ x)

    def within(self, room: np.ndarray, reserve: float) -> Bounds | None:
        """Return bounds on v_0, (m,) each, that keep `reserve` from the boundary; None if there are none."""
        return self._interval(room - reserve) if self.single else self._box(room - reserve)

    def farthest(self, room: np.ndarray, most: float) -> tuple[float, np.ndarray]:
        """Return the largest distance from the target's boundary that some input keeps, and that input, (m,).

        The distance is at most `most`. It is negative if every input leads outside; the input then leads least far.
        """
        return self._farthest_single(room, most) if self.single else self._farthest(room, most)

    def _interval(self, room: np.ndarray) -> Bounds | None:
        high = min(self.high[0], (room[self._up] * self._per_up).min(initial=np.inf))
        low = max(self.low[0], (room[self._down] * self._per_down).max(initial=-np.inf))
        if low > high or (room[self._none] < 0).any():
            return None
        return np.array([low]), np.array([high])

    def _farthest_single(self, room: np.ndarray, most: float) -> tuple[float, np.ndarray]:
        """Apply Newton's method to the width of the interval, a concave and decreasing function of the distance."""
        distance = min(most, room[self._none].min(initial=np.inf))
        per_up, per_down = np.append(self._per_up, 0.0), np.append(self._per_down, 0.0)
        high, low = (
            np.append(room[self._up] * self._per_up, self.high),
            np.append(room[self._down] * self._per_down, self.low),
        )
        for _ in range(ROUNDS):
            highs, lows = high - distance * per_up, low - distance * per_down
            i, j = int(np.argmin(highs)), int(np.argmax(lows))
            gap = lows[j] - highs[i]
            if gap <= 0.0:
                break
            nearer = distance - gap / (per_up[i] - per_down[j])
            if not nearer < distance:
                break
            distance = nearer
        return float(distance), np.clip([0.5 * (highs[i] + lows[j])], self.low, self.high)

    def _farthest(self, room: np.ndarray, most: float) -> tuple[float, np.ndarray]:
        m = len(self.low)
        found = linprog(
            np.append(np.zeros(m), -1.0),
            np.column_stack([self.Q, np.ones(len(room))]),
            room,
            bounds=[*zip(self.low, self.high, strict=True), (None, most)],
            method="highs",
        )
        return (
            (float(found.x[m]), np.clip(found.x[:m], self.low, self.high))
            if found.status == 0
            else (-np.inf, 0.5 * (self.low + self.high))
        )

    def _box(self, room: np.ndarray) -> Bounds | None:
        """Return the largest box with U's proportions in {Q v <= room} and U, by a linear program."""
        m, half = len(self.low), (self.high - self.low) / 2
        rows = np.column_stack([self.Q, np.abs(self.Q) @ half])
        ends = np.vstack([np.column_stack([np.eye(m), half]), np.column_stack([-np.eye(m), half])])
        found = linprog(
            np.append(np.zeros(m), -1.0),
            np.vstack([rows, ends]),
            np.concatenate([room, self.high, -self.low]),
            bounds=[(None, None)] * m + [(0.0, None)],
            method="highs",
        )
        if found.status != 0:
            return None
        centre, size = found.x[:m], found.x[m] * half
        return centre - size, centre + size


class Guard:
    """A certified family of sets, prepared for use in every tick."""

    def __init__(self, certificate: Certificate, share: float = SHARE, most: float = MOST):
        self._share, self._most = share, most
        x_lower, x_upper = (np.array(bound) for bound in certificate.model.X)
        self.scale = (x_upper - x_lower) / 2
        self.certificate = certificate
        lengths = [np.linalg.norm(np.array(piece.G) * self.scale, axis=1) for piece in certificate.pieces]
        self._G = np.vstack(
            [np.array(p.G) / n[:, None] for p, n in zip(certificate.pieces, lengths, strict=True)]
        )
        self._g = np.concatenate(
            [np.array(p.g) / n for p, n in zip(certificate.pieces, lengths, strict=True)]
        )
        self._starts = np.cumsum([0] + [len(n) for n in lengths[:-1]])
        self._steps = [InputRows(certificate, i, self.scale) for i in range(len(certificate.pieces))]

    def margins(self, x: np.ndarray) -> np.ndarray:
        """Return the distance of x (d,) to the nearest facet of each piece, as a share of half-widths; (pieces,)."""
        return np.minimum.reduceat(self._g - self._G @ x, self._starts)

    def first_inputs(self, x: np.ndarray) -> FirstInputs:
        """Return the certified bounds in state x, (d,), from the first piece that contains x."""
        margins = self.margins(x)
        best = float(margins.max())
        for index in np.flatnonzero(margins >= 0.0):
            found = self._inside(self._steps[index], x)
            if found is not None:
                return FirstInputs(*found, best, int(index))
        lower, upper = self._outside(self._steps[int(np.argmax(margins))], x)
        return FirstInputs(lower, upper, min(best, -ROW_ROUNDING), -1)

    def _inside(self, rows: InputRows, x: np.ndarray) -> Bounds | None:
        room = rows.room(x)
        distance, _ = rows.farthest(room, self._most)
        return None if distance < 0.0 else rows.within(room, self._share * distance)

    def _outside(self, rows: InputRows, x: np.ndarray) -> Bounds:
        found = self._inside(rows, x)
        if found is not None:
            return found
        _, least = rows.farthest(rows.room(x), self._most)
        return least, least
