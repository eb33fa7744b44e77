"""The contract of an oracle, and the oracle that knows nothing.

An oracle is three things that the controller keeps apart:

* expressions: h_hat(x, u; theta) and its Jacobian, built once, with the parameters theta as an input, so that new
  weights or new samples never rebuild or recompile anything;
* a state: a flat dictionary of arrays, all of its memory, ready for a keyframe;
* a learning rule: what one more sample (x, u, h) does to that state.

An oracle may look back: h_hat then depends on the last k pairs (x, u), the present one included. The solver makes
the k - 1 pairs before the present one part of the state that it predicts,

    s = (x, p_{-(k-1)}, ..., p_{-1}),    s+ = (x+, p_{-(k-2)}, ..., p_{-1}, (x, u)),

a shift register, so that the prediction is Markov again. Without a look back s is x.
"""

from __future__ import annotations

from typing import Protocol

import casadi as ca
import numpy as np

OracleState = dict[str, np.ndarray]


class Oracle(Protocol):
    """h_hat(s, u; theta) for d states and m inputs, in deviation coordinates."""

    name: str
    d: int
    m: int
    parameters: int
    """Length of theta."""
    pairs: int
    """k, the pairs (x, u) that it sees, 1 when only the present one; s has d + (k - 1) (d + m) entries, here D."""

    def split(self, theta: ca.MX) -> list[ca.MX]:
        """theta as the matrices that the expressions use, so that a rollout unpacks it once and not at every stage."""

    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        """h_hat for n points (s, u) at once: (D + m, n) -> (d, n)."""

    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        """d h_hat / d(s, u) for n points (s, u) at once, (D + m, n): one matrix (d, D + m) for each point."""

    def initial_state(self, rng: np.random.Generator) -> OracleState: ...

    def begin(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> OracleState:
        """The state when what came before x is not known: as if the plant had stood at x under the input u."""

    def past(self, state: OracleState) -> np.ndarray:
        """The k - 1 pairs before the present one, (k - 1, d + m), oldest first."""

    def theta(self, state: OracleState) -> np.ndarray:
        """The parameters that this state stands for, (parameters,)."""

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """h_hat(x, u) of this state, with the past that it remembers, (d,)."""

    def learn(self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray) -> OracleState:
        """The state after one labelled sample, (x, u) now in its past; the state given is left as it was."""


def remembered(oracle: Oracle) -> int:
    """Entries of s behind x, (k - 1) (d + m)."""
    return (oracle.pairs - 1) * (oracle.d + oracle.m)


def follow(s: np.ndarray, u: np.ndarray, after: np.ndarray) -> np.ndarray:
    """s+ (D,) from s (D,), the input u (m,) and x+ = `after` (d,)."""
    d = len(after)
    if len(s) == d:
        return after
    return np.concatenate([after, s[2 * d + len(u) :], s[:d], u])


def follow_symbols(s: ca.MX, u: ca.MX, after: ca.MX) -> ca.MX:
    """`follow` for CasADi."""
    d, m = after.shape[0], u.shape[0]
    if s.shape[0] == d:
        return after
    return ca.vertcat(after, s[2 * d + m :], s[:d], u)


def by_point(slopes: list[ca.MX]) -> list[ca.MX]:
    """From the slopes of n points along each variable, (d, n) each, to the Jacobian of each point."""
    return [ca.horzcat(*columns) for columns in zip(*(ca.horzsplit(slope) for slope in slopes), strict=True)]


def function(oracle: Oracle) -> ca.Function:
    """(s, u, theta) -> (h_hat (d,), Jacobian (d, D + m)) as a CasADi function, for tests."""
    s, u = ca.MX.sym("s", oracle.d + remembered(oracle)), ca.MX.sym("u", oracle.m)
    theta = ca.MX.sym("theta", oracle.parameters)
    su = ca.vertcat(s, u)
    parts = oracle.split(theta)
    (jacobian,) = oracle.jacobians(su, parts)
    return ca.Function(
        "oracle", [s, u, theta], [oracle.value(su, parts), jacobian], ["s", "u", "theta"], ["h", "J"]
    )


class Memoryless:
    """What the contract asks for where h_hat depends on the present pair alone."""

    d: int
    m: int
    pairs: int = 1

    def begin(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> OracleState:
        return state

    def past(self, state: OracleState) -> np.ndarray:
        return np.zeros((0, self.d + self.m))


class LinearOracle(Memoryless):
    """h_hat = 0: plain linear MPC. `pairs` > 1 stands in for an oracle with a past, which it disregards."""

    name = "linear"
    parameters = 0

    def __init__(self, d: int, m: int, pairs: int = 1):
        self.d, self.m, self.pairs = d, m, pairs

    def split(self, theta: ca.MX) -> list[ca.MX]:
        return []

    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        return ca.MX.zeros(self.d, su.shape[1])

    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        return by_point([ca.MX.zeros(self.d, su.shape[1]) for _ in range(su.shape[0])])

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        return {}

    def theta(self, state: OracleState) -> np.ndarray:
        return np.zeros(0)

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.zeros(self.d)

    def learn(self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray) -> OracleState:
        return state
