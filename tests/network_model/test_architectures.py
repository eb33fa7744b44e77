"""Recurrent and convolutional hidden layers in the solver, in the configuration, in a whole run."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
import torch

from lbmpc.controller.signals import Observation
from lbmpc.controller.step import Controller
from lbmpc.oracles import DnnOracle, HiddenSet, Verdict
from lbmpc.oracles.base import follow
from lbmpc.plants import Truth
from lbmpc.problem import build_problem
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Status
from network_model.description import NetworkDescription, hash_layers
from node_runtime.config.loading import load, override
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from protocol import topics
from run_log.replaying.replay import replay
from run_log.reporting.summary import summarise
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.ipopt_reference import ReferenceSolver
from tests.helpers.science import compressor, describe
from trainer_node.network import AutogradLoss, DenseLoss, Network, build_loss

MODEL = compressor()
D, M = MODEL.d, MODEL.m
X0 = MODEL.plant.x0 - MODEL.plant.x_e
LOOKING_BACK = [("rnn", 5), ("rnn", 2), ("cnn", 5), ("mlp", 3)]
QUICK = [
    "controller.horizon=15",
    "network.hidden=[8, 8]",
    "trainer.steps=20",
    "controller.solver.compile=never",
]


def oracle_of(name: str, window: int | None = None, hidden: list[int] | None = None) -> DnnOracle:
    return DnnOracle(describe(MODEL, hidden or [8, 8], architecture=name, window=window))


def somewhere(oracle: DnnOracle, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A state with a past, s (D,), and the parameters after some labels on the way to it."""
    state = oracle.begin(oracle.initial_state(rng), np.zeros(D), np.zeros(M))
    for _ in range(20):
        x = rng.uniform(-1, 1, D) * [0.4, 0.4, 0.5, 5.0]
        state = oracle.learn(state, x, rng.uniform(-0.5, 0.5, M), rng.normal(size=D) * 0.006)
    x = rng.choice([-1, 1], D) * rng.uniform([0.05, 0.05, 0.1, 1.0], [0.45, 0.45, 0.6, 8.0])
    return np.concatenate([x, oracle.past(state).ravel()]), oracle.theta(state)


# -- the solver ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "window"), LOOKING_BACK)
def test_optimum_matches_ipopt(name: str, window: int) -> None:
    rng = np.random.default_rng(7)
    oracle = oracle_of(name, window)
    problem = build_problem(MODEL, oracle, 12, "first_step")
    solver, reference = Solver(problem, max_iterations=60, tolerance=1e-9), ReferenceSolver(problem)
    active = 0
    for _ in range(4):
        s, theta = somewhere(oracle, rng)
        ours = solver.solve(s, theta, rng.uniform(-1, 1, (12, M)))
        theirs = reference.solve(s, theta, ours.c)
        assert ours.status is (Status.INFEASIBLE if ours.slack else Status.CONVERGED)
        assert theirs.status is Status.CONVERGED
        np.testing.assert_allclose(ours.v[0], theirs.v[0], atol=1e-6)
        active += bool(ours.slack) or bool(np.isin(ours.v, [MODEL.plant.u_min, MODEL.plant.u_max]).any())
    # The model of the cost is exact, so steps near the optimum shrink at Gauss-Newton's rate.
    again = solver.solve(s, theta, ours.c)
    assert again.iterations <= 3


@pytest.mark.parametrize("name", ["rnn", "cnn"])
def test_a_prepared_step_corrects_for_a_different_past(name: str) -> None:
    """A prepared step corrects for a different past to first order."""
    rng = np.random.default_rng(3)
    oracle = oracle_of(name)
    solver = Solver(build_problem(MODEL, oracle, 12), tolerance=1e-10, max_iterations=60)
    s, theta = somewhere(oracle, rng)
    s[:D] *= 0.3
    plan = solver.solve(s, theta, np.zeros((12, M))).c
    errors = []
    for size in (1e-2, 1e-3):
        moved = s.copy()
        moved[D:] += size * rng.normal(size=len(s) - D) * np.tile([0.4, 0.4, 0.5, 5.0, 0.5], 4)
        optimum = solver.solve(moved, theta, plan).v
        solver.prepare(s, theta, plan)
        assert np.abs(optimum - plan).max() > 1e-7
        errors.append(float(np.abs(solver.feedback(moved).v - optimum).max() / np.abs(optimum - plan).max()))
    assert errors[1] < 0.05
    assert errors[1] < errors[0] or errors[0] < 1e-3


