"""Learning-based model predictive control: pure functions and small classes, no clock and no I/O.

One solve for the jet-engine compressor, starting at its x0:

    import numpy as np
    from lbmpc import LinearOracle, Solver, build_model, build_problem, get_plant

    plant = get_plant("moore_greitzer")
    model = build_model(plant, period=0.05)
    oracle = LinearOracle(model.d, model.m)
    solver = Solver(build_problem(model, oracle, horizon=60))
    theta = oracle.theta(oracle.initial_state(np.random.default_rng(0)))
    solution = solver.solve(plant.x0 - plant.x_e, theta, np.zeros((60, model.m)))
    u = plant.u_e + solution.v[0]

The public names are those in `__all__`; each is imported on first use. `tandem.Loop` is a closed loop that learns.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lbmpc.controller.signals import Observation, StepResult
    from lbmpc.controller.state import ControllerState
    from lbmpc.controller.step import Controller
    from lbmpc.model import Model, ModelError, build_model
    from lbmpc.oracles import (
        ConstantOracle,
        DnnOracle,
        L2nwOracle,
        LinearOracle,
        Oracle,
        PerfectOracle,
    )
    from lbmpc.plants import (
        Known,
        Plant,
        PlantDefinitionError,
        PlantError,
        TrueMotion,
        Truth,
        get_plant,
    )
    from lbmpc.problem import Problem, build_problem
    from lbmpc.solver.gauss_newton import Solver
    from lbmpc.solver.solution import Solution, Status

_MODULES = {
    "lbmpc.plants": (
        "Known",
        "Plant",
        "PlantDefinitionError",
        "PlantError",
        "TrueMotion",
        "Truth",
        "get_plant",
    ),
    "lbmpc.model": ("Model", "ModelError", "build_model"),
    "lbmpc.oracles": ("ConstantOracle", "DnnOracle", "L2nwOracle", "LinearOracle", "Oracle", "PerfectOracle"),
    "lbmpc.problem": ("Problem", "build_problem"),
    "lbmpc.solver.gauss_newton": ("Solver",),
    "lbmpc.solver.solution": ("Solution", "Status"),
    "lbmpc.controller.signals": ("Observation", "StepResult"),
    "lbmpc.controller.state": ("ControllerState",),
    "lbmpc.controller.step": ("Controller",),
}

__all__ = [
    "ConstantOracle",
    "Controller",
    "ControllerState",
    "DnnOracle",
    "Known",
    "L2nwOracle",
    "LinearOracle",
    "Model",
    "ModelError",
    "Observation",
    "Oracle",
    "PerfectOracle",
    "Plant",
    "PlantDefinitionError",
    "PlantError",
    "Problem",
    "Solution",
    "Solver",
    "Status",
    "StepResult",
    "TrueMotion",
    "Truth",
    "build_model",
    "build_problem",
    "get_plant",
]


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
