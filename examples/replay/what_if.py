"""Inputs that other settings would have commanded in the states of a log, tick by tick, beside the recorded ones.

python what_if.py tanks.mcap controller.oracle=linear "controller.R=[0.1]"
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import tyro
from matplotlib.figure import Figure

from controller_node.core import ControllerCore
from node_runtime.config.loading import override
from node_runtime.config.strict import apply_override
from run_log.named_plant import given_plant
from run_log.reading.reader import read_run
from run_log.run import Run, plant_of


def commanded(run: Run, change: str) -> np.ndarray:
    """(n, m) the input of each tick under `change`, "section.key=value"; the states stay as recorded."""
    config = override(run.config, [change])
    core = ControllerCore(config, "what-if", given=given_plant(run, config, {apply_override({}, change)}))
    return np.array([core.step(tick).command.u for tick in run.ticks])


def main(
    log: tyro.conf.Positional[Path], changes: tyro.conf.Positional[tuple[str, ...]], out: Path | None = None
) -> None:
    """Print how far each change moves the input, and plot it.

    Args:
        log: of one controller.
        changes: each section.key=value, one at a time.
        out: file of the picture; none is drawn without.
    """
    run = read_run(log)
    plant, t = plant_of(run), np.array([tick.t for tick in run.ticks])
    inputs = {"as recorded": np.array([command.u for command in run.commands])}
    for change in changes:
        inputs[change] = commanded(run, change)
        off = np.abs(inputs[change] - inputs["as recorded"]).max(axis=1)
        print(
            f"{change:32s} largest difference {off.max():8.4g}, mean {off.mean():8.4g}, at the end {off[-1]:8.4g}"
        )
    if out is not None:
        with matplotlib.rc_context(matplotlib.rcParamsDefault):
            picture(inputs, t, plant.inputs, [plant.units[name] for name in plant.inputs]).savefig(out)


def picture(inputs: dict[str, np.ndarray], t: np.ndarray, names: tuple[str, ...], units: list[str]) -> Figure:
    """One line for each change, one axis for each input."""
    figure = Figure(figsize=(8.0, 0.7 + 2.4 * len(names)), layout="constrained", dpi=120)
    axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for j, ax in enumerate(axes):
        for change, u in inputs.items():
            recorded = change == "as recorded"
            width, style = (3.0, "-") if recorded else (1.2, "-")
            colour = "#BBBBBB" if recorded else None
            ax.step(t - t[0], u[:, j], style, where="post", linewidth=width, color=colour, label=change)
        ax.set_ylabel(f"{names[j]} ({units[j]})")
        ax.grid(True, color="#DDDDDD", linewidth=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.005, 1.02), fontsize=8, frameon=False)
    axes[-1].set_xlabel("time (s)")
    return figure


if __name__ == "__main__":
    tyro.cli(main)
