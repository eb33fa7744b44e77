"""The network's two calls in every tick beside the solver's, as CasADi functions: estimate h, and learn one sample.

They could be compiled, and then cost a fifth of what numpy takes for so few numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import is_

import casadi as ca
import numpy as np

from lbmpc.casadi_buffers import Bound
from lbmpc.oracles.base import Realise
from lbmpc.oracles.dnn.expressions import NetworkExpressions


class LastLayer:
    """h_hat = s * K' phi and the law of `lbmpc.oracles.dnn.adaptation_law`, on arrays that stay in place.

    Args:
        net: the network.
        gamma: learning rate.
        bounds: Wbar_i, (d,), scaled.
        realise: may compile the functions.
    """

    def __init__(self, net: NetworkExpressions, gamma: float, bounds: np.ndarray, realise: Realise):
        estimate, learn = build_last_layer(net)
        self._estimate, self._learn = Bound(realise(estimate)), Bound(realise(learn))
        self._learn.inputs["gamma"][0, 0] = gamma
        self._learn.inputs["bounds"][:, 0] = bounds
        self._hidden: Sequence[np.ndarray] = ()

    def estimate(
        self, hidden: Sequence[np.ndarray], K: np.ndarray, x: np.ndarray, past: np.ndarray, u: np.ndarray
    ) -> np.ndarray:
        """h_hat, (d,), in units of h, at x (d,) and u (m,), after the pairs `past`, ((k - 1) (d + m),)."""
        self._load(self._estimate, hidden, K, x, past, u)
        self._estimate()
        return self._estimate.outputs["h_hat"][:, 0].copy()

    def learn(
        self,
        hidden: Sequence[np.ndarray],
        K: np.ndarray,
        x: np.ndarray,
        past: np.ndarray,
        u: np.ndarray,
        h: np.ndarray,
    ) -> np.ndarray:
        """K_{t+1}, (1 + n_L, d), after the label h (d,) of the same."""
        self._load(self._learn, hidden, K, x, past, u)
        self._learn.inputs["h"][:, 0] = h
        self._learn()
        return self._learn.outputs["K_next"].T.copy()

    def _load(
        self,
        bound: Bound,
        hidden: Sequence[np.ndarray],
        K: np.ndarray,
        x: np.ndarray,
        past: np.ndarray,
        u: np.ndarray,
    ) -> None:
        # They change at an adoption and are never written to, so the same arrays are the same numbers.
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


def build_last_layer(net: NetworkExpressions) -> tuple[ca.Function, ca.Function]:
    """`estimate` (su, hidden, K) -> h_hat and `learn` (su, hidden, K, h, gamma, bounds) -> K_next, K (d, 1 + n_L)."""
    features, d = net.description.features, net.d
    su = ca.MX.sym("su", d + (net.pairs - 1) * (d + net.m) + net.m)
    hidden, K = ca.MX.sym("hidden", net.parameters - features * d), ca.MX.sym("K", d, features)
    h, gamma, bounds = ca.MX.sym("h", d), ca.MX.sym("gamma"), ca.MX.sym("bounds", d)
    parts = net.split(ca.vertcat(hidden, ca.vec(K)))
    phi = ca.vertcat(1, net.activation(su, parts))
    unit = K @ phi
    error = unit - h / net.output_scale
    moved = K - (gamma / ca.dot(phi, phi)) * (error @ phi.T)
    norms = ca.sqrt(ca.sum2(moved * moved))
    # bounds / bounds is 1 exactly, so what keeps its bound is not touched.
    kept = moved * ca.repmat(bounds / ca.fmax(norms, bounds), 1, features)
    estimate = ca.Function(
        "estimate", [su, hidden, K], [unit * net.output_scale], ["su", "hidden", "K"], ["h_hat"]
    )
    names = ["su", "hidden", "K", "h", "gamma", "bounds"]
    learn = ca.Function("learn", [su, hidden, K, h, gamma, bounds], [ca.densify(kept)], names, ["K_next"])
    return estimate, learn
