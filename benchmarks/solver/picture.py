"""Time over the horizon and over the width of the network."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from benchmarks.solver.measure import CENTRE, WIDTH, Report
from run_log.reporting.plots import BLACK, BLUE, GREEN, GREY, SKY, VERMILION

# (solver, mode, oracle, compiled), label, colour, marker, line
Curve = tuple[tuple[str, str, str, bool], str, str, str, str]
CURVES: tuple[Curve, ...] = (
    (("ipopt-hard", "converged", "dnn", False), "network, IPOPT", BLACK, "s", "-"),
    (("ipopt-hard", "converged", "linear", False), "linear, IPOPT", GREY, "s", ":"),
    (("sqpmethod-daqp", "converged", "dnn", False), "network, sqpmethod with DAQP", GREY, "v", "-"),
    (("tandem", "converged", "dnn", False), "network, converged, no compiler", SKY, "o", "--"),
    (("tandem", "converged", "l2nw", True), "L2NW, converged", GREEN, "D", "-"),
    (("tandem", "converged", "dnn", True), "network, converged", BLUE, "o", "-"),
    (("tandem", "preparation", "dnn", True), "network, preparation", VERMILION, "^", "--"),
    (("tandem", "converged", "linear", True), "linear, converged", BLACK, "x", ":"),
    (("tandem", "feedback", "dnn", True), "network, feedback", VERMILION, "^", "-"),
)


def draw(report: Report, path: Path) -> None:
    """Draw two panels, both axes logarithmic, into a PNG at `path`."""
    figure = Figure(figsize=(10.0, 5.2), layout="constrained", dpi=120)
    left, right = figure.subplots(1, 2, sharey=True)
    for key, label, colour, marker, line in CURVES:
        solver, mode, oracle, compiled = key
        width = WIDTH if oracle == "dnn" else None
        rows = [
            row
            for row in report.rows
            if (row.solver, row.mode, row.oracle, row.compiled) == (solver, mode, oracle, compiled)
        ]
        style = {"color": colour, "marker": marker, "linestyle": line, "markersize": 5, "linewidth": 1.4}
        _curve(left, [(row.N, row.median_ms) for row in rows if row.width == width], label, style)
        if oracle == "dnn" and solver == "tandem":
            points = [(row.width, row.median_ms) for row in rows if row.N == CENTRE and row.width is not None]
            _curve(right, points, label, style)
    _finish(left, "horizon N", f"hidden layers of {WIDTH} neurons", {row.N for row in report.rows})
    _finish(
        right,
        "neurons in each of the two hidden layers",
        f"N = {CENTRE}",
        {row.width or WIDTH for row in report.rows},
    )
    left.set_ylabel("median time of one solve (ms)")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.savefig(path)


def _curve(ax: Axes, points: list[tuple[int, float]], label: str, style: dict[str, object]) -> None:
    if points:
        xs, ys = zip(*sorted(points), strict=True)
        ax.plot(xs, ys, label=label, **style)  # type: ignore[arg-type]


def _finish(ax: Axes, name: str, title: str, ticks: set[int]) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.xaxis.set_major_locator(FixedLocator(sorted(ticks)))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.set_xlabel(name)
    ax.set_title(title, fontsize=10)
    ax.grid(True, color="#DDDDDD", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
