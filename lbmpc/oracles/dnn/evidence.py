"""How much of what was learned the labels bear out: what it weighs in the prediction where labels are noisy.

    h_hat = weight_1 network(x, u) + weight_2 constant

The constant is the filtered rest h - weight_1 network: the filter of `kalman_law` with one feature, 1. Each weight is
found for each state over the labels so far, newer ones counting more, each label against what was predicted before it
was learned. With e what the part should have predicted, h for the network and the rest for the constant:

    a = sum e p / r,    b = 1 + sum p^2 / r,    weight = (a - sqrt(b)) / b,  between 0 and 1

p is the part's prediction and r the label's variance. a / b is the factor on p that fits the labels best, where it is 0
with a standard deviation of 1 before the first label, and 1 / sqrt(b) its standard deviation. So a part counts by what
is beyond its noise, the constant by what is beyond the network, and where h is smaller than the noise neither does: 0
is the nominal model.
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
    """What is remembered of it is part of an oracle's state."""

    filter: Kalman
    """Of the constant; what it keeps of an earlier label counts for the weights too."""
    output_scale: np.ndarray
    """Its variances are in units of this one squared, (d,)."""
    bound: np.ndarray
    """On the constant, (d,), units of h."""

    def nothing(self) -> OracleState:
        """Before the first label the constant is anything within the output scale: it begins as the labels' mean."""
        d = len(self.output_scale)
        return {"evidence": np.zeros((2, 2, d)), "constant": np.stack([np.zeros(d), self.output_scale**2])}

    def with_label(
        self, state: OracleState, h: np.ndarray, network: np.ndarray, variance: Variance
    ) -> OracleState:
        """What one more label changes, h and what the network predicted of it, (d,)."""
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
    """Of network and constant, (2, d)."""
    a, b = state["evidence"].swapaxes(0, 1)
    b = 1.0 + b
    return np.clip((a - np.sqrt(b)) / b, 0.0, 1.0)


def counting(state: OracleState, K: np.ndarray, output_scale: np.ndarray) -> np.ndarray:
    """Output weights, (1 + n_L, d), scaled, whose network predicts what both parts together do."""
    network, constant = weights(state)
    weighed = K * network
    weighed[0] += constant * state["constant"][0] / output_scale
    return weighed