@pytest.mark.parametrize("name", ["rnn", "cnn"])
def test_one_real_time_iteration_is_close_to_the_optimum_along_a_closed_loop(name: str) -> None:
    plant, truth, oracle = MODEL.plant, Truth(MODEL.equations), oracle_of(name)
    solver = Solver(build_problem(MODEL, oracle, 20))
    state = oracle.begin(oracle.initial_state(np.random.default_rng(0)), X0, np.zeros(M))
    x, differences = X0, []
    s = np.concatenate([x, oracle.past(state).ravel()])
    solution = solver.solve(s, oracle.theta(state), np.zeros((20, M)))
    for _ in range(30):
        u = solution.v[0]
        predicted = follow(s, u, MODEL.A @ x + MODEL.B @ u + oracle.estimate(state, x, u))
        after = truth.step(x + plant.x_e, u + plant.u_e, 0.05) - plant.x_e
        state = oracle.learn(state, x, u, MODEL.label(x, u, after))
        s, x = np.concatenate([after, oracle.past(state).ravel()]), after
        np.testing.assert_allclose(predicted[D:], s[D:], atol=1e-15)
        v = np.vstack([solution.v[1:], np.zeros((1, M))])
        solver.prepare(predicted, oracle.theta(state), v)
        real_time = solver.feedback(s)
        solution = solver.solve(s, oracle.theta(state), v)
        differences.append(float(np.abs(solution.v[0] - real_time.v[0]).max()))
    assert max(differences) < 2e-3
    assert np.median(differences) < 1e-4


@pytest.mark.parametrize("name", ["rnn", "cnn"])
def test_a_network_with_nonfinite_weights_is_ignored(name: str) -> None:
    solver = Solver(build_problem(MODEL, oracle_of(name), 10))
    s = np.concatenate([0.3 * X0, np.zeros(4 * (D + M))])
    refused = solver.solve(s, np.full(solver.problem.oracle.parameters, np.nan), np.zeros((10, M)))
    assert refused.status is Status.ORACLE_REFUSED
    assert refused.usable


# -- weights, descriptions and configuration ---------------------------------------------------------------


def test_weights_of_another_architecture_are_refused() -> None:
    rnn, cnn = oracle_of("rnn"), oracle_of("cnn")
    state = rnn.initial_state(np.random.default_rng(0))
    foreign = [
        layer.astype(np.float32).astype(float)
        for layer in cnn.hidden(cnn.initial_state(np.random.default_rng(0)))
    ]
    after, verdict = rnn.adopt(state, HiddenSet(1, foreign, hash_layers(foreign), cnn.description.sha256()))
    assert verdict == Verdict("refused", "trained for another network description")
    assert after is state
    # The same weights with a false claim about the description that they were trained for.
    after, verdict = rnn.adopt(state, HiddenSet(1, foreign, hash_layers(foreign), rnn.description.sha256()))
    assert verdict.outcome == "refused"
    assert verdict.reason.startswith("shapes")
    assert after is state
    huge = [layer * 1e3 for layer in rnn.hidden(state)]
    _, verdict = rnn.adopt(state, HiddenSet(1, huge, hash_layers(huge), rnn.description.sha256()))
    assert verdict.outcome == "refused"
    assert verdict.reason.startswith("layer 1 has norm")
    hidden = HiddenSet(1, foreign, hash_layers(foreign), cnn.description.sha256())
    controller = Controller(build_problem(MODEL, rnn, 5), Solver(build_problem(MODEL, rnn, 5)))
    _, result = controller.step(controller.initial_state(0), Observation(X0, None, 1, 0, hidden))
    assert result.verdict == Verdict("refused", "trained for another network description")


