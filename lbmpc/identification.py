"""Identification of A, B and W from measured motion by least squares:

    x+ = A x + B u + c,        x and u as deviations from a given point, c the offset at that point.

Each row is fitted separately, in half-widths per second. The samples are cut into blocks of time, and each block is
left out of one fit. The residuals in that block show the quality on unseen samples. The scatter of the fits gives the
jackknife's standard error (Efron and Tibshirani, An Introduction to the Bootstrap, section 11). The error of a linear
model is not noise, however. It persists from sample to sample, recurs where the plant repeats its motion, and is
attributed to variables that moved at the same time. More samples do not reduce it. The persistent part of a residual,
found by its autocovariance at one sample, is therefore counted once and in full in every direction, relative to the
motion of the samples in that direction.

u may be a feedback of x. A and B can then be separated only as far as u differs from a fixed linear feedback; otherwise
the samples are rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

BLOCKS = 10
"""Blocks of time. Each fit uses nine tenths of the samples."""
SAMPLES_EACH = 10
"""Minimum number of samples per coefficient of a row."""
EXCITED = 1e-3
"""Minimum RMS motion in every direction of (x, u), in half-widths."""
ABOVE_NOISE = 5.0
"""Minimum ratio of motion to measurement noise. Below it the effect is underestimated by 1 / 25 or more."""
KNOWN = 0.1
"""Half-widths. Largest standard error of one step that starts a half-width away."""
MARGIN = 1.25
"""Ratio of W to the largest held-out residual. The next of n samples exceeds the largest with probability 1 / n."""
ROUNDING = 1e-9
"""Half-widths. Smaller motion counts as rounding."""
SHOWN = 0.05
"""A term below this share of the largest coefficient is left out of a message."""


class NotIdentifiable(ValueError):
    """The samples do not determine A and B. The text lists every reason and says what to record instead."""


@dataclass(frozen=True, eq=False)
class Variables:
    """Names of d states and m inputs, their half-widths, and the point of reference for deviations."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    x_scale: np.ndarray
    u_scale: np.ndarray
    x_e: np.ndarray
    u_e: np.ndarray

    @cached_property
    def names(self) -> tuple[str, ...]:
        return (*self.states, *self.inputs)

    @cached_property
    def scale(self) -> np.ndarray:
        """Half-widths of (x, u), (d + m,)."""
        return np.concatenate([self.x_scale, self.u_scale])


@dataclass(frozen=True, eq=False)
class Transitions:
    """n pairs of samples one period apart, in order of time, in the plant's units."""

    x: np.ndarray
    """(n, d)."""
    u: np.ndarray
    """(n, m): the input held from this sample to the next."""
    after: np.ndarray
    """(n, d): the next sample."""

    def __len__(self) -> int:
        return len(self.x)

    def then(self, later: Transitions) -> Transitions:
        """Return these transitions followed by those of another stretch of time."""
        joined = (
            np.vstack(pair) for pair in zip(*(vars(part).values() for part in (self, later)), strict=True)
        )
        return Transitions(*joined)


@dataclass(frozen=True, eq=False)
class Quality:
    """Residuals of one-step predictions in half-widths per second, (d,) each."""

    rms: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, residuals: np.ndarray, x_scale: np.ndarray, period: float) -> Quality:
        """Compute the quality of residuals (n, d), the errors of one step in the plant's units."""
        rates = residuals / x_scale / period
        return cls(np.sqrt((rates**2).mean(axis=0)), np.abs(rates).max(axis=0))


@dataclass(frozen=True, eq=False)
class Identified:
    """x+ = A x + B u + offset + h with |h| <= W T, in deviations and the plant's units.

    `*_error` are standard errors. They include the error of the linear model that may be mistaken for an effect.
    """

    period: float
    A: np.ndarray
    B: np.ndarray
    offset: np.ndarray
    """(d,): h at the point of reference."""
    A_error: np.ndarray
    B_error: np.ndarray
    offset_error: np.ndarray
    W: np.ndarray
    """(d,) per second: `MARGIN` times the largest held-out residual, rounded up to two digits."""
    held_out: Quality
    nothing_changes: Quality
    """Quality of the prediction x+ = x, for comparison."""
    excitation: np.ndarray
    """(d + m,): RMS motion in the principal directions of (x, u), in half-widths, in descending order."""
    samples: int


