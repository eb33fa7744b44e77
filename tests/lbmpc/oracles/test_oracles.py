"""The common interface of the oracles: value, Jacobian, learning, parameters as data."""

from __future__ import annotations

import numpy as np
import pytest

from controller_node.codegen.compiler import Compiler
from lbmpc.oracles import DnnOracle, L2nwOracle
from lbmpc.oracles.base import HiddenSet, Realise, Verdict
from network_model.description import hash_layers
from tests.helpers.science import adapt, compressor, describe, features, function, oracle_named

MODEL = compressor()


@pytest.mark.parametrize("name", ["linear", "constant", "l2nw", "dnn"])
def test_jacobian_and_numpy_agree_with_the_expression(name: str) -> None:
    rng = np.random.default_rng(3)
    oracle = oracle_named(name, MODEL)
    state = oracle.initial_state(rng)
    for _ in range(12):
        state = oracle.learn(state, rng.normal(size=4) * 0.2, rng.normal(size=1), rng.normal(size=4) * 0.01)
    f, theta = function(oracle), oracle.theta(state)
    for _ in range(10):
        x, u = rng.normal(size=4) * 0.3, rng.normal(size=1)
        h, jacobian = (np.array(value) for value in f(x, u, theta))
        np.testing.assert_allclose(h.ravel(), oracle.estimate(state, x, u), atol=1e-15)
        e = 1e-6 * np.eye(5)
        xu = np.concatenate([x, u])
        for k in range(5):
            up, down = xu + e[k], xu - e[k]
            slope = (
                oracle.estimate(state, up[:4], up[4:]) - oracle.estimate(state, down[:4], down[4:])
            ) / 2e-6
            np.testing.assert_allclose(jacobian[:, k], slope, atol=1e-9)


@pytest.mark.parametrize("activation", ["tanh", "sigmoid", "softsign", "softplus", "relu"])
def test_every_activation_has_the_right_slope(activation: str) -> None:
    rng = np.random.default_rng(4)
    description = describe(MODEL, [6, 5])
    description = type(description)(
        **{f: getattr(description, f) for f in description.__struct_fields__}
        | {"activations": [activation, "tanh"]}
    )
    oracle = DnnOracle(description, initial_scale=0.01)
    state = oracle.initial_state(rng)
    f, theta = function(oracle), oracle.theta(state)
    x, u = rng.normal(size=4), rng.normal(size=1)
    jacobian = np.array(f(x, u, theta)[1])
    for k in range(5):
        e = np.eye(5)[k] * 1e-6
        up = oracle.estimate(state, x + e[:4], u + e[4:])
        down = oracle.estimate(state, x - e[:4], u - e[4:])
        np.testing.assert_allclose(jacobian[:, k], (up - down) / 2e-6, atol=1e-9)


@pytest.mark.parametrize(
    "realise", [lambda function: function, Compiler()], ids=["virtual machine", "compiled"]
)
@pytest.mark.parametrize("architecture", ["mlp", "rnn", "cnn"])
def test_the_functions_of_a_tick_equal_the_law(architecture: str, realise: Realise) -> None:
    rng = np.random.default_rng(5)
    oracle = DnnOracle(describe(MODEL, [6, 5], architecture=architecture), gamma=0.7, column_bound=0.01)
    oracle.compile(realise)
    state = oracle.begin(oracle.initial_state(rng), rng.normal(size=4), rng.normal(size=1))
    bounded = 0
    for k in range(60):
        if k == 30:
            # Switch to other hidden layers, as an adoption does.
            state = {**state, **{f"W{i + 1}": 1.1 * layer for i, layer in enumerate(oracle.hidden(state))}}
        x, u, h = rng.normal(size=4), rng.normal(size=1), rng.normal(size=4) * 0.02
        phi, K = features(oracle, state, x, u), state["K"]
        h_hat = oracle.output_scale * (phi @ K)
        np.testing.assert_allclose(oracle.estimate(state, x, u), h_hat, rtol=1e-12, atol=1e-16)
        state = oracle.learn(state, x, u, h)
        wanted = adapt(K, phi, (h_hat - h) / oracle.output_scale, 0.7, oracle.bounds)
        np.testing.assert_allclose(state["K"], wanted, rtol=1e-11, atol=1e-14)
        norms = np.linalg.norm(state["K"], axis=0)
        assert (norms <= oracle.bounds * (1 + 1e-12)).all()
        bounded += int((norms > 0.999 * oracle.bounds).sum())
    assert 0 < bounded < 240


