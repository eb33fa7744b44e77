"""The network as expressions: h_hat, its Jacobian and its features phi, in CasADi and in numpy.

    h_hat(x, u) = s * K' phi_j(x, u),    phi_j = (1, psi_L[W_{L-1}' (1, psi_{L-1}[ ... (1, (x, u) / scale)])])

This is (e:NN_structure), or another architecture on a window of the last k pairs. `network_model.description` describes
the network, and the trainer builds the same function in torch.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from lbmpc.oracles.base import Oracle, OracleState, by_point, remembered
from lbmpc.oracles.dnn.backends import ACTIVATIONS, Numbers, Symbols
from network_model.description import NetworkDescription
from network_model.registry import get_architecture

SYMBOLS, NUMBERS = Symbols(), Numbers()


class NetworkExpressions(Oracle):
    """The part of the network oracle that has no memory.

    Args:
        description: sizes, activations and scaling.
    """

    description: NetworkDescription

    def __init__(self, description: NetworkDescription):
        self.description = description
        self.d, self.m = description.states, description.inputs
        self.output_scale = np.array(description.output_scale)
        self.input_scale = np.array(description.input_scale)
        self.shapes = [*description.layer_shapes, (description.features, self.d)]
        self.parameters = sum(rows * columns for rows, columns in self.shapes)
        self.pairs = description.window
        self._architecture, self._sizes = get_architecture(description.architecture), description.sizes
        self._hidden = [f"W{i + 1}" for i in range(len(self.shapes) - 1)]
        self._dense = description.architecture == "mlp" and self.pairs == 1

    def split(self, theta: ca.MX) -> list[ca.MX]:
        parts, start = [], 0
        for rows, columns in self.shapes:
            # theta is row-major and CasADi reshapes column-major, so this is W' with the biases first.
            transposed = ca.reshape(theta[start : start + rows * columns], columns, rows)
            parts += [transposed[:, 0], transposed[:, 1:]]
            start += rows * columns
        return parts

    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        return SYMBOLS.affine((parts[-2], parts[-1]), self.activation(su, parts)) * self.output_scale

    def activation(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        """Return phi without its leading 1, (n_L, n), for n points (s, u) at once, (D + m, n)."""
        layers = list(zip(parts[:-2:2], parts[1:-2:2], strict=True))
        return self._architecture.forward(SYMBOLS, self._sizes, layers, self._window(su))

    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        return self._forward_mode(su, parts) if self._dense else self._reverse_mode(su, parts)

    def _window(self, su: ca.MX) -> list[ca.MX]:
        """Return the network's scaled input, pair by pair, from points (s, u), (D + m, n)."""
        start = self.d + remembered(self)
        ordered = ca.vertcat(su[self.d : start, :], su[: self.d, :], su[start:, :]) if self.pairs > 1 else su
        scaled = ordered / np.tile(self.input_scale, self.pairs)
        return ca.vertsplit(scaled, self.d + self.m) if self.pairs > 1 else [scaled]

    def _reverse_mode(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        """Compute the Jacobians for any architecture, with one reverse sweep per entry of h_hat for all points."""
        rows, points = su.shape
        symbols = [ca.MX.sym("su", rows, points), *(ca.MX.sym("part", *part.shape) for part in parts)]
        h = self.value(symbols[0], symbols[1:])
        seeds = [ca.DM(np.outer(row, np.ones(points))) for row in np.eye(self.d)]
        swept = ca.vertcat(*(ca.jtimes(h, symbols[0], seed, True) for seed in seeds))
        gradients = ca.Function("gradients", symbols, [swept])(su, *parts)
        return [ca.reshape(column, rows, self.d).T for column in ca.horzsplit(gradients)]

    def _forward_mode(self, xu: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        """Compute the Jacobians for dense layers on one pair. (x, u) is short then, so this is cheapest."""
        points, variables = xu.shape[1], self.d + self.m
        activation = xu / self.input_scale
        # All directions and points side by side make each layer a single matrix product.
        tangent: ca.MX | None = None
        psis = [ACTIVATIONS[name] for name in self.description.activations]
        for bias, weights, psi in zip(parts[:-2:2], parts[1:-2:2], psis, strict=True):
            total = SYMBOLS.affine((bias, weights), activation)
            activation = psi.value(total)
            slope = psi.slope(total, activation)
            if tangent is None:
                directions = weights / ca.repmat(ca.DM(self.input_scale).T, weights.shape[0], 1)
                tangent = ca.horzcat(*(ca.repmat(directions[:, i], 1, points) for i in range(variables)))
            else:
                tangent = weights @ tangent
            tangent = tangent * ca.repmat(slope, 1, variables)
        return by_point(ca.horzsplit(parts[-1] @ tangent * self.output_scale, points))

    def hidden(self, state: OracleState) -> list[np.ndarray]:
        """Return W_1..W_{L-1} of an oracle's state."""
        return [state[name] for name in self._hidden]

    def named(self, hidden: Sequence[np.ndarray]) -> OracleState:
        """Return hidden layers as entries of an oracle's state."""
        return dict(zip(self._hidden, hidden, strict=True))

    def pack(self, hidden: list[np.ndarray], K: np.ndarray) -> np.ndarray:
        """Return theta for hidden layers and scaled output weights K, (1 + n_L, d)."""
        return np.concatenate([matrix.ravel() for matrix in (*hidden, K)])

    def features_of(self, hidden: Sequence[np.ndarray], window: np.ndarray) -> np.ndarray:
        """Return phi of a window, (k, d + m), oldest pair first, or of many windows, (points, k, d + m)."""
        pairs = list(np.moveaxis(window / self.input_scale, -2, 0))
        activation = self._architecture.forward(NUMBERS, self._sizes, hidden, pairs)
        return np.concatenate([np.ones((*activation.shape[:-1], 1)), activation], axis=-1)
