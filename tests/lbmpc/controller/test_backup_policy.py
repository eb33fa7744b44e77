"""The backup policy on the true plant, and compared with IPOPT."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from controller_node.core import ControllerCore
from lbmpc.controller.backup_policy import RAMP, STEPS, BackupPlanner, Policy
from lbmpc.model import Model, build_model
from lbmpc.oracles import DnnOracle, LinearOracle, Oracle, PerfectOracle
from lbmpc.plants import Truth
from lbmpc.problem import Problem, build_problem
from lbmpc.sets.constraint_sets import state_set
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.least_distance import Nearest, least_distance
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from run_log.replaying.replay import replay
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.ipopt_reference import ReferenceSolver
from tests.helpers.science import compressor, describe, oracle_named

N = 40
MODEL = compressor()
PLANT = MODEL.require_equations("these tests")
X0 = PLANT.x0 - PLANT.x_e
HALF = 0.5 * (PLANT.x_max - PLANT.x_min)


def problem(oracle: Oracle, model: Model = MODEL) -> Problem:
    return build_problem(model, oracle, N)


def theta_of(oracle: Oracle, seed: int = 1) -> np.ndarray:
    """Return the oracle's initial parameters; for the perfect oracle, the plant's parameters."""
    return oracle.theta(oracle.initial_state(np.random.default_rng(seed)))


def outside(x: np.ndarray) -> float:
    """Return how far x, a deviation, lies outside X, as a share of the half-widths; negative inside."""
    return float(np.max(np.abs(x + PLANT.x_e - 0.5 * (PLANT.x_min + PLANT.x_max)) / HALF)) - 1.0


def distance(x: np.ndarray) -> float:
    """Return the norm of x in the terminal cost."""
    return float(np.sqrt(x @ MODEL.P @ x))


def followed(x: np.ndarray, policy: Policy, truth: Truth) -> list[np.ndarray]:
    """Return the true plant's deviations under the policy."""
    states = []
    for inputs in policy.inputs:
        u = np.clip(inputs + policy.gain @ x + PLANT.u_e, PLANT.u_min, PLANT.u_max)
        x = truth.step(x + PLANT.x_e, u, MODEL.period) - PLANT.x_e
        states.append(x)
    return states


def test_the_policy_keeps_the_true_plant_in_x_while_the_nominal_plan_leaves() -> None:
    """With a known h the constraints of the backup problem are the true plant's; those of the nominal plan are not."""
    oracle, truth = PerfectOracle(MODEL), Truth(PLANT)
    theta = theta_of(oracle)
    nominal = Solver(problem(oracle)).solve(X0, theta, np.zeros((N, 1)))
    blind = followed(X0, Policy(nominal.u, np.zeros((1, 4)), np.zeros((N, 4)), 0.0), truth)
    assert max(map(outside, blind)) > 0.02
    policy = BackupPlanner(problem(oracle), 0.0).policy(X0, theta, nominal.u)
    assert policy is not None
    states = followed(X0, policy, truth)
    assert max(map(outside, states)) < 1e-4
    # The true states equal the expected ones, so the feedback adds nothing.
    assert np.array(states[:-1]) == pytest.approx(policy.states[1:], abs=2e-4)


def test_the_full_margin_is_kept_after_the_ramp() -> None:
    oracle = PerfectOracle(MODEL)
    x = np.array([-0.1, -0.4, 0.0, 0.0])
    policy = BackupPlanner(problem(oracle), 0.05).policy(x, theta_of(oracle), np.zeros((N, 1)))
    assert policy is not None
    assert max(map(outside, policy.states[RAMP + 4 :])) < -0.05 + 1e-4


