"""A, B and W from measured motion, by least squares:

    x+ = A x + B u + c,        x and u as deviations from a given point, c what is left there.

Each row is fitted on its own, in half-widths per second. The samples are cut into blocks of time. What is said of the
quality comes from fits without one block each: their residuals in that block are those of samples that the fit has not
seen, and their scatter is the jackknife's standard error (Efron and Tibshirani, An Introduction to the Bootstrap,
section 11). What a linear model leaves of a plant is no noise, though. It persists from sample to sample, comes back
wherever the plant goes the same way, and is taken for an effect of whatever moved along with it: more samples do not
mend that. So the part of a residual that persists, by its autocovariance at one sample, counts once and whole in every
direction, beside how far the samples moved there.

u may be fed back from x. Then A and B are separable only as far as u does more than a fixed linear feedback; where it
does not, the samples are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

BLOCKS = 10
"""Blocks of time: each fit has nine tenths of the samples."""
SAMPLES_EACH = 10
"""Samples at least for each number of a row."""
EXCITED = 1e-3
"""RMS motion at least, of a half-width, in every direction of (x, u)."""
ABOVE_NOISE = 5.0
"""What moves less than so many times its measuring noise has its effect underrated by 1 / 25 and more."""
KNOWN = 0.1
"""Half-widths to which one step from a half-width away must be known, as a standard error."""
MARGIN = 1.25
"""Of W over the largest held-out residual: of n samples the next one exceeds the largest with a chance of 1 / n."""
ROUNDING = 1e-9
"""Half-widths."""
SHOWN = 0.05
"""Share of the largest coefficient below which a sentence leaves a term out."""


class NotIdentifiable(ValueError):
    """These samples do not say what A and B are; the text names every reason and what to record instead."""


@dataclass(frozen=True, eq=False)
class Variables:
    """The names of d states and m inputs, their half-widths, and the point that deviations count from."""

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
        """Of (x, u), (d + m,)."""
        return np.concatenate([self.x_scale, self.u_scale])


@dataclass(frozen=True, eq=False)
class Transitions:
    """n pairs of samples that are one period apart, in the order of time, in the plant's units."""

    x: np.ndarray
    """(n, d)."""
    u: np.ndarray
    """(n, m): held from this sample to the next."""
    after: np.ndarray
    """(n, d): the next sample."""

    def __len__(self) -> int:
        return len(self.x)

    def then(self, later: Transitions) -> Transitions:
        """These and those of another stretch of time."""
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
        """residuals (n, d): what one step missed by, in the plant's units."""
        rates = residuals / x_scale / period
        return cls(np.sqrt((rates**2).mean(axis=0)), np.abs(rates).max(axis=0))


@dataclass(frozen=True, eq=False)
class Identified:
    """x+ = A x + B u + offset + h with |h| <= W T, in deviations and the plant's units.

    `*_error`: standard errors, with what the linear model leaves out and may have been taken for an effect.
    """

    period: float
    A: np.ndarray
    B: np.ndarray
    offset: np.ndarray
    """(d,): h at the point that deviations count from."""
    A_error: np.ndarray
    B_error: np.ndarray
    offset_error: np.ndarray
    W: np.ndarray
    """(d,) per second: `MARGIN` times the largest held-out residual, rounded up to two digits."""
    held_out: Quality
    nothing_changes: Quality
    """Of the prediction x+ = x, for comparison."""
    excitation: np.ndarray
    """(d + m,): RMS motion in the principal directions of (x, u), in half-widths, the least last."""
    samples: int


def identify(samples: Transitions, period: float, variables: Variables) -> Identified:
    """The least-squares model of these samples.

    Args:
        samples: of all stretches of time, in their order.
        period: T in seconds.
        variables: names for the messages, scales, and the point about which the model is written.

    Raises:
        NotIdentifiable: too few samples, or they do not move enough in some state, input or combination.
    """
    d, scale = len(variables.states), variables.scale
    least = SAMPLES_EACH * (len(scale) + 1)
    if len(samples) < least:
        raise NotIdentifiable(
            f"{len(samples)} samples are too few: each row of the model has {len(scale) + 1} numbers "
            f"({', '.join(variables.names)} and an offset), and {least} samples are the least for them"
        )
    z = np.hstack([samples.x - variables.x_e, samples.u - variables.u_e]) / scale
    y = (samples.after - samples.x) / variables.x_scale / period
    middle = z.mean(axis=0)
    rms, directions = _principal(z - middle)
    # About the middle of the samples: the offset there is known best, and shares no digits with the slopes.
    regressors = np.column_stack([z - middle, np.ones(len(z))])
    fit = _Blockwise(regressors, y)
    residual = y - regressors @ fit.whole
    noise = np.sqrt((directions[:, :d] ** 2) @ (period**2 * (residual**2).mean(axis=0)))
    _require_motion(variables, z, rms, directions, noise)
    persistent = _persistent(residual)

    def error(of: Callable[[np.ndarray], np.ndarray], moved: np.ndarray) -> np.ndarray:
        """Of a function of the coefficients, (n, d); moved (n,): what a share of 1 in the samples is in it."""
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
    """Least squares of y (n, d) on z (n, p), of all samples and without one block each.

    Each block is reduced to the triangular factor of (z, y), with which all these fits are exact and small.
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
        """The jackknife's standard error of what `of` makes of the coefficients (p, d)."""
        each = np.array([of(theta) for theta in self._without])
        return np.sqrt((BLOCKS - 1) / BLOCKS * ((each - each.mean(axis=0)) ** 2).sum(axis=0))


