"""The disturbance of a plant given by equations, as an affine form over each of many boxes.

On each box p = (x, u) in c +- r the form is h(p) in g + G (p - c), with intervals g and G from a validated integration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.model import Model
from lbmpc.sets.enclosures.expression_graph import UnsupportedOperation
from lbmpc.sets.enclosures.flow import Flow, name_of
from lbmpc.sets.enclosures.interval import Interval, matrix_product, up


class DisturbanceError(ValueError):
    """The disturbance cannot be bounded as requested. The text says what, where, and what to do."""


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
class AffineForms:
    """h(p) in g + G (p - c), |p - c| <= r, for n boxes: c, r (n, q), g (n, d), G (n, d, q)."""

    c: np.ndarray
    r: np.ndarray
    g: Interval
    G: Interval
    trouble: tuple[str, ...]

    @property
    def proved(self) -> np.ndarray:
        return np.array([not t for t in self.trouble], dtype=bool)

    def __getitem__(self, index: np.ndarray) -> AffineForms:
        return AffineForms(
            self.c[index],
            self.r[index],
            self.g[index],
            self.G[index],
            tuple(self.trouble[i] for i in np.arange(len(self.trouble))[index]),
        )


class Disturbance:
    """h of one model, evaluated over batches of boxes."""

    def __init__(self, model: Model):
        self.model = model
        try:
            self.flow = Flow.of_plant(model.require_equations("a bound of h"), model.period)
        except UnsupportedOperation as error:
            names = " and ".join(name_of(model.plant, leaf) for leaf in error.leaves)
            raise DisturbanceError(
                f"{model.plant.name}: {error}. It is taken of an expression in {names}"
            ) from error
        self.e = Interval.of(np.concatenate([model.plant.x_e, model.plant.u_e]))
        self.AB = Interval.of(np.hstack([model.A, model.B]))

    def forms(self, lower: np.ndarray, upper: np.ndarray) -> AffineForms:
        """Return the affine forms of the boxes lower, upper (n, q), in deviation coordinates."""
        d = self.model.d
        c = np.clip(0.5 * lower + 0.5 * upper, lower, upper)
        r = np.where(lower == upper, 0.0, np.maximum(up(upper - c), up(c - lower)))
        box, centre = Interval(lower, upper) + self.e, Interval.of(c) + self.e
        enclosure = self.flow.enclose(box[:, :d], box[:, d:], centre[:, :d], centre[:, d:], r)
        linear = matrix_product(Interval.of(c)[:, None, :], Interval(self.AB.lower.T, self.AB.upper.T))[:, 0]
        g = enclosure.centre - self.e[:d] - linear
        return AffineForms(c, r, g, enclosure.derivative - self.AB, enclosure.trouble)


def nowhere(model: Model, lower: np.ndarray, upper: np.ndarray, reason: str) -> str:
    plant = model.plant
    e = np.concatenate([plant.x_e, plant.u_e])
    names = plant.states + plant.inputs
    where = ", ".join(
        f"{name} in [{low:.6g}, {high:.6g}]"
        for name, low, high in zip(names, lower + e, upper + e, strict=True)
    )
    return f"{plant.name}: no bound of h for {where} over a period of {model.period:g} s: {reason}"
