"""The operations of `network_model.operations` in CasADi, for the solver, and in numpy, for adaptation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from network_model.operations import Activation


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


class Symbols:
    """CasADi operations. A value is (n, points); a layer is its bias (n,) and its transposed weights (n, n_a)."""

    def affine(self, layer: tuple[ca.MX, ca.MX], a: ca.MX) -> ca.MX:
        bias, weights = layer
        product = weights @ a
        return product + (bias if a.shape[1] == 1 else ca.repmat(bias, 1, a.shape[1]))

    def activate(self, name: Activation, a: ca.MX) -> ca.MX:
        return ACTIVATIONS[name].value(a)

    def join(self, parts: Sequence[ca.MX]) -> ca.MX:
        return ca.vertcat(*parts)


class Numbers:
    """numpy operations. A value is (n,), or (points, n) for several; a layer is (1 + n_a, n) with the bias first."""

    def affine(self, layer: np.ndarray, a: np.ndarray) -> np.ndarray:
        return layer[0] + a @ layer[1:]

    def activate(self, name: Activation, a: np.ndarray) -> np.ndarray:
        return ACTIVATIONS[name].numpy(a)

    def join(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)
