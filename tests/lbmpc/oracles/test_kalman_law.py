"""The Kalman law: the counterpart of Lemma 1, projection and covariance, and both after a rollback."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller_node.build import build_model, build_network_oracle, describe_filter
from controller_node.codegen.compiler import Compiler
from controller_node.core import ControllerCore
from lbmpc.oracles import DnnOracle
from lbmpc.oracles.base import OracleState, Realise
from lbmpc.oracles.dnn.adaptation_law import project_columns
from lbmpc.oracles.dnn.kalman_law import Kalman, KalmanLaw, nearest_within
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from run_log.replaying.replay import replay
from tandem.experiments.simulation.lockstep import follow
from tests.helpers.science import compressor, describe, features
from verification.stolen_trainer import follow_attacked, noise

MODEL = compressor()
FILTER = Kalman(prior_variance=0.02, label_variance=0.05, kept=0.99)


Step = Callable[[OracleState, np.ndarray, np.ndarray, np.ndarray | float], OracleState]


def stepping(law: KalmanLaw, features: int, d: int) -> Step:
    """Return (state, phi, error, variance of the label) -> state, as in an oracle."""
    phi, K, error = ca.MX.sym("phi", features), ca.MX.sym("K", d, features), ca.MX.sym("error", d)
    Sigma, variance = ca.MX.sym("Sigma", features, features), ca.MX.sym("variance", d)
    numbers = {name: ca.DM(value) for name, value in law.settings().items()}
    after = law.expression(phi, K, error, variance, numbers, {"Sigma": Sigma})
    f = ca.Function("f", [phi, K, error, variance, Sigma], [after["K"], after["Sigma"]])

    def step(
        state: OracleState, phi: np.ndarray, error: np.ndarray, variance: np.ndarray | float = 0.0
    ) -> OracleState:
        K, Sigma = f(phi, state["K"].T, error, variance, state["Sigma"])
        return law.bounded({"K": np.array(K).T, "Sigma": np.array(Sigma)})

    return step


class Case:
    """A plant h = W*' phi + epsilon, |W*^(i)| <= Wbar_i, whose features may change completely."""

    def __init__(self, seed: int, features: int, d: int, filter: Kalman, noise: float):
        rng = self.rng = np.random.default_rng(seed)
        self.filter, self.noise, self.d = filter, noise, d
        self.bounds = rng.uniform(0.1, 2.0, d)
        # Half of them are at the bound, where the projection acts.
        self.ideal = project_columns(
            rng.normal(size=(features, d)) * 10.0 ** rng.uniform(-2, 1, d), self.bounds
        )
        law = KalmanLaw(filter, self.bounds)
        self.step_law = stepping(law, features, d)
        self.state = law.begin(features)
        self.state["K"] = project_columns(rng.normal(size=(features, d)) * 3, self.bounds)
        self.turned = np.eye(features - 1)
        self.projected = 0

    def step(self) -> tuple[float, float, float]:
        """Return (|xtilde|^2 / s_t, |epsilon|^2 / r, s_t) of one step of the law."""
        n = len(self.turned)
        if self.rng.uniform() < 0.1:
            # Switch to other hidden layers.
            self.turned = self.rng.normal(size=(n, n))
        phi = np.concatenate([[1.0], np.tanh(self.turned @ self.rng.normal(size=n))])
        epsilon = self.noise * self.rng.uniform() * self.rng.normal(size=self.d)
        error = self.state["K"].T @ phi - (self.ideal.T @ phi + epsilon)
        # Some labels have a variance of their own.
        variance = self.rng.uniform(size=self.d) * self.rng.choice([0.0, 0.01, 1.0])
        r = self.filter.label_variance + variance.max()
        s = r + phi @ self.state["Sigma"] @ phi
        assert s <= r + self.filter.prior_variance * (phi @ phi) * (1 + 1e-9)  # (i)
        self.state = self.step_law(self.state, phi, error, variance)
        norms = np.linalg.norm(self.state["K"], axis=0)
        assert (norms <= self.bounds * (1 + 1e-12)).all()
        self.projected += int((norms > self.bounds * (1 - 1e-9)).any())
        return float(error @ error) / s, float(epsilon @ epsilon) / r, s

    def lyapunov(self) -> float:
        missing = self.state["K"] - self.ideal
        return float(np.trace(missing.T @ np.linalg.solve(self.state["Sigma"], missing)))


CASES = st.builds(
    Case,
    seed=st.integers(0, 2**32),
    features=st.integers(1, 20),
    d=st.integers(1, 5),
    filter=st.builds(
        Kalman,
        prior_variance=st.sampled_from([1e-3, 0.02, 1.0]),
        label_variance=st.sampled_from([1e-4, 0.01, 1.0]),
        kept=st.sampled_from([0.5, 0.99, 1 - 1e-6]),
    ),
    noise=st.sampled_from([0.0, 0.01, 1.0, 30.0]),
)


