"""The interface of an adaptation law, which updates the last layer after each sample, and two operations on columns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import casadi as ca
import numpy as np

from lbmpc.oracles.base import OracleState


class AdaptationLaw(ABC):
    """The effect of one sample on K, (f, d), and on the law's own memory.

    The arithmetic is an expression, so that it can be compiled together with the features.
    """

    remembers: tuple[str, ...] = ()
    """Names of the symmetric (f, f) arrays that the law stores in an oracle's state beside K."""

    def begin(self, features: int) -> OracleState:
        """Return the law's memory before the first sample for f = `features`."""
        return {}

    @abstractmethod
    def settings(self) -> dict[str, np.ndarray]:
        """Return the law's numbers, (n,) each. They are inputs of the expression, so new values do not recompile it."""

    @abstractmethod
    def expression(
        self,
        phi: ca.MX,
        K: ca.MX,
        error: ca.MX,
        variance: ca.MX,
        settings: Mapping[str, ca.MX],
        memory: Mapping[str, ca.MX],
    ) -> dict[str, ca.MX]:
        """Return K and the law's memory after one sample.

        Args:
            phi: features phi_j(x_t, u_t), (f,), phi[0] = 1.
            K: K_t transposed, (d, f).
            error: xtilde_{t+1} = h_hat_t(x_t, u_t) - h(x_t, u_t), (d,), in the units of K' phi.
            variance: variance of the label, (d,), in those units squared; 0 for an exact label.
            settings: the values of `settings`.
            memory: the values of `remembers`.

        Returns:
            "K", (d, f), and every name of `remembers`.
        """

    def bounded(self, learned: OracleState) -> OracleState:
        """Return the expression's result with each column of "K", (f, d), within its bound."""
        return learned


def project_columns(K: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Scale every column of K, (n, d), whose Euclidean norm exceeds its bound, (d,), back to the bound."""
    norms = np.sqrt((K * K).sum(axis=0))
    # A norm below its bound needs no division, and a norm of zero must not be a divisor.
    return K * np.where(norms > bounds, bounds / np.where(norms > bounds, norms, 1.0), 1.0)


def refit(K: np.ndarray, phi: np.ndarray, h: np.ndarray, ridge: float, bounds: np.ndarray) -> np.ndarray:
    """Fit output weights to n samples under new features, and project them.

        argmin over K'    |phi K' - h|^2 / n + ridge |K' - K|^2

    The ridge keeps directions without samples at their previous value.

    Args:
        K: output weights before, (f, d).
        phi: features of the samples, (n, f).
        h: their labels, (n, d), in the units of K' phi.
        ridge: above 0.
        bounds: Wbar_i, (d,), in the same units.

    Returns:
        (f, d).
    """
    samples, features = phi.shape
    gram = phi.T @ phi / samples + ridge * np.eye(features)
    return project_columns(K + np.linalg.solve(gram, phi.T @ (h - phi @ K) / samples), bounds)
