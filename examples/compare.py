"""Cost of each oracle on an example: lock-step runs, a line each, and one picture of all.

python examples/compare.py examples/tanks/tanks.toml --steps 120
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import tyro
from matplotlib.figure import Figure

from lbmpc.plants import Description
from tandem import Loop, Result

ORACLES: dict[str, dict[str, Any]] = {
    "linear": {"oracle": "linear"},
    "constant 0.2": {"oracle": "constant", "constant": {"gain": 0.2}},
    "constant 0.5": {"oracle": "constant", "constant": {"gain": 0.5}},
    "constant 1": {"oracle": "constant", "constant": {"gain": 1.0}},
    "dnn": {"oracle": "dnn"},
    "perfect": {"oracle": "perfect"},
}
"""Settings of each run; the number is the gain of the filter (`constant.gain`)."""
LOOKS = {
    "linear": {"color": "#6F6F6F", "linestyle": "-"},
    "constant": {"color": "#56B4E9", "linestyle": "-"},
    "dnn": {"color": "#D55E00", "linestyle": "-"},
    "perfect": {"color": "#000000", "linestyle": ":"},
}


@dataclass(frozen=True)
class Row:
    """One oracle."""

    oracle: str
    J: list[float]
    """Closed-loop cost of each episode."""
    rest: np.ndarray
    """(d,) x - x_e at the end."""
    violations: int
    """Samples outside X or U, in all episodes."""
    result: Result


def compare(
    config: Path, steps: int, oracles: tuple[str, ...], episodes: int = 1, seed: int = 0, **settings: Any
) -> list[Row]:
    """Run each oracle with otherwise equal settings; `settings` as `Loop` takes them."""
    rows = []
    for oracle in oracles:
        loop = Loop(config=config, seed=seed, **{**settings, **ORACLES[oracle]})
        result = loop.run(steps)
        for _ in range(episodes - 1):
            loop.start_again()
            result = loop.run(steps)
        summary = result.summary
        costs = [episode.J for episode in summary.episodes]
        rest = result.x[-1] - loop.plant.x_e
        rows.append(Row(oracle, costs, rest, summary.constraint_violations, result))
    return rows


def picture(rows: list[Row], plant: Description) -> Figure:
    """Plot the performance states and the inputs of the last episode; of several constants, the best."""
    constants = [row for row in rows if row.oracle.startswith("constant")]
    worse = sorted(constants, key=lambda row: row.J[-1])[1:]
    shown = [row for row in rows if row not in worse]
    figure = Figure(
        figsize=(8.0, 0.7 + 1.9 * (len(plant.performance) + plant.m)), layout="constrained", dpi=120
    )
    axes = figure.subplots(len(plant.performance) + plant.m, 1, sharex=True, squeeze=False)[:, 0]
    states, inputs = np.split(axes, [len(plant.performance)])
    for row in shown:
        start = row.result.traces.motion.starts[-1]
        x, t = row.result.x[start:], row.result.traces.motion.t[start:]
        u = row.result.u[-(len(x) - 1) :]
        look = LOOKS[row.oracle.split()[0]]
        for ax, i in zip(states, plant.performance, strict=True):
            ax.plot(t - t[0], x[:, i], label=f"{row.oracle}: J = {row.J[-1]:.4g}", linewidth=1.5, **look)
        for j, ax in enumerate(inputs):
            ax.step(t[:-1] - t[0], u[:, j], where="post", linewidth=1.2, **look)
    names = [*(plant.states[i] for i in plant.performance), *plant.inputs]
    rest = [*plant.x_e[list(plant.performance)], *plant.u_e]
    for ax, name, at in zip(axes, names, rest, strict=True):
        ax.axhline(at, color="#000000", linestyle=(0, (2, 3)), linewidth=0.8, label="x_e, u_e")
        ax.set_ylabel(f"{name} ({plant.units[name]})")
        ax.grid(True, color="#DDDDDD", linewidth=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.005, 1.02), fontsize=8, frameon=False)
    axes[-1].set_xlabel("time (s)")
    figure.align_ylabels()
    return figure


def main(
    config: tyro.conf.Positional[Path],
    steps: int = 200,
    oracles: tuple[str, ...] = ("linear", "constant 0.2", "constant 0.5", "constant 1", "dnn"),
    episodes: int = 1,
    seed: int = 0,
    out: Path | None = None,
) -> None:
    """Compare oracles.

    Args:
        config: the configuration of the plant.
        steps: ticks of each episode.
        oracles: names of `ORACLES`.
        episodes: how often the plant starts again; what was learned is kept.
        seed: of everything random.
        out: file of the picture; none is drawn without.
    """
    rows = compare(config, steps, oracles, episodes, seed)
    plant = rows[0].result.traces.plant
    first = plant.performance[0]
    print(f"{'oracle':14s}{'J of each episode':20s}{plant.states[first]} at the end, off by    outside")
    for row in rows:
        costs = " ".join(f"{J:.4g}" for J in row.J)
        print(f"{row.oracle:14s}{costs:20s}{row.rest[first]:<+20.3g}{row.violations:d}")
    if out is not None:
        with matplotlib.rc_context(matplotlib.rcParamsDefault):
            picture(rows, plant).savefig(out)


if __name__ == "__main__":
    tyro.cli(main)