@settings(max_examples=60, deadline=None)
@given(CASES)
def test_the_counterpart_of_lemma_1(case: Case) -> None:
    start = before = case.lyapunov()
    assert start <= 4 / case.filter.prior_variance * (case.bounds**2).sum() * (1 + 1e-9)
    errors = noises = 0.0
    for _ in range(40):
        error, epsilon, _ = case.step()
        after = case.lyapunov()
        assert after - before <= epsilon - error + 1e-7 * (1 + before + epsilon)  # (ii)
        errors, noises, before = errors + error, noises + epsilon, after
    assert errors <= (start + noises) * (1 + 1e-6) + 1e-6  # (iii)


def test_the_projection_is_active_in_these_cases() -> None:
    case = Case(3, 12, 3, FILTER, 1.0)
    for _ in range(40):
        case.step()
    assert case.projected >= 20


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32), f=st.integers(1, 12), spread=st.floats(0, 8), far=st.floats(-3, 6))
def test_the_projection_is_the_nearest_point(seed: int, f: int, spread: float, far: float) -> None:
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(f, f)))[0]
    variances = 10.0 ** rng.uniform(-spread, 0.0, f)
    Sigma = axes @ np.diag(variances) @ axes.T
    bounds, K = np.array([0.7, 2.0]), rng.normal(size=(f, 2)) * 10.0**far
    nearest = nearest_within(K, Sigma, bounds)
    for i in range(2):
        if np.linalg.norm(K[:, i]) <= bounds[i]:
            np.testing.assert_array_equal(nearest[:, i], K[:, i])
            continue
        assert np.linalg.norm(nearest[:, i]) == pytest.approx(bounds[i], rel=1e-9)
        # kbar - k = lambda Sigma k with lambda > 0 proves that no point of the ball is nearer.
        pull, along = K[:, i] - nearest[:, i], Sigma @ nearest[:, i]
        multiplier = (pull @ along) / (along @ along)
        assert multiplier > 0
        np.testing.assert_allclose(pull, multiplier * along, atol=1e-6 * np.linalg.norm(K[:, i]))


def test_a_million_updates_leave_the_covariance_symmetric_and_positive() -> None:
    rng, many, f = np.random.default_rng(0), 1000, 4
    law = KalmanLaw(Kalman(1.0, 1e-8, 1 - 1e-9), np.array([1.0]))
    phi, Sigma = ca.MX.sym("phi", f), ca.MX.sym("Sigma", f, f)
    numbers = {name: ca.DM(value) for name, value in law.settings().items()}
    after = law.expression(phi, ca.MX(1, f), ca.MX(1, 1), ca.MX(1, 1), numbers, {"Sigma": Sigma})["Sigma"]
    folded = ca.Function("f", [Sigma, phi], [after]).expand().fold(many)
    # The direction is almost constant, as at rest.
    phis = np.vstack([np.ones(many), 1e-6 * rng.normal(size=(f - 1, many))])
    now = np.eye(f)
    for _ in range(1000):
        now = np.array(folded(now, phis))
    np.testing.assert_array_equal(now, now.T)
    variances = np.linalg.eigvalsh(now)
    assert variances[0] > 0
    assert variances[-1] <= 1 + 1e-9


def test_forgetting_allows_a_change_to_be_followed() -> None:
    rng, f = np.random.default_rng(0), 6
    left = {}
    for kept in (0.98, 1 - 1e-9):
        law = KalmanLaw(Kalman(0.5, 0.01, kept), np.array([10.0]))
        step, state = stepping(law, f, 1), {**law.begin(f), "K": np.zeros((f, 1))}
        for t in range(600):
            ideal = np.full((f, 1), 0.3 if t < 500 else -0.3)
            phi = np.concatenate([[1.0], np.tanh(rng.normal(size=f - 1))])
            state = step(state, phi, (state["K"] - ideal).T @ phi)
        left[kept] = float(np.abs(state["K"] + 0.3).max())
    assert left[0.98] < 0.02
    assert left[1 - 1e-9] > 0.2


# -- the oracle ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "realise", [lambda function: function, Compiler()], ids=["virtual machine", "compiled"]
)
def test_the_functions_of_a_tick_equal_the_law(realise: Realise) -> None:
    rng = np.random.default_rng(5)
    oracle = DnnOracle(describe(MODEL, [6, 5]), column_bound=0.01, kalman=FILTER)
    oracle.compile(realise)
    state = oracle.initial_state(rng)
    bounded = 0
    for _ in range(40):
        x, u, h = rng.normal(size=4), rng.normal(size=1), rng.normal(size=4) * 0.02
        phi, K, Sigma = features(oracle, state, x, u), state["K"], state["Sigma"]
        given_state = {name: array.copy() for name, array in state.items()}
        after = oracle.learn(state, x, u, h)
        for name, array in given_state.items():
            np.testing.assert_array_equal(state[name], array)
        s = FILTER.label_variance + phi @ Sigma @ phi
        moved = K - np.outer(Sigma @ phi, K.T @ phi - h / oracle.output_scale) / s
        wanted = FILTER.kept * (Sigma - np.outer(Sigma @ phi, phi @ Sigma) / s)
        wanted += (1 - FILTER.kept) * FILTER.prior_variance * np.eye(6)
        np.testing.assert_allclose(after["Sigma"], wanted, rtol=1e-10, atol=1e-14)
        np.testing.assert_array_equal(after["Sigma"], after["Sigma"].T)
        inside = np.linalg.norm(moved, axis=0) <= oracle.bounds
        np.testing.assert_allclose(after["K"][:, inside], moved[:, inside], rtol=1e-10, atol=1e-13)
        assert (np.linalg.norm(after["K"], axis=0) <= oracle.bounds * (1 + 1e-12)).all()
        bounded += int((~inside).sum())
        state = after
    assert 0 < bounded < 160