def identify(samples: Transitions, period: float, variables: Variables) -> Identified:
    """Fit the least-squares model.

    Args:
        samples: the transitions of all stretches of time, in order.
        period: T in seconds.
        variables: names for the messages, scales, and the point of reference of the model.

    Raises:
        NotIdentifiable: there are too few samples, or a state, input or combination does not move enough.
    """
    d, scale = len(variables.states), variables.scale
    least = SAMPLES_EACH * (len(scale) + 1)
    if len(samples) < least:
        raise NotIdentifiable(
            f"{len(samples)} samples are too few: each row of the model has {len(scale) + 1} numbers "
            f"({', '.join(variables.names)} and an offset) and needs at least {least} samples"
        )
    z = np.hstack([samples.x - variables.x_e, samples.u - variables.u_e]) / scale
    y = (samples.after - samples.x) / variables.x_scale / period
    middle = z.mean(axis=0)
    rms, directions = _principal(z - middle)
    # The offset is best known at the centre of the samples, where it is independent of the slopes.
    regressors = np.column_stack([z - middle, np.ones(len(z))])
    fit = _Blockwise(regressors, y)
    residual = y - regressors @ fit.whole
    noise = np.sqrt((directions[:, :d] ** 2) @ (period**2 * (residual**2).mean(axis=0)))
    _require_motion(variables, z, rms, directions, noise)
    persistent = _persistent(residual)

    def error(of: Callable[[np.ndarray], np.ndarray], moved: np.ndarray) -> np.ndarray:
        """Return the standard error of a function of the coefficients, (n, d); moved (n,): its factor on a residual."""
        return period * np.hypot(fit.error(of), np.outer(moved, persistent))

    _require_known(variables, rms, directions, error(lambda theta: directions @ theta[:-1], 1.0 / rms))

    def at_origin(theta: np.ndarray) -> np.ndarray:
        return theta[-1:] - middle @ theta[:-1]

    units = variables.x_scale[:, None] / scale
    slopes = period * fit.whole[:-1].T * units
    spread = np.sqrt((directions**2 / rms[:, None] ** 2).sum(axis=0))
    errors = error(lambda theta: theta[:-1], spread).T * units
    far = np.sqrt(1.0 + (((directions @ middle) / rms) ** 2).sum(keepdims=True))
    offset_error = error(at_origin, far)[0] * variables.x_scale
    missed = fit.held_out * variables.x_scale * period
    found = Quality.of(missed, variables.x_scale, period)
    return Identified(
        period=period,
        A=np.eye(d) + slopes[:, :d],
        B=slopes[:, d:],
        offset=period * variables.x_scale * at_origin(fit.whole)[0],
        A_error=errors[:, :d],
        B_error=errors[:, d:],
        offset_error=offset_error,
        W=_rounded_up(MARGIN * found.largest * variables.x_scale),
        held_out=found,
        nothing_changes=Quality.of(samples.after - samples.x, variables.x_scale, period),
        excitation=rms,
        samples=len(samples),
    )


