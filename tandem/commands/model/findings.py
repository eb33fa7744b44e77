"""Findings about a model before it is used: one sentence each, with its severity."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lbmpc.analysis import (
    SETTLED,
    SampledDisturbance,
    Step,
    advised_horizon,
    growth,
    poles,
    reach,
    under_safe_input,
)
from lbmpc.model import Model, ModelError, longest_horizon, require_horizon
from lbmpc.plants import Known
from lbmpc.plants.matrices import unmoved_modes
from tandem.model_tables import percent, poles_text

Verdict = Literal["ok", "note", "fault"]
FOLLOWED = 10.0
"""Seconds for which the safe input is simulated, or two horizons if that is longer."""
CHEAP = 1e-3
"""Share of the cost of the most expensive input at its half-width; a cheaper performance state has no effect."""
DOUBLED = 2.0
"""Largest growth of an error of a prediction over the dead time."""
BESIDE = 0.01
"""Half-widths from x_e, in every state: an unstable plant would stay exactly at x_e."""
WEAK = 0.1
"""Half-widths: the inputs have little effect on a state that full inputs move less within the horizon."""


@dataclass(frozen=True)
class Finding:
    """A "note" needs attention; with a "fault" nothing works."""

    verdict: Verdict
    subject: str
    text: str


def findings(model: Model, horizon: int, x0: np.ndarray, step: Step) -> Iterator[Finding]:
    """Findings about a model for which there is a controller.

    Args:
        model: at the rate.
        horizon: N of the configuration.
        x0: (d,), plant units.
        step: the true motion; where none is known, the model's own.
    """
    yield _stability(model)
    yield _inputs(model, horizon)
    yield _horizon(model, horizon)
    if model.plant.rows:
        yield _rows(model.plant)
    if model.plant.dead_time:
        yield _dead_time(model)
    yield Finding(
        "ok", "feedback K", f"poles of A + BK, 1/s: {poles_text(poles(model.closed_loop, model.period))}"
    )
    yield Finding("ok", "terminal cost", "P is the cost of all stages after the horizon")
    yield _start(model, x0)
    yield from _safe(model, horizon, x0, step)


def disturbance_finding(plant: Known, W: np.ndarray, found: SampledDisturbance) -> Finding:
    """W, (d,) per second, against the h that was found."""
    lost = (
        f"; from {found.lost} of {found.samples} states the motion cannot be computed" if found.lost else ""
    )
    above = [
        f"{plant.states[i]} by a factor of {_factor(found.largest[i], W[i])}"
        for i in np.flatnonzero(found.largest > W * (1 + 1e-9) + 1e-9 * plant.x_scale)
    ]
    if not above:
        verdict: Verdict = "note" if found.lost else "ok"
        return Finding(verdict, "W", f"contains h at all {found.samples} sampled points of X and U{lost}")
    return Finding(
        "note",
        "W",
        f"h exceeds W somewhere in X and U: {', '.join(above)}. Tightening guarantees "
        f"nothing where h is outside W; enlarge W or reduce the bounds{lost}",
    )


def weights_finding(model: Model) -> Finding | None:
    """The cost of a half-width of a performance state, if it is small against the inputs; else None."""
    plant = model.plant
    states = np.diag(model.Q) * plant.x_scale**2 / model.period
    inputs = np.diag(model.R) * plant.u_scale**2 / model.period
    most = int(np.argmax(inputs))
    cheap = [
        f"{plant.states[i]} {states[i]:.2g}" for i in plant.performance if states[i] < CHEAP * inputs[most]
    ]
    if not cheap:
        return None
    text = (
        f"cost of one half-width, per second: {', '.join(cheap)}; {plant.inputs[most]} {inputs[most]:.2g}. The input "
        "will hardly be used. controller.Q and R multiply squares in the plant's units"
    )
    return Finding("note", "weights", text)


def _factor(largest: float, given: float) -> str:
    # Two digits, and 130 rather than 1.3e+02.
    return f"{float(f'{largest / given:.2g}'):g}" if given > 0.0 else "infinity (W is 0)"


def _stability(model: Model) -> Finding:
    found = poles(model.A, model.period)
    text = f"poles, 1/s: {poles_text(found)}"
    if found[0].real > 1e-9 * abs(found).max():
        return Finding(
            "ok", "unstable", f"{text}; without input it grows e-fold in {1.0 / found[0].real:.3g} s"
        )
    if found[0].real >= -1e-9 * abs(found).max():
        return Finding("ok", "marginally stable", f"{text}; without input it does not return")
    return Finding("ok", "stable", f"{text}; without input it returns")


def _inputs(model: Model, horizon: int) -> Finding:
    plant = model.plant
    unmoved = [
        " and ".join(plant.states[i] for i in mode.states)
        for mode in unmoved_modes(plant.A, plant.B, plant.x_scale, plant.u_scale)
    ]
    if unmoved:
        text = f"no input moves {' or '.join(unmoved)}; it decays without input"
        return Finding("note", "controllability", text)
    weak = [
        f"{state} by {percent(moved)}"
        for state, moved in zip(plant.states, reach(model, horizon), strict=True)
        if moved < WEAK
    ]
    if weak:
        return Finding(
            "note",
            "controllability",
            f"full inputs move {', '.join(weak)} of a half-width only within the horizon; use a longer horizon",
        )
    return Finding("ok", "controllability", "the inputs move every state")


def _horizon(model: Model, horizon: int) -> Finding:
    seconds, advised = horizon * model.period, advised_horizon(model)
    try:
        require_horizon(model, horizon)
    except ModelError as error:
        return Finding("fault", "horizon", str(error))
    grown, most = growth(model, horizon), longest_horizon(model)
    text = f"{horizon} steps ({seconds:.3g} s)"
    if grown > 1.0 + 1e-6:
        limit = "" if most is None else f"; the limit is {most} steps"
        text += f", in which a prediction grows by {_power(grown)}{limit}"
    text += (
        f"; advised: {advised} steps ({advised * model.period:.3g} s), within which K brings all of X to "
        f"within {SETTLED:g} half-widths of x_e"
    )
    return Finding("note" if 3 * horizon < advised else "ok", "horizon", text)


def _dead_time(model: Model) -> Finding:
    seconds, periods = model.plant.dead_time, model.plant.dead_time / model.period
    grown = growth(model, math.ceil(periods))
    text = f"{seconds:.3g} s, {periods:.3g} periods: the state is predicted over the dead time"
    if grown > DOUBLED:
        text += f", and its error grows by a factor of {_power(grown)} meanwhile"
    return Finding("note" if grown > DOUBLED else "ok", "dead time", text)


def _power(factor: float) -> str:
    return f"{factor:.2g}" if factor < 1e3 else f"10^{math.log10(factor):.1f}"


def _rows(plant: Known) -> Finding:
    listed = [
        f"{name} = {value:.4g} at x_e, u_e; limits {low:g} to {high:g}"
        for rows, rest in ((plant.state_rows, plant.x_e), (plant.input_rows, plant.u_e))
        for name, value, low, high in zip(
            rows.names, (rows.F @ rest).tolist(), rows.lower.tolist(), rows.upper.tolist(), strict=True
        )
    ]
    return Finding("ok", "rows", "; ".join(listed))


def _start(model: Model, x0: np.ndarray) -> Finding:
    plant = model.plant
    outside = [
        f"{plant.states[i]} = {x0[i]:g}, X is [{plant.x_min[i]:g}, {plant.x_max[i]:g}]"
        for i in np.flatnonzero((x0 < plant.x_min) | (x0 > plant.x_max))
    ]
    rows = plant.state_rows
    outside += [
        f"{rows.names[i]} = {rows.F[i] @ x0:g}, the row is [{rows.lower[i]:g}, {rows.upper[i]:g}]"
        for i in np.flatnonzero(rows.beyond(x0) > 0.0)
    ]
    if outside:
        return Finding("note", "x0", f"outside X: {'; '.join(outside)}")
    return Finding("ok", "x0", "in X")


def _safe(model: Model, horizon: int, x0: np.ndarray, step: Step) -> Iterator[Finding]:
    seconds = max(FOLLOWED, 2.0 * horizon * model.period)
    law = "the safe input" if model.plant.safe_gain is None else "the safe input with its gain"
    for where, start in (("x0", x0), ("x_e", _beside_rest(model.plant))):
        kept = under_safe_input(model, step, start, seconds)
        if not kept.left:
            yield Finding("ok", f"safe from {where}", f"{law} keeps it in X for {seconds:.3g} s")
        elif kept.left in model.plant.states:
            text = f"under {law} {kept.left} leaves X after {kept.seconds:.3g} s"
            yield Finding("note", f"safe from {where}", text)
        else:
            yield Finding(
                "note", f"safe from {where}", f"under {law}, after {kept.seconds:.3g} s: {kept.left}"
            )


def _beside_rest(plant: Known) -> np.ndarray:
    """A state of X, (d,), a little beside x_e, on the side with more room."""
    side = np.where(plant.x_max - plant.x_e >= plant.x_e - plant.x_min, BESIDE, -BESIDE)
    return plant.state_rows.pulled(plant.x_e + side * plant.x_scale, plant.x_e)
