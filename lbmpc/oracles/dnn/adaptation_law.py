"""What a law of the fast timescale is: how one sample moves the last layer. And two operations on its columns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import casadi as ca
import numpy as np

from lbmpc.oracles.base import OracleState


class AdaptationLaw(ABC):
    """One sample's effect on K, (f, d), and on what the law remembers beside it.

    Its arithmetic is an expression, so that it can be compiled together with the features.
    """

    remembers: tuple[str, ...] = ()
    """Names of the arrays, (f, f) and symmetric, that an oracle's state holds beside K and that go with it."""

    def begin(self, features: int) -> OracleState:
        """What is remembered before the first sample, for so many features f."""
        return {}

    @abstractmethod
    def settings(self) -> dict[str, np.ndarray]:
        """The law's numbers, (n,) each: inputs of its expression, so that other ones are the same compiled code."""

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
        """K and what is remembered after one sample.

        Args:
            phi: features phi_j(x_t, u_t), (f,), phi[0] = 1.
            K: K_t transposed, (d, f).
            error: xtilde_{t+1} = h_hat_t(x_t, u_t) - h(x_t, u_t), (d,), in the units of K' phi.
            variance: of the label, (d,), in those units squared; 0: it is exact.
            settings: of `settings`.
            memory: of `remembers`.

        Returns:
            "K", (d, f), and every name of `remembers`.
        """

    def bounded(self, learned: OracleState) -> OracleState:
        """What the expression gave, with each column of "K", (f, d), within its bound."""
        return learned


def project_columns(K: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Scale every column of K, (n, d), whose Euclidean norm exceeds its bound, (d,), back onto it."""
    norms = np.sqrt((K * K).sum(axis=0))
    # A norm below its bound needs no division, and zero could not stand one.
    return K * np.where(norms > bounds, bounds / np.where(norms > bounds, norms, 1.0), 1.0)


def refit(K: np.ndarray, phi: np.ndarray, h: np.ndarray, ridge: float, bounds: np.ndarray) -> np.ndarray:
    """The output weights that explain n samples best under new features, then projected.

        argmin over K'    |phi K' - h|^2 / n + ridge |K' - K|^2

    The ridge holds what the samples say nothing about where it was.

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
