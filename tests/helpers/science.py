"""Helpers of several tests of the science: small problems, random networks."""

from __future__ import annotations

import casadi as ca
import numpy as np

from lbmpc.model import Model, build_model
from lbmpc.oracles import ConstantOracle, DnnOracle, L2nwOracle, LinearOracle, Oracle, OracleState
from lbmpc.oracles.base import remembered
from lbmpc.oracles.dnn.adaptation_law import project_columns
from lbmpc.plants import get_plant
from network_model.description import NetworkDescription
from network_model.registry import get_architecture


def compressor(period: float = 0.05) -> Model:
    return build_model(get_plant("moore_greitzer"), period)


def describe(
    model: Model,
    hidden: list[int],
    activation: str = "tanh",
    scale: float = 0.01,
    architecture: str = "mlp",
    window: int | None = None,
) -> NetworkDescription:
    plant, kind = model.plant, get_architecture(architecture)
    half = np.concatenate([plant.x_scale, plant.u_scale])
    return NetworkDescription(
        states=model.d,
        inputs=model.m,
        hidden=hidden,
        activations=[activation] * len(hidden),
        input_scale=half.tolist(),
        output_scale=[scale] * model.d,
        architecture=architecture,
        window=window or kind.window,
        options=kind.options,
    )


def oracle_named(name: str, model: Model, hidden: list[int] | None = None) -> Oracle:
    if name == "linear":
        return LinearOracle(model.d, model.m)
    if name == "constant":
        return ConstantOracle(model.d, model.m, 0.5)
    if name == "l2nw":
        return L2nwOracle(model.d, model.m, (0, 1, 4), 30, 0.5, 1e-3)
    return DnnOracle(describe(model, hidden or [8, 8]))


def trained_theta(
    oracle: Oracle, rng: np.random.Generator, samples: int = 20, size: float = 0.01
) -> np.ndarray:
    """Return the parameters after a few random samples with labels of that size."""
    state = oracle.initial_state(rng)
    for _ in range(samples):
        x = rng.uniform(-1, 1, oracle.d) * [0.4, 0.4, 0.5, 5.0]
        state = oracle.learn(state, x, rng.uniform(-0.5, 0.5, oracle.m), rng.normal(size=oracle.d) * size)
    return oracle.theta(state)


def function(oracle: Oracle) -> ca.Function:
    """(s, u, theta) -> (h_hat (d,), Jacobian (d, D + m)) as a CasADi function."""
    s, u = ca.MX.sym("s", oracle.d + remembered(oracle)), ca.MX.sym("u", oracle.m)
    theta = ca.MX.sym("theta", oracle.parameters)
    su = ca.vertcat(s, u)
    parts = oracle.split(theta)
    (jacobian,) = oracle.jacobians(su, parts)
    return ca.Function(
        "oracle", [s, u, theta], [oracle.value(su, parts), jacobian], ["s", "u", "theta"], ["h", "J"]
    )


def features(oracle: DnnOracle, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """phi_j(x, u) with the past in this state, (1 + n_L,), with phi[0] = 1."""
    return oracle.features_of(oracle.hidden(state), np.vstack([oracle.past(state), np.concatenate([x, u])]))


def adapt(
    K: np.ndarray,
    phi: np.ndarray,
    error: np.ndarray,
    gamma: float | np.ndarray,
    bounds: np.ndarray,
) -> np.ndarray:
    """One step of the law as in the paper, the reference for `lbmpc.oracles.dnn.last_layer`.

    Args:
        K: output weights K_t, (n, d).
        phi: features phi_j(x_t, u_t) of the hidden weights in force when u_t was applied, (n,), phi[0] = 1.
        error: xtilde_{t+1} = h_hat_t(x_t, u_t) - h(x_t, u_t), (d,), in the units of K' phi.
        gamma: learning rate, 0 < gamma < 1; or one for each column, (d,).
        bounds: Wbar_i, (d,), in the same units.

    Returns:
        K_{t+1}, (n, d).
    """
    return project_columns(K - np.outer(phi, error) * (gamma / (phi @ phi)), bounds)
