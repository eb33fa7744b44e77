"""Certified sets as a picture: projections, slices, and W with the tube, in the plant's own units.

Sets differ by line style, marker and lightness as well as by colour (Okabe and Ito's).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator

from lbmpc.model import Model
from lbmpc.sets.certificate import Certificate
from lbmpc.sets.geometry.operations import Body, body, convex_hull
from lbmpc.sets.geometry.polytope import SetError
from run_log.reporting.canvas import words
from run_log.reporting.plots import BLACK, BLUE, GREY, SKY, VERMILION

PLANES = 3
"""Largest number of pairs of states."""
TUBE = (1, 2, 4, 8)
"""Which R_i are drawn."""
FILL, ANGLES = "#DCE6EE", 72
Plane = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Drawn:
    """Content of a picture; x0, and the states of a run (n, d), in the plant's own units."""

    certificate: Certificate
    model: Model
    x0: np.ndarray
    run: np.ndarray | None


def picture(drawn: Drawn, title: str) -> Figure:
    """Rows: projections, slices through x_e, slices through x0, W and R_i; columns: pairs of states."""
    plant = drawn.model.plant
    half = plant.x_scale
    pieces = [body(np.array(p.G), np.array(p.g), p.name, half) for p in drawn.certificate.pieces]
    planes = _planes(drawn)
    sliced = plant.d > 2
    rows = 4 if sliced else 2
    figure = Figure(figsize=(4.3 * len(planes), 3.6 * rows + 0.9), layout="constrained")
    axes = figure.subplots(rows, len(planes), squeeze=False)
    for column, plane in enumerate(planes):
        _projections(axes[0, column], drawn, pieces, plane)
        if sliced:
            _slices(axes[1, column], drawn, pieces, plane, plant.x_e, "$x_e$")
            _slices(axes[2, column], drawn, pieces, plane, drawn.x0, "$x_0$")
        _disturbances(axes[-1, column], drawn, plane)
    figure.suptitle(words(title), fontsize=11)
    legend: dict[str, Artist] = {}
    for ax in axes[:, 0]:
        legend |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(
        list(legend.values()), list(legend), loc="outside lower center", ncols=4, fontsize=9, frameon=False
    )
    return figure


def _planes(drawn: Drawn) -> list[Plane]:
    """The performance states first, then pairs with states not yet shown, then any."""
    plant = drawn.model.plant
    first = tuple(dict.fromkeys([*plant.performance, *range(plant.d)]))
    if plant.d == 1:
        raise SetError("sets of one state are intervals: there is nothing to draw")
    pairs = [(first[i], first[i + 1]) for i in range(0, plant.d - 1, 2)]
    pairs += [p for p in combinations(first, 2) if p not in pairs]
    return pairs[:PLANES]


def _projections(ax: Axes, drawn: Drawn, pieces: list[Body], plane: Plane) -> None:
    for piece, style in _styled(pieces):
        _polygon(ax, drawn, piece.vertices[:, list(plane)], plane, style)
    if drawn.run is not None:
        x = drawn.run[:, list(plane)]
        ax.plot(*x.T, color=VERMILION, linewidth=1.3, marker=".", markersize=3, label="the run", zorder=5)
    _frame(ax, drawn, plane, "projection")
    W = np.array(drawn.certificate.pieces[0].W)[:, list(plane)]
    _polygon(
        ax,
        drawn,
        W,
        plane,
        {"fill": True, "facecolor": BLACK, "zorder": 7, "label": "W about $x_e$, to scale"},
    )


def _slices(ax: Axes, drawn: Drawn, pieces: list[Body], plane: Plane, through: np.ndarray, name: str) -> None:
    """Sections of the sets with the plane through a state; a projection covers some values of the other states."""
    point, kept = through - drawn.model.plant.x_e, list(plane)
    rest = [i for i in range(len(point)) if i not in plane]
    scale = drawn.model.plant.x_scale[kept]
    for piece, style in _styled(pieces):
        try:
            cut = body(piece.G[:, kept], piece.g - piece.G[:, rest] @ point[rest], "a slice", scale)
            corners = cut.vertices
        except SetError:
            continue  # the plane misses this piece, or only touches it
        _polygon(ax, drawn, corners, plane, style)
    _frame(ax, drawn, plane, f"slice through {name}")