def _triangular(matrix: np.ndarray) -> np.ndarray:
    """R of its QR factorisation."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def _solved(factors: Sequence[np.ndarray], p: int) -> np.ndarray:
    """(p, d). Of directions that did not move, nothing."""
    stacked = np.vstack(factors)
    return np.linalg.lstsq(stacked[:, :p], stacked[:, p:], rcond=None)[0]


def _persistent(residual: np.ndarray) -> np.ndarray:
    """RMS of the part of residuals (n, d) that is still there a sample later, (d,); of white noise 0."""
    n, power = len(residual), (residual**2).mean(axis=0)
    later = (residual[1:] * residual[:-1]).sum(axis=0) / n
    # Two standard deviations of what it is for white noise.
    return np.sqrt(np.maximum(later - 2.0 / np.sqrt(n) * power, 0.0))


def _principal(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """RMS motion in the principal directions, (p,), the least last, and the directions, one a row, (p, p)."""
    _left, singular, directions = np.linalg.svd(_triangular(z))
    return singular / np.sqrt(len(z)), directions


def _require_motion(
    variables: Variables, z: np.ndarray, rms: np.ndarray, directions: np.ndarray, noise: np.ndarray
) -> None:
    """Raises `NotIdentifiable` where a variable or a combination does not move, or no more than its noise."""
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
                f"{_percent(level)} is what no model explains, as measuring noise is: what moves so little beside it "
                "seems to have less effect than it has"
            )
    _refuse(found)


def _require_known(variables: Variables, rms: np.ndarray, directions: np.ndarray, errors: np.ndarray) -> None:
    """Raises `NotIdentifiable` where blocks of samples disagree; `errors` (d + m, d): of one step, half-widths."""
    found = []
    for moved, direction, error in zip(rms, directions, errors, strict=True):
        worst = int(error.argmax())
        if error[worst] > KNOWN:
            found.append(
                f"what {_combination(variables, direction)} does to {variables.states[worst]} is known to "
                f"±{error[worst]:.2g} half-widths a step only, from a half-width away ({KNOWN:g} at most): it moves by "
                f"{_percent(moved)} (RMS), too little beside what a linear model leaves out"
            )
    _refuse(found)


def _refuse(found: list[str]) -> None:
    if found:
        remedy = (
            "Record motion that differs: from several x0, with other weights (controller.Q and R: another feedback), "
            "or with a signal added to the input. Logs may be given together"
        )
        listed = "".join(f"\n  - {one}" for one in found)
        raise NotIdentifiable(f"the samples do not say what A and B are:{listed}\n{remedy}")


def _relation(variables: Variables, z: np.ndarray, direction: np.ndarray) -> str:
    """What is always zero along the samples, as an equation for one variable; an input where there is one."""
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
            f"{equation}: the input is a linear function of what else is seen, as under one fixed feedback, so that "
            "what the plant does by itself and what the input does cannot be told apart"
        )
    return f"{equation}: they move together only, so that their effects cannot be told apart"


def _combination(variables: Variables, direction: np.ndarray) -> str:
    """A direction in half-widths, as "z - 0.4 u"."""
    largest = int(np.abs(direction).argmax())
    shares = direction / direction[largest]
    terms = [
        (variables.names[i] if share == 1.0 else f"{share:+.2g} {variables.names[i]}")
        for i, share in sorted(enumerate(shares.tolist()), key=lambda pair: -abs(pair[1]))
        if abs(share) > SHOWN
    ]
    return terms[0] if len(terms) == 1 else f"the combination {' '.join(terms)} (in half-widths)"


def _percent(share: float) -> str:
    """With two digits; rounding is 0."""
    return f"{100.0 * share:.2g} %" if share > ROUNDING else "0 %"


def _rounded_up(values: np.ndarray) -> np.ndarray:
    """To two digits, upwards; zeros stay."""
    digit = 10.0 ** (np.floor(np.log10(np.maximum(values, 1e-300))) - 1.0)
    return np.where(values > 0.0, np.ceil(values / digit) * digit, 0.0)
