"""Imperfect sensors of a simulated plant: noise (white or coloured), quantisation, bias, lost samples, stuck, dead."""

from __future__ import annotations

import math

import numpy as np

from lbmpc.plants import Description
from node_runtime.config.plant import in_half_widths
from node_runtime.config.sections import Config

SENSORS = 0x4015E
"""Combined with the seed, so that no other part of a run draws the same numbers."""


class Sensors:
    """Measures a true state. Equal calls give equal numbers.

    Args:
        config: provides `plant.sensors` and the seed.
        plant: provides states and half-widths.
    """

    def __init__(self, config: Config, plant: Description):
        self._settings, self._scale = config.plant.sensors, plant.x_scale
        settings, names = self._settings, plant.states
        self._noise = in_half_widths(settings.noise, plant) * self._scale
        self._step = in_half_widths(settings.quantisation, plant) * self._scale
        self._bias = in_half_widths(settings.bias, plant) * self._scale
        self._stuck_from = np.array([settings.stuck.get(name, math.inf) for name in names])
        self._dead_from = np.array([settings.dead.get(name, math.inf) for name in names])
        self._draws = np.random.default_rng([config.seed, SENSORS])
        self._last: tuple[float, np.ndarray] | None = None
        self._first: float | None = None
        self._held = np.full(len(names), math.nan)
        shares = self._noise.any() or self._step.any() or self._bias.any()
        self._perfect = not (shares or settings.stuck or settings.dead or settings.dropouts)

    def measure(self, x: np.ndarray, t: float) -> np.ndarray | None:
        """Return the measurement of x, (d,), at time t in seconds, in plant units; None if the sample is lost.

        States with a dead sensor are NaN. t must not decrease.
        """
        if self._perfect:
            return x
        self._first = t if self._first is None else self._first
        since = t - self._first
        seen = x + self._noise * self._drawn(t)
        if since >= self._settings.bias_at:
            seen = seen + self._bias
        coarse = self._step > 0.0
        seen[coarse] = np.rint(seen[coarse] / self._step[coarse]) * self._step[coarse]
        stuck = since >= self._stuck_from
        self._held = np.where(stuck & ~np.isnan(self._held), self._held, np.where(stuck, seen, math.nan))
        seen = np.where(since >= self._dead_from, math.nan, np.where(stuck, self._held, seen))
        lost = self._settings.dropouts > 0.0 and self._draws.uniform() < self._settings.dropouts
        return None if lost else seen

    def _drawn(self, t: float) -> np.ndarray:
        """Return noise of variance 1, (d,)."""
        drawn, correlation = self._draws.standard_normal(len(self._scale)), self._settings.correlation
        if correlation > 0.0 and self._last is not None:
            at, before = self._last
            kept = math.exp(-(t - at) / correlation)
            drawn = kept * before + math.sqrt(1.0 - kept * kept) * drawn
        self._last = t, drawn
        return drawn
