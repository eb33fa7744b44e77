"""The states that every candidate is given: one closed loop from the paper's x0, recorded once, and what each oracle
would have learned along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller_node.build import Realise, build_controller, build_model, build_oracle
from lbmpc.controller.step import Observation
from lbmpc.model import Model
from lbmpc.plants import Truth
from lbmpc.problem import Problem, build_problem
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Solution, Status
from node_runtime.config.literals import OracleName
from node_runtime.config.loading import load
from node_runtime.config.sections import Config

SEED = 0
LAYERS = 2
RECORDED_HORIZON, RECORDED_WIDTH = 60, 32
TIGHT, TIGHT_ITERATIONS = 1e-11, 200


@dataclass(frozen=True, eq=False)
class Recording:
    """A closed loop in deviation coordinates: x_t (d,), the input u_t (m,) after it, and the resulting h_t (d,)."""

    model: Model
    x: list[np.ndarray]
    u: list[np.ndarray]
    h: list[np.ndarray]


@dataclass(frozen=True, eq=False)
class Case:
    """One problem with the data and the expected result of each tick."""

    oracle: OracleName
    horizon: int
    width: int | None
    """Neurons of each hidden layer; None for an oracle without a network."""
    problem: Problem
    x: list[np.ndarray]
    theta: list[np.ndarray]
    """The oracle's parameters at each tick, after it learned the sample before."""
    predicted: list[np.ndarray]
    """x_t as the learned model predicted it one tick earlier; the first entry is x_0 itself."""
    warm: list[np.ndarray]
    """Inputs to start from, (N, m): the optimum of the previous tick, shifted by one."""
    tight: list[Solution]
    """The optimum."""

    @property
    def unsure(self) -> int:
        """Ticks whose optimum was not found to the tight tolerance."""
        return sum(solution.status is not Status.CONVERGED for solution in self.tight)


def configure(oracle: OracleName, horizon: int, width: int | None) -> Config:
    """Return the shipped configuration with this oracle, horizon and network."""
    hidden = [width or RECORDED_WIDTH] * LAYERS
    return load(
        None,
        [
            f"seed={SEED}",
            f"controller.oracle={oracle}",
            f"controller.horizon={horizon}",
            f"network.hidden={hidden}",
        ],
    )


def record(ticks: int, realise: Realise | None = None) -> Recording:
    """Run the controller with an adapting network for so many ticks from the plant's x0."""
    config = configure("dnn", RECORDED_HORIZON, RECORDED_WIDTH)
    model = build_model(config)
    controller, _ = build_controller(config, model, realise)
    plant, truth = model.plant, Truth(model.require_equations("a recording"))
    state, x, applied = controller.initial_state(SEED), plant.x0 - plant.x_e, None
    made = Recording(model, [], [], [])
    for tick in range(ticks):
        state, result = controller.step(state, Observation(x, applied, 0, tick, None))
        applied = result.plan[0]
        after = truth.step(x + plant.x_e, applied + plant.u_e, model.period) - plant.x_e
        made.x.append(x)
        made.u.append(applied)
        made.h.append(model.label(x, applied, after, ()))
        x = after
    return made


def build_case(
    recording: Recording,
    oracle: OracleName,
    horizon: int,
    width: int | None,
    realise: Realise,
) -> Case:
    """Let an oracle learn along the recording, and solve every tick tightly."""
    config = configure(oracle, horizon, width)
    settings = config.controller
    model, learner = recording.model, build_oracle(config, recording.model)
    problem = build_problem(model, learner, horizon, settings.tightening, penalty=settings.solver.penalty)
    solver = Solver(problem, TIGHT_ITERATIONS, TIGHT, realise)
    case = Case(oracle, horizon, width, problem, recording.x, [], [], [], [])
    memory, predicted = learner.initial_state(np.random.default_rng(SEED)), recording.x[0]
    warm = np.zeros((horizon, model.m))
    for x, u, h in zip(recording.x, recording.u, recording.h, strict=True):
        theta = learner.theta(memory)
        solution = solver.solve(x, theta, warm)
        case.theta.append(theta)
        case.predicted.append(predicted)
        case.warm.append(warm)
        case.tight.append(solution)
        predicted = model.A @ x + model.B @ u + learner.estimate(memory, x, u)
        memory = learner.learn(memory, x, u, h)
        warm = shifted(solution)
    return case


def shifted(solution: Solution) -> np.ndarray:
    """Return c of a plan one tick later, (N, m), with the feedback after its end."""
    return np.vstack([solution.c[1:], np.zeros_like(solution.c[:1])])
