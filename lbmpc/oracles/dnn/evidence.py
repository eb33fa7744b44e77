"""How much of h_hat the labels bear out: what it weighs in the prediction where labels are noisy.

For each state, over the labels so far, newer ones counting more, each against what was predicted before it was learned:

    a = sum h h_hat / r,    b = sum h_hat^2 / r,    weight = (a - sqrt(b)) / b,  between 0 and 1

r is the label's variance. a / b is the factor on h_hat that would have fitted the labels best, and 1 / sqrt(b) its
standard deviation. So h_hat counts by what is beyond its noise, and where h is smaller than the noise by nothing:
0 is the nominal model.
"""

from __future__ import annotations

import numpy as np

from lbmpc.oracles.base import OracleState, Variance

TINY = 1e-300


def nothing(d: int) -> OracleState:
    """Before the first label."""
    return {"evidence": np.zeros((2, d))}


def with_label(
    state: OracleState, h: np.ndarray, h_hat: np.ndarray, variance: Variance, kept: float
) -> OracleState:
    """What one more label changes, h and what was predicted of it, (d,); `kept`: what earlier ones still count."""
    return {"evidence": kept * state["evidence"] + np.stack([h * h_hat, h_hat**2]) / (variance + TINY)}


def weight(state: OracleState) -> np.ndarray:
    """(d,)."""
    a, b = state["evidence"]
    return np.clip((a - np.sqrt(b)) / (b + TINY), 0.0, 1.0)
