"""The cost of each oracle on plants that are unstable within their horizon: `python -m verification.unstable_plants`.

Lock-step runs of dx/dt = a x + a u and of inverted pendulums, at N = 60 or the largest horizon that a start allows.
The pendulums start near their equilibrium, where h is nearly 0, and far from it. Requirements: no oracle costs more
than 1.02 times what linear MPC costs, and every solve converges.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from rich.console import Console

from lbmpc.model import LARGEST_GROWTH
from lbmpc.model import build_model as nominal_model
from lbmpc.plants import PLANTS, Plant
from node_runtime.config.loading import load
from run_log.reporting.summary import summarise
from tandem.experiments.simulation.lockstep import follow
from tests.helpers.plants.pendulum import inverted
from tests.helpers.plants.unstable import unstable

RATE, STEPS, LONGEST, ALLOWED = 20.0, 60, 60, 1.02
ORACLES = ("constant", "l2nw", "dnn", "perfect")


def plants() -> dict[str, Plant]:
    """Plants by their names in the table."""
    rates = {f"a = {a:g} /s": unstable(a) for a in (4.0, 6.0, 8.0, 10.0, 12.0, 15.0)}
    rods = {f"pendulum, {length:g} m": inverted(length) for length in (1.0, 0.3, 0.1)}
    far = {f"{name}, from 0.6 rad": replace(plant, x0=np.array([0.6, 0.0])) for name, plant in rods.items()}
    return rates | rods | far


def largest_horizon(plant: Plant) -> int:
    """Steps, `LONGEST` at most."""
    growth = float(np.abs(np.linalg.eigvals(nominal_model(plant, 1.0 / RATE).A)).max())
    return min(LONGEST, int(np.log(LARGEST_GROWTH) / np.log(growth)))


def cost(plant: Plant, oracle: str, horizon: int) -> tuple[float, bool]:
    """Return J of a run, and whether every solve converged."""
    PLANTS[plant.name] = plant
    settings = [f"plant.model={plant.name}", f"controller.oracle={oracle}", f"controller.horizon={horizon}"]
    outcome = follow(load(None, [*settings, f"rate={RATE}", "controller.solver.compile=never"]), STEPS)
    kept = outcome.lost is None and all(result.status == "converged" for result in outcome.run.results)
    return summarise(outcome.run).J, kept


def main() -> int:
    """Print the table; return 0 if all requirements are met."""
    console = Console(width=160, highlight=False)
    console.print(f"| plant | N | linear, J | {' | '.join(ORACLES)} |")
    console.print("| --- " * (3 + len(ORACLES)) + "|")
    met = True
    for name, plant in plants().items():
        horizon = largest_horizon(plant)
        linear, fine = cost(plant, "linear", horizon)
        cells = []
        for oracle in ORACLES:
            J, converged = cost(plant, oracle, horizon)
            cells.append(f"{J / linear:.4f}{'' if converged else ', not converged'}")
            fine = fine and converged and linear * ALLOWED >= J
        met = met and fine
        console.print(f"| {name} | {horizon} | {linear:.4g} | {' | '.join(cells)} |")
    return 0 if met else 1


if __name__ == "__main__":
    raise SystemExit(main())
