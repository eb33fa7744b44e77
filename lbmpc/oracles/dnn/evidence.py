"""Weights of the learned parts in the prediction, according to how well noisy labels confirm them.

    h_hat = weight_1 network(x, u) + weight_2 constant

The constant is the filtered remainder h - weight_1 network. Its filter is that of `kalman_law` with the single feature
1. Each weight is estimated for each state from all labels so far, with newer ones counting more. Each label is compared
with the prediction made before it was learned. With e the value that a part should have predicted (h for the network,
the remainder for the constant):

    a = sum e p / r,    b = 1 + sum p^2 / r,    weight = (a - sqrt(b)) / b,  between 0 and 1

p is the part's prediction and r is the label's variance. a / b is the factor on p that fits the labels best, with a
prior of mean 0 and standard deviation 1, and 1 / sqrt(b) is its standard deviation. The network thus counts as far as
it exceeds its noise, and the constant as far as it exceeds the network. If h is smaller than the noise, both weights
are 0, which is the nominal model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.oracles.base import OracleState, Variance
from lbmpc.oracles.dnn.kalman_law import Kalman

TINY = 1e-300
NETWORK, CONSTANT = 0, 1


@dataclass(frozen=True, eq=False)
class Evidence:
    """Updates the weights and the constant. Its memory is part of an oracle's state."""

    filter: Kalman
    """Filter of the constant. Its forgetting factor also applies to the weights."""
    output_scale: np.ndarray
    """The variances are in units of the square of this scale, (d,)."""
    bound: np.ndarray
    """Bound on the constant, (d,), units of h."""

    def nothing(self) -> OracleState:
        """Return the memory before the first label. With the output scale as prior, the constant starts as a mean."""
        d = len(self.output_scale)
        return {"evidence": np.zeros((2, 2, d)), "constant": np.stack([np.zeros(d), self.output_scale**2])}

    def with_label(
        self, state: OracleState, h: np.ndarray, network: np.ndarray, variance: Variance
    ) -> OracleState:
        """Return the changes after one more label h, given the network's prediction of it, (d,)."""
        constant, spread = state["constant"]
        rest = h - weights(state)[NETWORK] * network
        wanted, predicted = np.stack([h, rest]), np.stack([network, constant])
        sums = np.stack([wanted * predicted, predicted**2], axis=1) / (variance + TINY)
        kept, units = self.filter.kept, self.output_scale**2
        gain = spread / (spread + variance + self.filter.label_variance * units)
        followed = np.clip(constant + gain * (rest - constant), -self.bound, self.bound)
        faded = (1.0 - kept) * self.filter.prior_variance * units
        return {
            "evidence": kept * state["evidence"] + sums,
            "constant": np.stack([followed, kept * (1.0 - gain) * spread + faded]),
        }


def weights(state: OracleState) -> np.ndarray:
    """Return the weights of network and constant, (2, d)."""
    a, b = state["evidence"].swapaxes(0, 1)
    b = 1.0 + b
    return np.clip((a - np.sqrt(b)) / b, 0.0, 1.0)


def counting(state: OracleState, K: np.ndarray, output_scale: np.ndarray) -> np.ndarray:
    """Return scaled output weights, (1 + n_L, d), of a network that predicts the weighted sum of both parts."""
    network, constant = weights(state)
    weighed = K * network
    weighed[0] += constant * state["constant"][0] / output_scale
    return weighed