def _disturbances(ax: Axes, drawn: Drawn, plane: Plane) -> None:
    """R_i = W + A_K W + ... + A_K^(i-1) W, the sets that a tube excludes, by their outermost points."""
    W = np.array(drawn.certificate.pieces[0].W)
    angles = np.linspace(0.0, 2 * np.pi, ANGLES, endpoint=False)
    directions = np.zeros((ANGLES, drawn.model.d))
    size = np.ptp(W, axis=0)[list(plane)]
    directions[:, list(plane)] = np.column_stack([np.cos(angles), np.sin(angles)]) / np.maximum(size, 1e-12)
    power, reached = np.eye(drawn.model.d), np.zeros((ANGLES, drawn.model.d))
    styles = iter([(0, ()), (0, (6, 2)), (0, (3, 2)), (0, (1, 1.5))])
    for i in range(1, max(TUBE) + 1):
        moved = W @ power.T
        reached = reached + moved[np.argmax(directions @ moved.T, axis=1)]
        power = power @ drawn.model.closed_loop
        if i in TUBE:
            corners = np.vstack([reached, reached[:1]])[:, list(plane)]
            ax.plot(
                *corners.T,
                color=BLUE,
                linestyle=next(styles),
                linewidth=1.3,
                label=f"$R_{{{i}}}$" + (" = W" if i == 1 else ""),
            )
    ax.set_title("W and the tube, about 0", fontsize=9)
    _axes(ax, drawn, plane, "deviation of ")


def _styled(pieces: list[Body]) -> list[tuple[Body, dict[str, object]]]:
    """The pieces around the path below, the base set above them."""
    base = {"fill": True, "facecolor": FILL, "edgecolor": BLUE, "linewidth": 1.6, "label": "base set C"}
    others = [
        (
            piece,
            {
                "fill": False,
                "edgecolor": SKY,
                "linewidth": 0.9,
                "label": "sets around the way" if i == 0 else "_nolegend_",
                "zorder": 3,
            },
        )
        for i, piece in enumerate(pieces[1:])
    ]
    return [(pieces[0], base), *others]


def _polygon(ax: Axes, drawn: Drawn, points: np.ndarray, plane: Plane, style: dict[str, object]) -> None:
    """The hull of points (k, 2), deviations; a point or a line if they span no more."""
    at = points + drawn.model.plant.x_e[list(plane)]
    size = np.ptp(points, axis=0)
    if size.min() <= 1e-12 * max(size.max(), 1e-300):
        ax.plot(*at.T, color=str(style.get("edgecolor", BLACK)), linewidth=1.0)
        return
    order = convex_hull((points - points.mean(axis=0)) / size).vertices
    fill = {"closed": True, **style}
    ax.add_patch(Polygon(at[order], **fill))  # type: ignore[arg-type]


def _frame(ax: Axes, drawn: Drawn, plane: Plane, title: str) -> None:
    plant = drawn.model.plant
    low, high = plant.x_min[list(plane)], plant.x_max[list(plane)]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    ax.plot(*corners.T, color=GREY, linestyle=(0, (6, 2)), linewidth=1.4, label="X")
    ax.plot(*plant.x_e[list(plane)], "+", color=BLACK, markersize=10, label="equilibrium $x_e$", zorder=6)
    ax.plot(
        *drawn.x0[list(plane)],
        "*",
        color=VERMILION,
        markeredgecolor=BLACK,
        markersize=8,
        label="$x_0$",
        zorder=6,
        linestyle="none",
    )
    margin = 0.06 * (high - low)
    ax.set_xlim(low[0] - margin[0], high[0] + margin[0])
    ax.set_ylim(low[1] - margin[1], high[1] + margin[1])
    ax.set_title(title, fontsize=9)
    _axes(ax, drawn, plane)


def _axes(ax: Axes, drawn: Drawn, plane: Plane, what: str = "") -> None:
    plant = drawn.model.plant
    labels = []
    for i in plane:
        unit = plant.units.get(plant.states[i], "")
        labels.append(words(f"{what}{plant.states[i]} ({'–' if unit in ('', '1') else unit})"))
    ax.set_xlabel(labels[0])
    ax.set_ylabel(labels[1])
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.yaxis.set_major_locator(MaxNLocator(6))
    ax.spines[["top", "right"]].set_visible(False)
