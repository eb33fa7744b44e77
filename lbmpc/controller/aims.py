"""The references of a plan: the target of the present reference and of its knots within the horizon."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lbmpc.model import Model
from lbmpc.references import Change, Preview, Reference, between, changed, preview
from lbmpc.targets import SteadyState, TargetSelector

STEP = 0.1
"""Periods. A shorter interval between two knots is treated as a step, because no plan can follow it."""


@dataclass(frozen=True, eq=False)
class Aim:
    """The target and references of one plan. All fields are None when the plan leads to the equilibrium."""

    target: SteadyState | None = None
    """The target of the present reference."""
    xr: np.ndarray | None = None
    """State references: (1, d) if they are constant over the horizon, else (N + 1, d)."""
    ur: np.ndarray | None = None
    """Input references: (1, m) or (N, m)."""

    @property
    def references(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """The references as arguments of a solver."""
        return self.xr, self.ur

    @property
    def xu(self) -> np.ndarray:
        """x and u of the present target, (d + m,); (0,) without one."""
        return np.zeros(0) if self.target is None else self.target.xu


class Aims:
    """Finds the targets of plans.

    Args:
        model: the nominal model.
        horizon: N.
        targets: finds the target of one reference. With None every plan leads to the equilibrium.
        configured: the reference until another one is given; None means the equilibrium.
    """

    def __init__(
        self, model: Model, horizon: int, targets: TargetSelector | None, configured: Reference | None
    ):
        self.targets, self._configured = targets, configured
        self._model, self._horizon = model, horizon
        outputs = () if configured is None else configured.outputs
        self._own = outputs or tuple(model.plant.performance)

    @property
    def nothing_yet(self) -> np.ndarray:
        """The target before the first search, (d + m,); (0,) if plans lead to the equilibrium."""
        size = 0 if self._configured is None else self._model.d + self._model.m
        return np.zeros(size)

    def latched(
        self,
        present: Reference | None,
        change: Change | None,
        skipped: int,
        x: np.ndarray,
        target: np.ndarray,
    ) -> Reference | None:
        """Return the reference of this tick; None means the configured one.

        Args:
            present: the reference of the previous tick, advanced by one period.
            change: the requested change; None if there is none.
            skipped: periods without a tick since then.
            x: the present state, (d,).
            target: the last target, (d + m,), or (0,).
        """
        if present is not None and skipped:
            present = present.advanced(skipped)
        if change is None or self.targets is None:
            return present
        aim = target[: self._model.d] if target.size else np.zeros(self._model.d)
        return changed(present or self._configured, change, self._model.period, x, aim, self._own)

    def find(
        self, reference: Reference | None, theta: np.ndarray, last: np.ndarray, ahead: float, new: bool = True
    ) -> Aim:
        """Return the aim of a plan that begins `ahead` seconds from now.

        Args:
            reference: the reference in force; None means the configured one.
            theta: the oracle's parameters.
            last: the last target, (d + m,), or (0,), as start of the search.
            ahead: seconds.
            new: False if `last` already is the present target.
        """
        asked = reference or self._configured
        if asked is None or self.targets is None:
            return Aim()
        d, size = self._model.d, self._model.d + self._model.m
        seen = preview(asked, ahead, self._model.period, self._horizon)
        begin = last if last.size else np.zeros(size)
        first = (
            self.targets.find(theta, begin, asked.outputs, seen.values[0]) if new or not last.size else None
        )
        rests = [begin if first is None else first.xu]
        for before, r in pairwise(seen.values):
            same = (r == before).all()
            rests.append(rests[-1] if same else self.targets.find(theta, rests[-1], asked.outputs, r).xu)
        if len(rests) == 1:
            return Aim(first, rests[0][None, :d], rests[0][None, d:])
        over = self._along(asked.outputs, seen, rests, theta)
        return Aim(first, over[:, :d], over[:-1, d:])

    def _along(
        self, outputs: tuple[int, ...], seen: Preview, rests: list[np.ndarray], theta: np.ndarray
    ) -> np.ndarray:
        """Return x and u over the horizon, (N + 1, d + m), from the rests of its knots, (d + m,) each.

        Between two knots the references move, so the points are not rests: a plant on them moves with the reference.
        The distance from the rests is computed at the first of the two knots.
        """
        assert self.targets is not None
        positions: list[float] = []
        points: list[np.ndarray] = []
        for (begin, a, r), (end, b, _s) in pairwise(zip(seen.positions, rests, seen.values, strict=True)):
            if end - begin < STEP:
                continue
            v = (b - a)[: self._model.d] / (end - begin)
            positions += [begin, end]
            if v.any() and (moving := self.targets.find(theta, a, outputs, r, v)).status != "no rest":
                a, b = moving.xu, b + moving.xu - a
            points += [a, b]
        return between(np.array(positions), np.array(points), np.arange(self._horizon + 1.0))
