"""The contract of an oracle, and the oracle that knows nothing.

An oracle is three things that the controller keeps apart:

* expressions: h_hat(x, u; theta) and its Jacobian, built once, with the parameters theta as an input, so that new
  weights or new samples never rebuild or recompile anything;
* a state: a flat dictionary of arrays, all of its memory, ready for a keyframe;
* a learning rule: what one more sample (x, u, h) does to that state.
"""

from __future__ import annotations

from typing import Protocol

import casadi as ca
import numpy as np

OracleState = dict[str, np.ndarray]


class Oracle(Protocol):
    """h_hat(x, u; theta) for d states and m inputs, in deviation coordinates."""

    name: str
    d: int
    m: int
    parameters: int
    """Length of theta."""

    def split(self, theta: ca.MX) -> list[ca.MX]:
        """theta as the matrices that the expressions use, so that a rollout unpacks it once and not at every stage."""

    def value(self, xu: ca.MX, parts: list[ca.MX]) -> ca.MX:
        """h_hat for n points at once: (d + m, n) -> (d, n)."""

    def jacobian(self, xu: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        """d h_hat / d(x, u) for n points at once: entry k is the derivative along variable k, (d, n)."""

    def initial_state(self, rng: np.random.Generator) -> OracleState: ...

    def theta(self, state: OracleState) -> np.ndarray:
        """The parameters that this state stands for, (parameters,)."""

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """h_hat(x, u) of this state, (d,)."""

    def learn(self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray) -> OracleState:
        """The state after one labelled sample; the state given is left as it was."""


def function(oracle: Oracle) -> ca.Function:
    """(x, u, theta) -> (h_hat (d,), Jacobian (d, d + m)) as a CasADi function; for tests and for `estimate`."""
    x, u = ca.MX.sym("x", oracle.d), ca.MX.sym("u", oracle.m)
    theta = ca.MX.sym("theta", oracle.parameters)
    xu = ca.vertcat(x, u)
    parts = oracle.split(theta)
    columns = ca.horzcat(*oracle.jacobian(xu, parts))
    return ca.Function(
        "oracle", [x, u, theta], [oracle.value(xu, parts), columns], ["x", "u", "theta"], ["h", "J"]
    )


class LinearOracle:
    """h_hat = 0: plain linear MPC."""

    name = "linear"
    parameters = 0

    def __init__(self, d: int, m: int):
        self.d, self.m = d, m

    def split(self, theta: ca.MX) -> list[ca.MX]:
        return []

    def value(self, xu: ca.MX, parts: list[ca.MX]) -> ca.MX:
        return ca.MX.zeros(self.d, xu.shape[1])

    def jacobian(self, xu: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        return [ca.MX.zeros(self.d, xu.shape[1]) for _ in range(self.d + self.m)]

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        return {}

    def theta(self, state: OracleState) -> np.ndarray:
        return np.zeros(0)

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.zeros(self.d)

    def learn(self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray) -> OracleState:
        return state