def test_unused_slots_of_the_window_are_ignored() -> None:
    oracle = L2nwOracle(4, 1, (0, 1, 4), window=50, bandwidth=0.5, regularisation=1e-6)
    state = oracle.initial_state(np.random.default_rng(0))
    np.testing.assert_array_equal(oracle.estimate(state, np.zeros(4), np.zeros(1)), np.zeros(4))
    h = np.array([0.01, -0.02, 0.0, 0.0])
    state = oracle.learn(state, np.zeros(4), np.zeros(1), h)
    # 49 slots of zeros beside one sample would reduce this to h / 50.
    np.testing.assert_allclose(oracle.estimate(state, np.zeros(4), np.zeros(1)), h, rtol=1e-5)


def test_the_window_forgets_its_oldest_sample() -> None:
    oracle = L2nwOracle(4, 1, (0,), window=3, bandwidth=1e-3, regularisation=1e-6)
    state = oracle.initial_state(np.random.default_rng(0))
    for i in range(4):
        state = oracle.learn(state, np.full(4, float(i)), np.zeros(1), np.full(4, i + 1.0))
    assert oracle.estimate(state, np.zeros(4), np.zeros(1))[0] == pytest.approx(0.0)
    assert oracle.estimate(state, np.full(4, 3.0), np.zeros(1))[0] == pytest.approx(4.0, rel=1e-5)


def test_learning_does_not_modify_the_given_state() -> None:
    for name in ("constant", "l2nw", "dnn"):
        oracle = oracle_named(name, MODEL)
        state = oracle.initial_state(np.random.default_rng(0))
        before = {key: value.copy() for key, value in state.items()}
        oracle.learn(state, np.ones(4), np.ones(1), np.ones(4))
        for key, value in before.items():
            np.testing.assert_array_equal(state[key], value)


def test_the_estimate_is_bounded_at_every_point() -> None:
    oracle = DnnOracle(describe(MODEL, [16, 16]))
    state = oracle.initial_state(np.random.default_rng(0))
    state = {**state, "K": state["K"] / np.linalg.norm(state["K"], axis=0) * oracle.bounds}
    sigma = np.sqrt(oracle.description.features)
    for size in (1.0, 1e3, 1e12):
        h = oracle.estimate(state, np.full(4, size), np.full(1, -size))
        assert (np.abs(h) <= oracle.bounds * oracle.output_scale * sigma + 1e-15).all()


def _offer(oracle: DnnOracle, state, **change):
    layers = [layer + np.float32(0.25) for layer in oracle.hidden(state)]
    layers = [layer.astype(np.float32).astype(float) for layer in layers]
    offer = {
        "version": 1,
        "layers": layers,
        "sha256": hash_layers(layers),
        "network_sha256": oracle.description.sha256(),
    }
    return oracle.adopt(state, HiddenSet(**(offer | change)))


def test_adoption_swaps_the_hidden_layers_and_keeps_K() -> None:
    oracle = DnnOracle(describe(MODEL, [5, 4]))
    state = oracle.initial_state(np.random.default_rng(0))
    after, verdict = _offer(oracle, state)
    assert verdict == Verdict("adopted")
    assert after["version"][0] == 1
    np.testing.assert_array_equal(after["K"], state["K"])
    np.testing.assert_allclose(after["W1"], state["W1"] + 0.25, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"version": 0}, "version 0 is not newer"),
        ({"sha256": "0" * 64}, "sha256"),
        ({"network_sha256": "1" * 64}, "another network"),
        ({"layers": [np.zeros((6, 5))]}, "shapes"),
        ({"layers": [np.full((6, 5), np.nan), np.zeros((6, 4))]}, "layer 1 is not finite"),
        ({"layers": [np.zeros((6, 5)), np.full((6, 4), 1e3)]}, "layer 2 has norm"),
    ],
)
def test_a_bad_set_is_refused_by_name_and_changes_nothing(change: dict, reason: str) -> None:
    oracle = DnnOracle(describe(MODEL, [5, 4]))
    state = oracle.initial_state(np.random.default_rng(0))
    after, verdict = _offer(oracle, state, **change)
    assert verdict.outcome == "refused"
    assert reason in verdict.reason
    assert after is state