class _Blockwise:
    """Least squares of y (n, d) on z (n, p), with all samples and with each block left out.

    Each block is reduced to the triangular factor of (z, y), which makes all fits exact and small.
    """

    def __init__(self, z: np.ndarray, y: np.ndarray):
        blocks = np.array_split(np.arange(len(z)), BLOCKS)
        factors = [_triangular(np.hstack([z[block], y[block]])) for block in blocks]
        p = z.shape[1]
        self.whole = _solved(factors, p)
        self._without = [_solved(factors[:k] + factors[k + 1 :], p) for k in range(BLOCKS)]
        missed = [y[block] - z[block] @ theta for block, theta in zip(blocks, self._without, strict=True)]
        self.held_out = np.vstack(missed)

    def error(self, of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the jackknife's standard error of the function `of` of the coefficients (p, d)."""
        each = np.array([of(theta) for theta in self._without])
        return np.sqrt((BLOCKS - 1) / BLOCKS * ((each - each.mean(axis=0)) ** 2).sum(axis=0))


def _triangular(matrix: np.ndarray) -> np.ndarray:
    """Return R of the QR factorisation."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def _solved(factors: Sequence[np.ndarray], p: int) -> np.ndarray:
    """Return the coefficients, (p, d); zero in directions without motion."""
    stacked = np.vstack(factors)
    return np.linalg.lstsq(stacked[:, :p], stacked[:, p:], rcond=None)[0]


def _persistent(residual: np.ndarray) -> np.ndarray:
    """Return the RMS of the part of residuals (n, d) that persists over one sample, (d,); 0 for white noise."""
    n, power = len(residual), (residual**2).mean(axis=0)
    later = (residual[1:] * residual[:-1]).sum(axis=0) / n
    # Subtract two standard deviations of the estimate for white noise.
    return np.sqrt(np.maximum(later - 2.0 / np.sqrt(n) * power, 0.0))


def _principal(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the RMS motion in the principal directions, (p,), descending, and the directions as rows, (p, p)."""
    _left, singular, directions = np.linalg.svd(_triangular(z))
    return singular / np.sqrt(len(z)), directions


def _require_motion(
    variables: Variables, z: np.ndarray, rms: np.ndarray, directions: np.ndarray, noise: np.ndarray
) -> None:
    """Raise `NotIdentifiable` if a variable or combination moves too little, or little more than its noise."""
    own = np.sqrt(((z - z.mean(axis=0)) ** 2).mean(axis=0))
    still = own < EXCITED
    found = [
        f"{name} hardly moves: by {_percent(moved)} of its half-width (RMS)"
        for name, moved in zip(variables.names, own, strict=True)
        if moved < EXCITED
    ]
    for moved, direction, level in zip(rms, directions, noise, strict=True):
        if still @ direction**2 > 0.5:
            continue
        if moved < EXCITED:
            found.append(_relation(variables, z, direction))
        elif moved < ABOVE_NOISE * level:
            found.append(
                f"{_combination(variables, direction)} moves by {_percent(moved)} of a half-width (RMS), and "
                f"{_percent(level)} is not explained by any model, like measurement noise: the effect of such a small "
                "motion is underestimated"
            )
    _refuse(found)


def _require_known(variables: Variables, rms: np.ndarray, directions: np.ndarray, errors: np.ndarray) -> None:
    """Raise `NotIdentifiable` if blocks disagree; `errors` (d + m, d) are the errors of one step, half-widths."""
    found = []
    for moved, direction, error in zip(rms, directions, errors, strict=True):
        worst = int(error.argmax())
        if error[worst] > KNOWN:
            found.append(
                f"the effect of {_combination(variables, direction)} on {variables.states[worst]} is known only to "
                f"±{error[worst]:.2g} half-widths a step, from a half-width away ({KNOWN:g} at most): it moves by "
                f"{_percent(moved)} (RMS), which is small compared with the error of a linear model"
            )
    _refuse(found)


def _refuse(found: list[str]) -> None:
    if found:
        remedy = (
            "Record motion that differs: from several x0, with other weights (controller.Q and R: another feedback), "
            "or with a signal added to the input. Several logs can be given together"
        )
        listed = "".join(f"\n  - {one}" for one in found)
        raise NotIdentifiable(f"the samples do not determine A and B:{listed}\n{remedy}")


def _relation(variables: Variables, z: np.ndarray, direction: np.ndarray) -> str:
    """Return the constant relation of the samples as an equation for one variable, an input if it contains one."""
    d = len(variables.states)
    inputs = np.abs(direction[d:])
    fed_back = inputs.max() > SHOWN
    one = d + int(inputs.argmax()) if fed_back else int(np.abs(direction[:d]).argmax())
    shares = -direction / direction[one]
    shares[one] = 0.0
    within = np.sqrt((((z - z.mean(axis=0)) @ direction) ** 2).mean()) / abs(direction[one])
    slopes = shares * variables.scale[one] / variables.scale
    terms = [
        f"{slope:+.3g} {name}"
        for slope, share, name in zip(slopes, shares, variables.names, strict=True)
        if abs(share) > SHOWN * np.abs(shares).max()
    ]
    right = " ".join([*terms, "+ constant"])
    equation = f"{variables.names[one]} = {right}, to {_percent(within)} of its half-width"
    if fed_back:
        return (
            f"{equation}: the input is a linear function of the other variables, as under one fixed feedback, so the "
            "effects of the plant's own motion and of the input cannot be separated"
        )
    return f"{equation}: they move only together, so their effects cannot be separated"


def _combination(variables: Variables, direction: np.ndarray) -> str:
    """Return a direction in half-widths as text, such as "z - 0.4 u"."""
    largest = int(np.abs(direction).argmax())
    shares = direction / direction[largest]
    terms = [
        (variables.names[i] if share == 1.0 else f"{share:+.2g} {variables.names[i]}")
        for i, share in sorted(enumerate(shares.tolist()), key=lambda pair: -abs(pair[1]))
        if abs(share) > SHOWN
    ]
    return terms[0] if len(terms) == 1 else f"the combination {' '.join(terms)} (in half-widths)"


def _percent(share: float) -> str:
    """Format with two digits; rounding errors become 0."""
    return f"{100.0 * share:.2g} %" if share > ROUNDING else "0 %"


def _rounded_up(values: np.ndarray) -> np.ndarray:
    """Round up to two digits; zeros stay."""
    digit = 10.0 ** (np.floor(np.log10(np.maximum(values, 1e-300))) - 1.0)
    return np.where(values > 0.0, np.ceil(values / digit) * digit, 0.0)