SETTINGS = [
    "adaptation.law=kalman",
    "controller.solver.compile=never",
    "controller.horizon=15",
    "controller.keyframe_every=10",
    "network.hidden=[8, 8]",
    "trainer.steps=20",
]


def config(*more: str) -> Config:
    return load(None, [*SETTINGS, *more])


def oracle_of(settings: Config) -> DnnOracle:
    return build_network_oracle(settings, build_model(settings))


def test_refusals_and_rollbacks_are_replayed_and_restore_the_covariance() -> None:
    # These settings accept every set before adoption and none after it, so adopted sets are rolled back.
    trial = [f"adaptation.trial.{key}" for key in ("floor=1.0", "floor_after=0.0", "margin=0.0")]
    run = follow_attacked(config(*trial), 100, noise(0.3), 9)
    back = [result.seq for result in run.results if result.weights_rolled_back]
    assert back
    assert replay(run).equal
    found = replay(run, from_tick=back[0])
    assert found.equal, found.first_difference
    core = ControllerCore(run.config, run.commands[0].run_id)
    for tick in run.ticks[: back[0]]:
        core.step(tick)
    wanted = {name: core.memory.state.oracle[f"before.{name}"] for name in ("K", "Sigma")}
    assert wanted["Sigma"].any()
    core.step(run.ticks[back[0]])
    for name, array in wanted.items():
        np.testing.assert_array_equal(core.memory.state.oracle[name], array)


def test_an_adoption_keeps_K_and_its_covariance() -> None:
    run = follow(config(), 30).run
    first = next(result.seq for result in run.results if result.weights_outcome == "adopted")
    core, without = (ControllerCore(run.config, run.commands[0].run_id) for _ in range(2))
    for tick in run.ticks[:first]:
        core.step(tick)
        without.step(tick)
    core.step(run.ticks[first])
    without.step(msgspec.structs.replace(run.ticks[first], weights=None))
    one, other = core.memory.state.oracle, without.memory.state.oracle
    assert not np.array_equal(one["W1"], other["W1"])
    for name in ("K", "Sigma"):
        np.testing.assert_array_equal(one[name], other[name])


def test_no_covariance_without_a_filter() -> None:
    for more in (["adaptation.law=gradient"], ["adaptation.enabled=false"]):
        state = oracle_of(config(*more)).initial_state(np.random.default_rng(0))
        assert not [name for name in state if "Sigma" in name]
    still = follow(config("adaptation.enabled=false"), 20).run
    weights = [w.K.numpy() for w in still.output_weights]
    np.testing.assert_array_equal(weights[0], weights[-1])


@pytest.mark.parametrize(
    ("settings", "time_scale", "samples"),
    [
        (["rate=20"], 1.0, 40),
        (["rate=1000"], 0.25, 500),
        (["rate=0.2"], 16.0, 20),
        (["rate=20", "estimator.kind=kalman"], 1.0, 200),
        (["rate=10", "adaptation.kalman.memory=0.5"], 16.0, 5),
    ],
)
def test_the_memory_is_in_time_scales_of_the_plant_or_in_seconds(
    settings: list[str], time_scale: float, samples: int
) -> None:
    assert describe_filter(config(*settings), time_scale).kept ** samples == pytest.approx(np.exp(-1))


def test_a_last_layer_that_is_too_wide_is_refused_by_name() -> None:
    assert oracle_of(config("network.hidden=[4, 511]")).law.remembers == ("Sigma",)
    with pytest.raises(ConfigError, match=r"at most 511 neurons in the last layer of network\.hidden"):
        oracle_of(config("network.hidden=[4, 512]"))


def test_a_checkpoint_of_the_other_law_is_refused_by_name() -> None:
    with_filter, without = (
        ControllerCore(config(f"adaptation.law={law}"), law) for law in ("kalman", "gradient")
    )
    with pytest.raises(
        ValueError, match=r"array oracle\.Sigma is missing|array oracle\.before\.Sigma is missing"
    ):
        with_filter.memory.go_on(without.memory.lasting(), "b")
    with_filter.memory.go_on(with_filter.memory.lasting(), "b")