def test_every_field_is_in_the_hash() -> None:
    base = NetworkDescription(
        states=1, inputs=1, hidden=[4, 4], activations=["tanh"] * 2, input_scale=[1.0] * 2, output_scale=[1.0]
    )
    changed = [
        msgspec.structs.replace(base, window=2),
        msgspec.structs.replace(base, window=2, architecture="rnn"),
        msgspec.structs.replace(base, window=3, architecture="rnn"),
        msgspec.structs.replace(base, window=3, architecture="cnn", options={"kernel": 2}),
        msgspec.structs.replace(base, window=3, architecture="cnn", options={"kernel": 3}),
    ]
    assert len({description.sha256() for description in (base, *changed)}) == 6


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["network.architecture=rn"], "did you mean 'rnn'"),
        (["network.architecture=cnn", "network.options.kernal=2"], "did you mean 'kernel'"),
        (["network.options.kernel=2"], "mlp has no such option"),
        (["network.window=0"], "network.window = 0"),
        (["network.architecture=rnn", "network.window=1"], "at least 2 pairs"),
        (["network.architecture=cnn", "network.options.kernel=9"], "covers 1 to 5 pairs"),
    ],
)
def test_an_error_names_the_wrong_setting(settings: list[str], said: str) -> None:
    from controller_node.build import build_controller, build_model

    with pytest.raises(ConfigError, match=said):
        build_controller(config := load(None, settings), build_model(config))


@pytest.mark.parametrize(("name", "window"), [("rnn", 5), ("cnn", 5)])
def test_training_gradient_matches_finite_differences(name: str, window: int) -> None:
    rng = np.random.default_rng(2)
    description = describe(MODEL, [6, 5], architecture=name, window=window)
    network = Network(description, torch.float64)
    network.load([rng.normal(size=shape) for shape in description.layer_shapes])
    windows, h, K = rng.normal(size=(9, window * 5)), 0.01 * rng.normal(size=(9, D)), rng.normal(size=(6, D))
    loss = build_loss(network, windows, h, K)
    assert isinstance(loss, AutogradLoss)
    assert isinstance(
        build_loss(Network(describe(MODEL, [4]), torch.float64), rng.normal(size=(2, 5)), h[:2], K[:5]),
        DenseLoss,
    )
    gradient = loss.gradient().numpy().copy()
    flat = network.flat.detach()
    for i in rng.choice(len(flat), 20, replace=False):
        values = []
        for step in (1e-6, -1e-6):
            flat[i] += step
            values.append(loss.value())
            flat[i] -= step
        assert abs(gradient[i] - (values[0] - values[1]) / 2e-6) < 1e-6 * (1 + abs(gradient[i]))


# -- the whole loop ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rnn", "cnn"])
@pytest.mark.parametrize("mode", ["converged", "real_time"])
def test_a_run_replays_byte_for_byte_from_start_and_middle(name: str, mode: str) -> None:
    settings = [
        f"network.architecture={name}",
        f"controller.solver.mode={mode}",
        "controller.keyframe_every=20",
    ]
    run = simulate(override(Config(), [*QUICK, *settings]), 50)
    assert any(result.weights_outcome == "adopted" for result in run.results)
    assert replay(run).equal
    middle = replay(run, 45)
    assert middle.equal
    assert middle.first_tick == 40
    # A keyframe without the window would fail the replay from the middle.
    thawed = run.entries(topics.KEYFRAME)[2].message
    assert "oracle.past" in thawed.arrays
    # In a run without a gap the windows of the samples slide over the samples.
    for before, after in itertools.pairwise(run.samples):
        assert after.past == [*before.past[1:], before.x + before.u]


@pytest.mark.parametrize("name", ["rnn", pytest.param("cnn", marks=pytest.mark.long)])
def test_the_loop_learns(name: str) -> None:
    settings = [f"network.architecture={name}", "network.hidden=[32, 32]", "controller.solver.compile=never"]
    summary = summarise(simulate(load(None, settings), 160))
    error = summary.prediction_error
    assert error.first_second is not None
    assert error.last_second is not None
    assert error.last_second < 0.05 * error.first_second
    assert all(share is not None and share < 0.02 for share in summary.overshoot.values())
    assert summary.constraint_violations == 0
    assert summary.fallback_ticks == 0
    assert summary.weights_adopted >= 5
    assert summary.weights_refused == 0
