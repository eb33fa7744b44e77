"""Control properties of a model: reachability, growth, settling time and disturbance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lbmpc.model import Model, growth_rate, longest_horizon
from lbmpc.plants.description import PlantError

SETTLED = 0.2
"""Half-widths. A state counts as settled when it is this close to rest."""
MOST_STEPS = 1000

Step = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""`lbmpc.plants.TrueMotion.step`: (x, u, dt) -> x, in plant units."""


def poles(matrix: np.ndarray, period: float) -> np.ndarray:
    """Return the continuous-time poles, 1/s, of a discrete-time matrix (d, d), fastest first; -inf for eigenvalue 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.log(np.linalg.eigvals(matrix).astype(complex)) / period
    return found[np.lexsort((-found.imag, -found.real))]


def reach(model: Model, steps: int) -> np.ndarray:
    """Return how far inputs within a half-width of u_e move each state from x_e in `steps`, half-widths, (d,)."""
    x, u = model.plant.x_scale, model.plant.u_scale
    total, response = np.zeros(model.d), model.B * u / x[:, None]
    transition = model.A * x / x[:, None]
    for _ in range(steps):
        total += np.abs(response).sum(axis=1)
        response = transition @ response
    return total


def growth(model: Model, steps: int) -> float:
    """Return the factor by which the fastest mode grows over `steps` steps; at least 1."""
    return math.exp(min(700.0, steps * growth_rate(model)))


def settling_steps(model: Model) -> int:
    """Return the steps in which u = K x brings every state of X within `SETTLED` half-widths, without bounds on u.

    A horizon of this length covers the whole way to rest. A shorter one relies on the terminal cost.
    """
    x = model.plant.x_scale
    closed = model.closed_loop * x / x[:, None]
    power = np.eye(model.d)
    for steps in range(MOST_STEPS):
        if np.abs(power).sum(axis=1).max() <= SETTLED:
            return steps
        power = closed @ power
    return MOST_STEPS


def advised_horizon(model: Model) -> int:
    """Return a horizon in steps: the settling time, limited by `longest_horizon`; at least 1."""
    most = longest_horizon(model)
    return max(1, min(settling_steps(model), MOST_STEPS if most is None else most))


@dataclass(frozen=True, eq=False)
class SampledDisturbance:
    """The largest |h| found at random states of X and inputs of U."""

    largest: np.ndarray
    """Largest |h| of each state, (d,), per second."""
    x: np.ndarray
    """Row i is the state at which `largest[i]` was found, (d, d), plant units; `u` is the input, (d, m)."""
    u: np.ndarray
    samples: int
    lost: int
    """Number of samples at which the true motion could not be computed."""


def sample_disturbance(model: Model, step: Step, count: int, rng: np.random.Generator) -> SampledDisturbance:
    """Return the largest |h| = |x+ - A x - B u| of the true motion at `count` points of X x U.

    Half of the points lie on the boundary. A side without a bound is placed a half-width from (x_e, u_e).
    """
    plant = model.plant
    rest, scale = np.concatenate([plant.x_e, plant.u_e]), np.concatenate([plant.x_scale, plant.u_scale])
    low = np.concatenate([plant.x_min, plant.u_min])
    high = np.concatenate([plant.x_max, plant.u_max])
    low = np.where(np.isfinite(low), low, rest - scale)
    high = np.where(np.isfinite(high), high, rest + scale)
    share = rng.uniform(0.0, 1.0, (count, len(rest)))
    # h of a smooth plant is largest at the corners, and uniform points miss corners in many dimensions.
    edge = rng.uniform(0.0, 1.0, share.shape) < 0.8
    share[: count // 2] = np.where(edge, np.round(share), share)[: count // 2]
    points = low + share * (high - low)
    largest, missing = np.zeros(model.d), 0
    at = np.tile(rest, (model.d, 1))
    for point in points:
        x, u = point[: model.d], point[model.d :]
        try:
            after = step(x, u, model.period)
        except PlantError:
            missing += 1
            continue
        h = np.abs(after - plant.x_e - model.step(x - plant.x_e, u - plant.u_e)) / model.period
        more = h > largest
        largest[more], at[more] = h[more], point
    return SampledDisturbance(largest, at[:, : model.d], at[:, model.d :], count, missing)


@dataclass(frozen=True)
class Kept:
    """The result of following the safe input."""

    seconds: float
    """Seconds followed: until the end, or until the plant left X."""
    left: str
    """The state or row that left X first, or the reason why the motion ended; "" if the plant stayed in X."""


def under_safe_input(model: Model, step: Step, start: np.ndarray, seconds: float) -> Kept:
    """Follow the true motion from `start`, (d,), plant units, under the safe input and gain, updated every period.

    Feedback acts one dead time later, in whole periods. Until then the safe input acts without its gain.
    """
    plant, x = model.plant, np.array(start, dtype=float)
    coming = [plant.safe_input] * plant.dead_periods(model.period)
    steps = max(1, round(seconds / model.period))
    for k in range(steps + 1):
        outside = np.flatnonzero(plant.beyond_x(x) > 0.0)
        if outside.size:
            return Kept(k * model.period, plant.x_names[int(outside[0])])
        try:
            coming.append(plant.safe_input_at(x))
            x = step(x, coming.pop(0), model.period)
        except PlantError as error:
            return Kept(k * model.period, str(error))
    return Kept(steps * model.period, "")
