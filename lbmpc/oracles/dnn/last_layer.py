"""The network's two functions in every tick beside the solver's, in CasADi: estimate h, and learn one sample.

They can be compiled. A compiled call takes a fifth of the time of numpy on arrays this small.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import is_

import casadi as ca
import numpy as np

from lbmpc.casadi_buffers import Bound
from lbmpc.oracles.base import OracleState, Realise, Variance
from lbmpc.oracles.dnn.adaptation_law import AdaptationLaw
from lbmpc.oracles.dnn.expressions import NetworkExpressions


class LastLayer:
    """h_hat = s * K' phi and an adaptation law, on fixed arrays.

    Args:
        net: the network.
        law: the adaptation law of K.
        realise: may compile the functions.
    """

    def __init__(self, net: NetworkExpressions, law: AdaptationLaw, realise: Realise):
        estimate, learn = build_last_layer(net, law)
        self._law = law
        self._estimate, self._learn = Bound(realise(estimate)), Bound(realise(learn))
        for name, numbers in law.settings().items():
            self._learn.inputs[name][:, 0] = numbers
        self._hidden: Sequence[np.ndarray] = ()

    def estimate(
        self, hidden: Sequence[np.ndarray], K: np.ndarray, x: np.ndarray, past: np.ndarray, u: np.ndarray
    ) -> np.ndarray:
        """Return h_hat, (d,), in units of h, at x (d,) and u (m,) with the past pairs `past`, ((k - 1) (d + m),)."""
        self._load(self._estimate, hidden, K, x, past, u)
        self._estimate()
        return self._estimate.outputs["h_hat"][:, 0].copy()

    def learn(
        self,
        hidden: Sequence[np.ndarray],
        state: OracleState,
        x: np.ndarray,
        past: np.ndarray,
        u: np.ndarray,
        h: np.ndarray,
        variance: Variance = 0.0,
    ) -> OracleState:
        """Return K, (1 + n_L, d), and the law's memory after the label h, (d,), with its variance.

        state: contains K and the law's memory before the label.
        """
        self._load(self._learn, hidden, state["K"], x, past, u)
        self._learn.inputs["h"][:, 0] = h
        self._learn.inputs["variance"][:, 0] = variance
        for name in self._law.remembers:
            self._learn.inputs[name][:] = state[name]
        self._learn()
        after = self._learn.outputs
        learned: OracleState = {"K": after["K_next"].T.copy()}
        for name in self._law.remembers:
            # The arrays are symmetric, so the transpose gives row-major arrays for a keyframe.
            learned[name] = after[f"{name}_next"].T.copy()
        return self._law.bounded(learned)

    def _load(
        self,
        bound: Bound,
        hidden: Sequence[np.ndarray],
        K: np.ndarray,
        x: np.ndarray,
        past: np.ndarray,
        u: np.ndarray,
    ) -> None:
        # Layers change at an adoption only and are never written to, so identical arrays have identical values.
        if len(self._hidden) != len(hidden) or not all(map(is_, self._hidden, hidden)):
            packed = np.concatenate([layer.ravel() for layer in hidden])
            for each in (self._estimate, self._learn):
                each.inputs["hidden"][:, 0] = packed
            self._hidden = list(hidden)
        bound.inputs["K"][:] = K.T
        point, d, m = bound.inputs["su"][:, 0], len(x), len(u)
        point[:d], point[-m:] = x, u
        if len(past):
            point[d:-m] = past


def build_last_layer(net: NetworkExpressions, law: AdaptationLaw) -> tuple[ca.Function, ca.Function]:
    """Build `estimate` (su, hidden, K) -> h_hat and `learn` (su, hidden, K, h, variance, ...) -> (K_next, ...).

    The dots stand for the law's settings and memory. K has the shape (d, 1 + n_L) here.
    """
    features, d = net.description.features, net.d
    su = ca.MX.sym("su", d + (net.pairs - 1) * (d + net.m) + net.m)
    hidden, K = ca.MX.sym("hidden", net.parameters - features * d), ca.MX.sym("K", d, features)
    h, variance = ca.MX.sym("h", d), ca.MX.sym("variance", d)
    settings = {name: ca.MX.sym(name, len(numbers)) for name, numbers in law.settings().items()}
    memory = {name: ca.MX.sym(name, features, features) for name in law.remembers}
    parts = net.split(ca.vertcat(hidden, ca.vec(K)))
    phi = ca.vertcat(1, net.activation(su, parts))
    unit = K @ phi
    error, spread = unit - h / net.output_scale, variance / net.output_scale**2
    after = law.expression(phi, K, error, spread, settings, memory)
    estimate = ca.Function(
        "estimate", [su, hidden, K], [unit * net.output_scale], ["su", "hidden", "K"], ["h_hat"]
    )
    learn = ca.Function(
        "learn",
        [su, hidden, K, h, variance, *settings.values(), *memory.values()],
        [ca.densify(value) for value in after.values()],
        ["su", "hidden", "K", "h", "variance", *settings, *memory],
        [f"{name}_next" for name in after],
    )
    return estimate, learn
