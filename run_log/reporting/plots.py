"""Pictures of a run. Curves differ by line style and marker as well as by colour (Okabe and Ito's)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from lbmpc.plants import Description
from run_log.reporting.canvas import words
from run_log.reporting.performance import TOLERANCE
from run_log.reporting.traces import Traces

BLACK, BLUE, SKY, VERMILION, GREEN = "#000000", "#0072B2", "#56B4E9", "#D55E00", "#009E73"
GREY = "#6F6F6F"
WIDTH = 8.0
# Model errors this much smaller than the largest are left out.
MATTERS = 0.02

Draw = Callable[[Axes], None]


def overview(data: Traces, title: str = "") -> Figure:
    """The whole run on one page: performance, inputs, learning, and cost."""
    performed = [partial(_state, data, i) for i in data.plant.performance]
    commanded = [partial(_input, data, j) for j in range(data.plant.m)]
    learned = [partial(_error, data), *([partial(_weights, data)] if _learns(data) else [])]
    return _figure(title, [*performed, *commanded, *learned, partial(_timing, data)], height=1.9)


def pictures(data: Traces) -> dict[str, Callable[[], Figure]]:
    """Functions of the separate pictures, by name; missing data (hidden weights, timings) have no picture."""
    plant = data.plant
    drawn: dict[str, Callable[[], Figure]] = {
        "states": partial(_figure, "States", [partial(_state, data, i) for i in range(plant.d)]),
        "input": partial(_figure, "Input", [partial(_input, data, j) for j in range(plant.m)], height=3.2),
        "error": partial(_figure, "Prediction error", [partial(_error, data)], height=3.2),
    }
    shown = _model_errors(data)
    if shown:
        title = "Model error over one period, measured and estimated"
        parts: list[Draw] = [partial(_model_error, data, i) for i in shown]
        if np.isfinite(data.weight).any():
            parts += [partial(_weight, data, i) for i in shown]
        drawn["model_error"] = partial(_figure, title, parts)
    if np.isfinite(data.tick_ms).any():
        drawn["timing"] = partial(_figure, "Time spent", [partial(_timing, data)], height=3.2)
    if _learns(data):
        parts = [partial(_weights, data), partial(_losses, data)]
        drawn["weights"] = partial(_figure, "Hidden weights", parts, height=2.4)
    return drawn


def _figure(title: str, draws: list[Draw], height: float = 2.0) -> Figure:
    figure = Figure(figsize=(WIDTH, 0.7 + height * len(draws)), layout="constrained", dpi=120)
    axes = figure.subplots(len(draws), 1, sharex=True, squeeze=False)[:, 0]
    for ax, draw in zip(axes, draws, strict=True):
        draw(ax)
        ax.grid(True, color="#DDDDDD", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
        if ax.get_legend_handles_labels()[1]:
            # Beside the axes, so that it covers no curve.
            ax.legend(loc="upper left", bbox_to_anchor=(1.005, 1.02), fontsize=8, frameon=False)
    axes[-1].set_xlabel("time since the first command (s)")
    figure.align_ylabels()
    if title:
        figure.suptitle(words(title), fontsize=11)
    return figure


def _label(plant: Description, name: str, what: str = "") -> str:
    unit = plant.units.get(name, "")
    return words(f"{what}{name} ({'–' if unit in ('', '1') else unit})")


def _bounded(ax: Axes, low: float, high: float, values: np.ndarray, aims: np.ndarray, scale: float) -> None:
    """Draw bounds, with the area beyond them shaded; a bound far from the curve would flatten it.

    aims: what else is to be seen; scale: the half-width.
    """
    values = values[np.isfinite(values)]
    if not values.size:
        return
    shown = np.append(values, aims[np.isfinite(aims)])
    bottom, top = float(shown.min()), float(shown.max())
    reach = 2 * max(top - bottom, 1e-9 * scale)
    drawn = [bound for bound in (low, high) if bottom - reach < bound < top + reach]
    bottom, top = min(bottom, *drawn, top), max(top, *drawn, bottom)
    margin = 0.06 * max(top - bottom, 1e-9 * scale)
    ax.set_ylim(bottom - margin, top + margin)
    for i, bound in enumerate(drawn):
        label = "bounds" if i == 0 else "_nolegend_"
        ax.axhline(bound, color=VERMILION, linestyle=(0, (6, 2)), linewidth=1.2, label=label)
        beyond = bottom - margin if bound == low else top + margin
        ax.axhspan(bound, beyond, color=VERMILION, alpha=0.08, linewidth=0)
    hidden = ", ".join(f"{bound:g}" for bound in (low, high) if bound not in drawn and np.isfinite(bound))
    if hidden:
        ax.plot([], [], " ", label=f"bounds beyond the\naxis: {hidden}")
    distance = float(min((values - low).min(), (high - values).min()))
    if not np.isfinite(distance):
        # No bounds on either side.
        return
    kept = distance >= -TOLERANCE * scale
    inside = f"inside by {max(distance, 0.0):.2g}" if kept else f"OUTSIDE by {-distance:.2g}"
    ax.plot([], [], " ", label=f"{inside}\nat samples")


def _mark_by_hand(data: Traces, ax: Axes) -> None:
    """Mark the intervals of manual control."""
    for i, (began, ended) in enumerate(data.motion.by_hand):
        label = "manual" if i == 0 else "_nolegend_"
        ax.axvspan(began, ended, color=GREEN, alpha=0.12, linewidth=0, label=label)


def _aim(data: Traces, ax: Axes, target: np.ndarray, rest: float) -> np.ndarray:
    """Draw and return the targets of the plan, or the equilibrium if there are none."""
    if not np.isfinite(target).any():
        ax.axhline(rest, color=GREY, linestyle=":", linewidth=1.2, label="equilibrium")
        return np.array([rest])
    aims = np.where(np.isfinite(target), target, rest)
    ax.step(data.t, aims, where="post", color=GREY, linestyle=":", linewidth=1.4, label="target of the plan")
    return aims


def _state(data: Traces, i: int, ax: Axes) -> None:
    plant, motion = data.plant, data.motion
    _mark_by_hand(data, ax)
    x = motion.x[:, i]
    # A restarted plant jumps, which is no motion.
    later = list(motion.starts[1:])
    t, unbroken = np.insert(motion.t, later, np.nan), np.insert(x, later, np.nan)
    ax.plot(t, unbroken, color=BLUE, linewidth=1.6, label="state")
    aims = _aim(data, ax, data.target_x[:, i], plant.x_e[i])
    if np.isfinite(data.reference[:, i]).any():
        r = data.reference[:, i]
        ax.step(data.t, r, where="post", color=GREEN, linestyle="--", linewidth=1.3, label="set-point")
        aims = np.append(aims, r)
    _bounded(ax, plant.x_min[i], plant.x_max[i], x, aims, plant.x_scale[i])
    ax.set_ylabel(_label(plant, plant.states[i]))


def _input(data: Traces, j: int, ax: Axes) -> None:
    plant, motion = data.plant, data.motion
    _mark_by_hand(data, ax)
    u, applied = data.u[:, j], motion.applied[:, j]
    ax.step(data.t, u, where="post", color=SKY, linewidth=3.0, label="commanded")
    # `applied` is reported at the end of the period over which it is the mean.
    ax.step(
        motion.t, applied, where="pre", color=BLACK, linestyle="--", linewidth=1.0, label="applied (mean)"
    )
    if data.fallback.any():
        ax.plot(data.t[data.fallback], u[data.fallback], "x", color=VERMILION, label="not from the solver")
    aims = _aim(data, ax, data.target_u[:, j], plant.u_e[j])
    values = np.concatenate([u, applied])
    _bounded(ax, plant.u_min[j], plant.u_max[j], values, aims, plant.u_scale[j])
    ax.set_ylabel(_label(plant, plant.inputs[j]))


def _model_errors(data: Traces) -> list[int]:
    """States whose measured model error is not negligible beside the largest, in units of its bounds."""
    if not np.isfinite(data.h).any():
        return []
    largest = np.nanmax(np.abs(data.h), axis=0) / data.plant.x_scale
    return [int(i) for i in np.flatnonzero(largest > MATTERS * largest.max())]


def _model_error(data: Traces, i: int, ax: Axes) -> None:
    plant = data.plant
    # The label of a step is known when the step has ended.
    ax.plot(data.t, data.h[:, i], color=BLACK, linewidth=1.6, label="measured h")
    ax.plot(data.t, data.h_hat[:, i], color=VERMILION, linestyle="--", linewidth=1.4, label="estimated ĥ")
    ax.set_ylabel(_label(plant, plant.states[i], "h of "))
    ax.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3), useMathText=True)


def _weight(data: Traces, i: int, ax: Axes) -> None:
    ax.step(data.t, data.weight[:, i], where="post", color=VERMILION, linestyle="--", label="of the network")
    ax.step(data.t, data.constant_weight[:, i], where="post", color=BLUE, label="of a constant")
    ax.set_ylim(-0.05, 1.05)
    ax.set_ylabel(f"weights in ĥ\nof {words(data.plant.states[i])}")


def _error(data: Traces, ax: Axes) -> None:
    error = _positive(data.error)
    ax.semilogy(data.t, error, color=BLUE, linewidth=1.2, label="|ĥ − h|")
    top = np.nanmax(error) * 1.5 if np.isfinite(error).any() else 1.0
    _mark_weights(data, ax, np.full(len(data.t), top), 5, "weights ")
    ax.set_ylabel("prediction error\n(units of x)")


def _timing(data: Traces, ax: Axes) -> None:
    ax.semilogy(data.t, _positive(data.tick_ms), color=BLACK, linewidth=1.0, label="whole tick")
    ax.semilogy(data.t, _positive(data.solve_ms), ".", color=BLUE, markersize=3, label="solver")
    ax.axhline(data.period * 1e3, color=VERMILION, linestyle=(0, (6, 2)), linewidth=1.2, label="period")
    if data.late.any():
        ax.plot(data.t[data.late], data.tick_ms[data.late], "v", color=VERMILION, zorder=5, label="late tick")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(lambda value, _position: f"{value:g}")
    ax.yaxis.set_minor_locator(NullLocator())
    ax.set_ylabel("time (ms)")


def _mark_weights(data: Traces, ax: Axes, heights: np.ndarray, size: int, what: str = "") -> None:
    """Mark the ticks with a verdict on hidden weights; `heights`: (n,) positions in the picture."""
    for mask, marker, colour, fate in (
        (data.adopted, "^", GREEN, "adopted"),
        (data.refused, "x", VERMILION, "refused"),
        (data.rolled_back, "v", VERMILION, "rolled back"),
    ):
        if mask.any():
            ax.plot(data.t[mask], heights[mask], marker, color=colour, markersize=size, label=what + fate)


def _learns(data: Traces) -> bool:
    return bool(len(data.losses) or data.adopted.any() or data.refused.any())


def _weights(data: Traces, ax: Axes) -> None:
    ax.step(data.t, data.version, where="post", color=BLUE, linewidth=1.4, label="in force")
    _mark_weights(data, ax, data.version, 6)
    ax.set_ylabel("hidden weights\n(version)")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))


def _losses(data: Traces, ax: Axes) -> None:
    t, before, after = data.losses.T if len(data.losses) else np.zeros((3, 0))
    ax.semilogy(t, _positive(before), "o-", color=BLACK, markersize=4, linewidth=0.8, label="before training")
    ax.semilogy(t, _positive(after), "s--", color=GREEN, markersize=4, linewidth=0.8, label="after training")
    ax.set_ylabel("loss")


def _positive(values: np.ndarray) -> np.ndarray:
    """A logarithmic axis has no zero."""
    return np.where(values > 0.0, values, np.nan)
