"""Style of the pictures: cases differ in line, marker and lightness as well as in colour (Okabe and Ito)."""

from __future__ import annotations

import base64
import io
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lbmpc.plants import Description
from node_runtime.printable import printable
from run_log.reporting.plots import BLACK, BLUE, GREEN, GREY, SKY, VERMILION
from tandem.experiments.study.results import CaseResult

WIDTH = 4.4
"""Inches. A phone shows this width almost without scaling, so that labels keep their size."""
DOTS = 150
"""Per inch."""
FONT: Any = {"font.size": 9, "axes.titlesize": 9.5, "svg.hashsalt": "tandem", "svg.fonttype": "path"}


Look = dict[str, Any]
"""Colour, line and marker, as `Axes.plot` takes them."""
LOOKS: dict[str, Look] = {
    "linear": {"color": GREY, "linestyle": (0, (5, 1.5)), "marker": "s"},
    "constant": {"color": SKY, "linestyle": (0, (3, 1)), "marker": "d"},
    "l2nw": {"color": VERMILION, "linestyle": (0, (5, 1.5, 1, 1.5)), "marker": "^"},
    "dnn": {"color": BLUE, "linestyle": "-", "marker": "o"},
    "perfect": {"color": BLACK, "linestyle": (0, (1, 1.2)), "marker": "D"},
}
MORE: tuple[Look, ...] = (
    {"color": "#E69F00", "linestyle": (0, (3, 1, 1, 1, 1, 1)), "marker": "v"},
    {"color": GREEN, "linestyle": (0, (8, 2)), "marker": "P"},
    {"color": "#CC79A7", "linestyle": (0, (2, 2)), "marker": "X"},
    {"color": "#882255", "linestyle": "-", "marker": "*"},
)


def looks(results: list[CaseResult]) -> list[Look]:
    """Return a look for each case. The first case of an oracle has the look of that oracle."""
    taken: set[str] = set()
    spare = iter(MORE * (1 + len(results) // len(MORE)))
    given = []
    for result in results:
        given.append(LOOKS[result.oracle] if result.oracle not in taken else next(spare))
        taken.add(result.oracle)
    return given


def figure(height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure of `rows` by `columns` axes, each `height` inches high, and the axes row by row."""
    with rc_context(FONT):
        made = Figure(figsize=(WIDTH, 0.5 + height * rows), layout="constrained")
        axes = made.subplots(rows, columns, squeeze=False, sharex=True, sharey=columns > 1)
    for ax in axes.ravel():
        ax.grid(True, color="#DDDDDD", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    return made, list(axes.ravel())


def legend_above(ax: Axes, height: float = 1.0, columns: int = 2, space: float = 0.2) -> None:
    """Put the legend above the axes, where it hides no data."""
    place: Any = {"loc": "lower left", "bbox_to_anchor": (0, height), "borderaxespad": space}
    ax.legend(**place, ncols=columns, frameon=False, fontsize=8.5)


def full_name(plant: Description, index: int) -> str:
    """Return the long name of a state; its short name if the plant has none."""
    return printable(plant.names.get(plant.states[index], plant.states[index]))


def named(plant: Description, index: int) -> str:
    """Return the label of a state's axis: its full name and its unit."""
    unit = plant.units.get(plant.states[index], "")
    return f"{full_name(plant, index)} ({'dimensionless' if unit in ('', '1') else printable(unit)})"


def png(made: Figure) -> bytes:
    """Return the figure as PNG."""
    buffer = io.BytesIO()
    with rc_context(FONT):
        made.savefig(buffer, format="png", dpi=DOTS, metadata={"Software": None})
    return buffer.getvalue()


def data_uri(made: Figure) -> str:
    """Return the figure as SVG in a data URI. The same figure gives the same text."""
    buffer = io.BytesIO()
    with rc_context(FONT):
        made.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