@pytest.mark.parametrize(
    ("flow", "margin", "least", "most"),
    [
        (0.15, 0.02, 0.02, 0.02),  # leads back with the full margin
        (0.15, 0.06, 0.01, 0.02),  # with the full margin the flow falls to a third
        (0.145, 0.02, 0.001, 0.003),
        (0.135, 0.06, 0.0, 0.0),  # does not lead back, but is cheaper without margin
        (0.13, 0.06, 0.0, 0.0),  # ends no nearer without margin, but stays at the edge of X
    ],
)
def test_the_largest_margin_that_leads_back_is_kept(
    flow: float, margin: float, least: float, most: float
) -> None:
    """From the paper's x0 and below, the flow recovers only while the pressure is near its bound."""
    oracle = PerfectOracle(MODEL)
    x = np.array([flow - PLANT.x_e[0], *X0[1:]])
    policy = BackupPlanner(problem(oracle), margin).policy(x, theta_of(oracle), np.zeros((N, 1)))
    assert policy is not None
    assert least <= policy.margin <= most
    states = followed(x, policy, Truth(PLANT))
    if policy.margin > 0.0:
        assert max(map(outside, states)) < 1e-3 - policy.margin
        assert distance(states[-1]) < 0.95 * distance(x)
    else:
        # With the full margin the plant leaves X by a tenth of the half-width or more.
        assert max(map(outside, states)) < 0.01


