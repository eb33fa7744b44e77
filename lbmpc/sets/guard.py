"""The first input that keeps the plant in a certified family of sets: bounds on v_0 alone, for the state at hand.

From x in a piece, the next state is in the piece's target for every w in W as long as

    T (A + slope_x) x + T (B + slope_u) v_0 <= t - h_W(T),          {x : T x <= t} the target.

For one input that is an interval, whatever the number of facets. For more, it is a polytope in v_0, of which the box
around the best-centred input is used: smaller, and as safe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.sets.certificate import Certificate
from lbmpc.sets.geometry.linear_program import linprog, load

ROW_ROUNDING = 1e-10
"""In scaled lengths: rounding of a row's value must not put a state outside that was steered onto its facet."""
RESERVES = (0.02, 0.005, 0.001)
"""Distances from the target's boundary, as shares of X's half-widths, that are kept where some input keeps them: the
claim does not need them, but a command that acts late, or a measurement that is off, is not part of W."""


@dataclass(frozen=True, eq=False)
class FirstInputs:
    """What is certified of v_0 in a state.

    `lower` and `upper` (m,) keep the family, at some distance from its boundary where that can be had; None outside,
    where nothing is certified. `margin` is the distance to the nearest facet, as a share of X's half-widths, negative
    outside. `piece` is the set that x is in, -1 outside.
    """

    lower: np.ndarray | None
    upper: np.ndarray | None
    margin: float
    piece: int


class _InputRows:
    """Rows of one piece's target over (x, v_0): P x + Q v_0 <= r."""

    def __init__(self, certificate: Certificate, index: int, scale: np.ndarray):
        piece, model = certificate.pieces[index], certificate.model
        target = certificate.pieces[piece.target]
        T, t = np.array(target.G), np.array(target.g)
        # Unit rows in scaled coordinates, so that one tolerance fits all.
        lengths = np.linalg.norm(T * scale, axis=1)
        T, t = T / lengths[:, None], t / lengths
        self.P = T @ (np.array(model.A) + np.array(piece.slope_x))
        self.Q = T @ (np.array(model.B) + np.array(piece.slope_u))
        self.r = t - (T @ np.array(piece.W).T).max(axis=1) - ROW_ROUNDING
        self.low, self.high = np.array(piece.u_lower), np.array(piece.u_upper)
        if self.Q.shape[1] == 1:
            slope = self.Q[:, 0]
            self._up, self._down = slope > 0, slope < 0
            self._per_up, self._per_down = 1 / slope[self._up], 1 / slope[self._down]
            self._none = slope == 0
        else:
            load()

    def bounds(self, x: np.ndarray, reserves: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray] | None:
        """Of v_0, (m,) each, with the first of the reserves that can be had, or none; None when there are no bounds."""
        room = self.r - self.P @ x
        find = self._interval if self.Q.shape[1] == 1 else self._box
        for reserve in (*reserves, 0.0):
            found = find(room - reserve)
            if found is not None:
                return found
        return None

    def _interval(self, room: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        high = min(self.high[0], (room[self._up] * self._per_up).min(initial=np.inf))
        low = max(self.low[0], (room[self._down] * self._per_down).max(initial=-np.inf))
        if low > high or (room[self._none] < 0).any():
            return None
        return np.array([low]), np.array([high])

    def _box(self, room: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """The largest box of U's proportions inside {Q v <= room} and U, by a linear program in (centre, size)."""
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
    """A certified family of sets, ready to be asked at every tick."""

    def __init__(self, certificate: Certificate, reserves: tuple[float, ...] = RESERVES):
        self._reserves = reserves
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
        self._steps = [_InputRows(certificate, i, self.scale) for i in range(len(certificate.pieces))]

    def margins(self, x: np.ndarray) -> np.ndarray:
        """Distance of x (d,) to the nearest facet of each piece, as a share of X's half-widths; (pieces,)."""
        return np.minimum.reduceat(self._g - self._G @ x, self._starts)

    def first_inputs(self, x: np.ndarray) -> FirstInputs:
        """What is certified in state x, (d,). The first piece that holds x decides: it is the nearest to the end."""
        margins = self.margins(x)
        best = float(margins.max())
        for index in np.flatnonzero(margins >= 0.0):
            found = self._steps[index].bounds(x, self._reserves)
            if found is not None:
                return FirstInputs(*found, best, int(index))
        return FirstInputs(None, None, min(best, -ROW_ROUNDING), -1)
