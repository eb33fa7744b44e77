"""The deep network: hidden layers from the trainer, last layer adapted at every sample.

    h_hat(x, u) = s * K' phi_j(x, u),    phi_j = (1, psi_L[W_{L-1}' (1, psi_{L-1}[ ... (1, (x, u) / scale)])])

(e:NN_structure). `protocol.network` describes it; the trainer builds the same function in torch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np

from lbmpc.adaptation import adapt, project_columns
from lbmpc.oracles import base
from lbmpc.oracles.base import OracleState
from protocol.network import Activation, NetworkDescription, hash_layers, initial_hidden, why_unacceptable


class _Activation(NamedTuple):
    """psi and its derivative, in CasADi and in numpy; the derivative takes (input, psi(input))."""

    value: Callable[[ca.MX], ca.MX]
    slope: Callable[[ca.MX, ca.MX], ca.MX]
    numpy: Callable[[np.ndarray], np.ndarray]


ACTIVATIONS: dict[Activation, _Activation] = {
    "tanh": _Activation(ca.tanh, lambda a, s: 1 - s * s, np.tanh),
    "sigmoid": _Activation(
        lambda a: 0.5 + 0.5 * ca.tanh(0.5 * a),
        lambda a, s: s * (1 - s),
        lambda a: 0.5 + 0.5 * np.tanh(0.5 * a),
    ),
    "softsign": _Activation(
        lambda a: a / (1 + ca.fabs(a)), lambda a, s: 1 / (1 + ca.fabs(a)) ** 2, lambda a: a / (1 + np.abs(a))
    ),
    "softplus": _Activation(
        lambda a: ca.fmax(a, 0) + ca.log1p(ca.exp(-ca.fabs(a))),
        lambda a, s: 0.5 + 0.5 * ca.tanh(0.5 * a),
        lambda a: np.logaddexp(a, 0.0),
    ),
    "relu": _Activation(lambda a: ca.fmax(a, 0), lambda a, s: a > 0, lambda a: np.maximum(a, 0.0)),
}


class DnnOracle:
    """A bounded network h_hat whose hidden weights and output weights are parameters.

    Args:
        description: sizes, activations and scaling.
        gamma: learning rate of the last layer.
        column_bound: Wbar_i, in units of h.
        initial_scale: standard deviation of the entries of K_0, in units of h.
    """

    name = "dnn"

    def __init__(
        self,
        description: NetworkDescription,
        gamma: float = 0.5,
        column_bound: float = 0.05,
        initial_scale: float = 1e-3,
    ):
        self.description = description
        self.d, self.m = description.states, description.inputs
        self.gamma = gamma
        self.output_scale = np.array(description.output_scale)
        self.input_scale = np.array(description.input_scale)
        self.bounds = column_bound / self.output_scale
        self.initial_scale = initial_scale
        self.shapes = [*description.layer_shapes, (description.features, self.d)]
        self.parameters = sum(rows * columns for rows, columns in self.shapes)
        self._psi = [ACTIVATIONS[name] for name in description.activations]

    # -- expressions ---------------------------------------------------------------------------------------------

    def split(self, theta: ca.MX) -> list[ca.MX]:
        parts, start = [], 0
        for rows, columns in self.shapes:
            # theta holds each matrix row by row, CasADi reshapes column by column: this is W', biases first.
            transposed = ca.reshape(theta[start : start + rows * columns], columns, rows)
            parts += [transposed[:, 0], transposed[:, 1:]]
            start += rows * columns
        return parts

    def value(self, xu: ca.MX, parts: list[ca.MX]) -> ca.MX:
        activation = xu / self.input_scale
        for bias, weights, psi in zip(parts[:-2:2], parts[1:-2:2], self._psi, strict=True):
            activation = psi.value(_affine(bias, weights, activation))
        return _affine(parts[-2], parts[-1], activation) * self.output_scale

    def jacobian(self, xu: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        points, variables = xu.shape[1], self.d + self.m
        activation = xu / self.input_scale
        # Forward mode, all directions and all points side by side: each layer is one matrix product.
        tangent: ca.MX | None = None
        for bias, weights, psi in zip(parts[:-2:2], parts[1:-2:2], self._psi, strict=True):
            total = _affine(bias, weights, activation)
            activation = psi.value(total)
            slope = psi.slope(total, activation)
            if tangent is None:
                directions = weights / ca.repmat(ca.DM(self.input_scale).T, weights.shape[0], 1)
                tangent = ca.horzcat(*(ca.repmat(directions[:, i], 1, points) for i in range(variables)))
            else:
                tangent = weights @ tangent
            tangent = tangent * ca.repmat(slope, 1, variables)
        return ca.horzsplit(parts[-1] @ tangent * self.output_scale, points)

    def function(self) -> ca.Function:
        """(x, u, theta) -> h_hat and Jacobian."""
        return base.function(self)

    # -- state ---------------------------------------------------------------------------------------------------

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        hidden = initial_hidden(self.description, rng)
        k = rng.standard_normal(self.shapes[-1]) * (self.initial_scale / self.output_scale)
        state = {f"W{i + 1}": layer for i, layer in enumerate(hidden)}
        state["K"] = project_columns(k, self.bounds)
        state["version"] = np.zeros(1, dtype=np.int64)
        return state

    def hidden(self, state: OracleState) -> list[np.ndarray]:
        """W_1..W_{L-1}."""
        return [state[f"W{i + 1}"] for i in range(len(self._psi))]

    def pack(self, hidden: list[np.ndarray], K: np.ndarray) -> np.ndarray:
        """theta from hidden layers and scaled output weights K, (1 + n_L, d)."""
        return np.concatenate([np.ravel(matrix) for matrix in (*hidden, K)])

    def theta(self, state: OracleState) -> np.ndarray:
        return self.pack(self.hidden(state), state["K"])

    def features(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """phi_j(x, u), (1 + n_L,), with phi[0] = 1."""
        activation = np.concatenate([x, u]) / self.input_scale
        for weights, psi in zip(self.hidden(state), self._psi, strict=True):
            activation = psi.numpy(weights[0] + activation @ weights[1:])
        return np.concatenate([[1.0], activation])

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return self.output_scale * (self.features(state, x, u) @ state["K"])

    def learn(self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray) -> OracleState:
        phi = self.features(state, x, u)
        error = phi @ state["K"] - h / self.output_scale
        return {**state, "K": adapt(state["K"], phi, error, self.gamma, self.bounds)}

    def adopt(
        self, state: OracleState, version: int, layers: list[np.ndarray], sha256: str, network_sha256: str
    ) -> tuple[OracleState, str]:
        """Swap in a new set of hidden weights; K is kept.

        Returns:
            The state and "adopted", or the state unchanged and "refused: <reason>".
        """
        current = int(state["version"][0])
        if version <= current:
            return state, f"refused: version {version} is not newer than {current}"
        if network_sha256 != self.description.sha256():
            return state, "refused: trained for another network description"
        reason = why_unacceptable(self.description, layers)
        if reason is not None:
            return state, f"refused: {reason}"
        if hash_layers(layers) != sha256:
            return state, "refused: sha256 does not match the layers"
        swapped = {f"W{i + 1}": layer.astype(float) for i, layer in enumerate(layers)}
        return {**state, **swapped, "version": np.array([version], dtype=np.int64)}, "adopted"


def _affine(bias: ca.MX, weights: ca.MX, activation: ca.MX) -> ca.MX:
    """b + V a for many points: (k,), (k, n), (n, points) -> (k, points)."""
    product = weights @ activation
    return product + (bias if activation.shape[1] == 1 else ca.repmat(bias, 1, activation.shape[1]))