@pytest.mark.parametrize("x", [np.zeros(4), np.full(4, 1e-4), np.array([-0.1, -0.4, 0.0, 0.0])])
@pytest.mark.parametrize("oracle", [PerfectOracle(MODEL), oracle_named("dnn", MODEL)])
def test_a_margin_without_cost_is_kept(
    x: np.ndarray, oracle: Oracle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No second problem is solved then, and none at rest, even if the learned model predicts a motion away from it."""
    solved = []

    def counted(*arguments: Any) -> Nearest | None:
        solved.append(arguments)
        return least_distance(*arguments)

    monkeypatch.setattr("lbmpc.solver.constraint_rows.least_distance", counted)
    policy = BackupPlanner(problem(oracle), 0.05).policy(x, theta_of(oracle), np.zeros((N, 1)))
    assert policy is not None
    assert policy.margin == 0.05
    assert len(solved) == STEPS


def test_a_margin_is_kept_if_dropping_it_gains_nothing() -> None:
    """With an almost immovable valve no plan leads back, and no plan without margin costs less."""
    stuck = replace(PLANT, u_min=PLANT.u_e - 1e-6, u_max=PLANT.u_e + 1e-6)
    model = build_model(stuck, MODEL.period)
    oracle = PerfectOracle(model)
    policy = BackupPlanner(problem(oracle, model), 0.05).policy(X0, theta_of(oracle), np.zeros((N, 1)))
    assert policy is not None
    assert distance(policy.states[-1]) > distance(X0)
    assert policy.margin == 0.05


def test_without_learning_the_policy_matches_ipopt() -> None:
    """For h_hat = 0 the learned states are the nominal ones, and IPOPT solves the same problem."""
    oracle = LinearOracle(MODEL.d, MODEL.m)
    plain = state_set(MODEL)
    inside = 0.02 * HALF
    shares = [min(1.0, (i + 1) / RAMP) for i in range(N)]
    states = tuple(plain.minus(share * inside, share * inside) for share in shares)
    judge = ReferenceSolver(replace(problem(oracle), states=states))
    planner = BackupPlanner(problem(oracle), 0.02)
    rng = np.random.default_rng(3)
    for _ in range(5):
        x = X0 * rng.uniform(0.5, 1.2, 4)
        policy = planner.policy(x, np.zeros(0), np.zeros((N, 1)))
        assert policy is not None
        v = policy.inputs + policy.states @ policy.gain.T
        assert v == pytest.approx(judge.solve(x, np.zeros(0), np.zeros((N, 1))).v, abs=1e-5)


@pytest.mark.parametrize("architecture", ["mlp", "rnn"])
def test_the_rows_constrain_the_learned_states(architecture: str) -> None:
    """This includes an oracle with a window, for which the recursion's state is longer than x."""
    oracle = DnnOracle(
        describe(MODEL, [8], architecture=architecture, window=1 if architecture == "mlp" else 3)
    )
    rng = np.random.default_rng(5)
    state = oracle.begin(oracle.initial_state(rng), X0, np.zeros(1))
    for _ in range(30):
        state = oracle.learn(
            state, X0 * rng.uniform(0.8, 1.0, 4), np.zeros(1), np.array([0.001, 0.004, 0, 0])
        )
    s = np.concatenate([X0, oracle.past(state).ravel()]) if oracle.pairs > 1 else X0
    theta = oracle.theta(state)
    nominal = Solver(problem(oracle)).solve(s, theta, np.zeros((N, 1)))
    policy = BackupPlanner(problem(oracle), 0.01).policy(s, theta, nominal.u)
    assert policy is not None
    assert max(map(outside, policy.states[RAMP + 4 :])) < -0.01 + 1e-3


def test_nonfinite_numbers_give_no_policy() -> None:
    oracle = oracle_named("dnn", MODEL)
    planner = BackupPlanner(problem(oracle), 0.01)
    theta = theta_of(oracle)
    assert planner.policy(X0, theta, np.zeros((N, 1))) is not None
    assert planner.policy(X0 * np.nan, theta, np.zeros((N, 1))) is None
    assert planner.policy(X0, np.full_like(theta, np.inf), np.zeros((N, 1))) is None
    # The next call is not affected.
    first = planner.policy(X0, theta, np.zeros((N, 1)))
    again = BackupPlanner(problem(oracle), 0.01).policy(X0, theta, np.zeros((N, 1)))
    assert first is not None
    assert again is not None
    assert first.inputs.tobytes() == again.inputs.tobytes()


CONFIG = override(
    Config(),
    [
        "controller.horizon=15",
        "controller.solver.compile='never'",
        "network.hidden=[6]",
        "trainer.enabled=false",
    ],
)


def test_backups_are_replayed_and_do_not_change_commands() -> None:
    run = simulate(CONFIG, 12)
    core = ControllerCore(CONFIG, run.controllers[0])
    backups = []
    for tick, command in zip(run.ticks, run.entries(topics.COMMAND), strict=True):
        outputs = core.step(tick)
        assert codec.encode(outputs.command) == command.payload
        backups.append(core.backup(outputs.command))
    assert all(backup is not None for backup in backups)
    entries = list(run.entries(topics.COMMAND))
    run.streams[topics.BACKUP.name] = [
        replace(entry, message=backup, payload=codec.encode(backup))
        for entry, backup in zip(entries, backups, strict=True)
        if backup is not None
    ]
    assert replay(run).equal
    last = run.streams[topics.BACKUP.name][7]
    assert isinstance(last.message, m.Backup)
    changed = msgspec.structs.replace(last.message, inputs=[[9.0], *last.message.inputs[1:]])
    run.streams[topics.BACKUP.name][7] = replace(last, message=changed, payload=codec.encode(changed))
    found = replay(run).first_difference
    assert found is not None
    assert (found.tick, found.field) == (7, "backup.inputs[0][0]")


def test_the_policy_in_plant_units_is_equivalent() -> None:
    run = simulate(CONFIG, 3)
    core = ControllerCore(CONFIG, run.controllers[0])
    for tick in run.ticks:
        outputs = core.step(tick)
    backup = core.backup(outputs.command)
    assert backup is not None
    codec.check_dimensions(topics.BACKUP, backup, 4, 1)
    expected = core.memory.state.predicted + PLANT.x_e
    u = np.array(backup.inputs[0]) + np.array(backup.gain) @ expected
    planner = BackupPlanner(core.controller.problem, CONFIG.controller.backup.margin)
    policy = core.controller.backup(planner, core.memory.state)
    assert policy is not None
    v = policy.inputs[0] + policy.gain @ policy.states[0]
    assert u == pytest.approx(v + PLANT.u_e, abs=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        {"gain": [[1.0] * 3]},
        {"gain": []},
        {"gain": [[1.0] * 4] * 2},
        {"inputs": []},
        {"inputs": [[1.0, 2.0]]},
        {"period": 0.0},
    ],
)
def test_a_backup_of_another_plant_is_refused(wrong: dict[str, object]) -> None:
    good = m.Backup(run_id="c", seq=0, period=0.05, gain=[[0.0] * 4], inputs=[[1.0]])
    codec.check_dimensions(topics.BACKUP, good, 4, 1)
    with pytest.raises(codec.BadMessage, match="wrong size"):
        codec.check_dimensions(topics.BACKUP, msgspec.structs.replace(good, **wrong), 4, 1)
