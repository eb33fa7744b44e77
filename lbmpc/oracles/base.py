"""The interface of an oracle.

An oracle has three parts that the controller keeps separate:

* expressions: h_hat(x, u; theta) and its Jacobian. They are built once with the parameters theta as an input, so new
  weights or samples never rebuild or recompile anything.
* a state: a flat dictionary of arrays, which is its complete memory and can be stored in a keyframe.
* a learning rule: the effect of one more sample (x, u, h) on that state.

An oracle may use a window: h_hat then depends on the last k pairs (x, u), including the present one. The solver adds
the k - 1 earlier pairs to the state that it predicts,

    s = (x, p_{-(k-1)}, ..., p_{-1}),    s+ = (x+, p_{-(k-2)}, ..., p_{-1}, (x, u)),

a shift register, which makes the prediction Markov again. Without a window s is x.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np

from network_model.description import NetworkDescription

OracleState = dict[str, np.ndarray]
Variance = np.ndarray | float
"""Variance of a label, (d,), or one number for all states; 0 for an exact label."""
Realise = Callable[[ca.Function], ca.Function]
"""Turns a CasADi function into the function that is called, for example by compiling it."""


@dataclass(frozen=True, eq=False)
class HiddenSet:
    """An offered set of trained hidden layers."""

    version: int
    layers: list[np.ndarray]
    sha256: str
    """SHA-256 of the layers."""
    network_sha256: str
    """SHA-256 of the description that they were trained for."""
    later: int | None = None
    """Upper bound on the number of samples after the newest training sample; None if it is not known."""


class Verdict(NamedTuple):
    """The decision on offered hidden layers."""

    outcome: Literal["none", "adopted", "refused"]
    """`none` means that no layers were offered."""
    reason: str = ""
    """Reason for a refusal."""


class LearnedNetwork(NamedTuple):
    """The network that an oracle's state represents."""

    hidden: list[np.ndarray]
    """W_1..W_{L-1}, the bias of each as its first row."""
    K: np.ndarray
    """Output weights, (1 + n_L, d), scaled."""
    version: int
    """Version of the hidden layers in use."""
    newest: int
    """The highest version adopted so far."""


class Oracle(ABC):
    """h_hat(s, u; theta) for d states and m inputs, in deviation coordinates.

    The defaults below fit an oracle that uses only the present pair and has no hidden layers.
    """

    name: str
    d: int
    m: int
    parameters: int
    """Length of theta."""
    pairs: int = 1
    """k, the number of pairs (x, u) in the window; s has D = d + (k - 1) (d + m) entries."""
    description: NetworkDescription | None = None
    """The network whose hidden layers a trainer may send; None for an oracle without one."""

    # -- expressions ---------------------------------------------------------------------------------------------

    @abstractmethod
    def split(self, theta: ca.MX) -> list[ca.MX]:
        """Return theta as the matrices of the expressions, so that a rollout unpacks it once instead of per stage."""

    @abstractmethod
    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        """Return h_hat for n points (s, u) at once: (D + m, n) -> (d, n)."""

    @abstractmethod
    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        """Return d h_hat / d(s, u) for n points (s, u) at once, (D + m, n): one matrix (d, D + m) per point."""

    # -- state and learning --------------------------------------------------------------------------------------

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        """Return the memory before the first sample."""
        return {}

    def begin(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> OracleState:
        """Return the state for an unknown past: the plant is assumed to have been at x under the input u."""
        return state

    def past(self, state: OracleState) -> np.ndarray:
        """Return the k - 1 pairs before the present one, (k - 1, d + m), oldest first."""
        return np.zeros((0, self.d + self.m))

    def theta(self, state: OracleState) -> np.ndarray:
        """Return the parameters of this state, (parameters,)."""
        return np.zeros(0)

    @abstractmethod
    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return h_hat(x, u) of this state with its past, (d,)."""

    def learn(
        self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray, variance: Variance = 0.0
    ) -> OracleState:
        """Return the state after one labelled sample, with (x, u) in its past; `state` is not modified.

        variance: variance of h.
        """
        return state

    def weights(self, state: OracleState) -> np.ndarray:
        """Return the weight of each part of h_hat in the prediction, (parts, d), 0 to 1; no rows without weights."""
        return np.zeros((0, self.d))

    def passed(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> OracleState:
        """Return the state with (x, u) as the last pair of its past, without learning."""
        return state

    def told(self, state: OracleState, truth: Mapping[str, float]) -> OracleState:
        """Return the state after an experiment changed the true plant's parameters, given by name.

        Only the oracle `perfect` uses this.
        """
        return state

    # -- hidden layers of a trainer ------------------------------------------------------------------------------

    def compile(self, realise: Realise) -> None:  # noqa: B027  (a default that does nothing)
        """Replace the functions that every tick calls by `realise` of them, for example compiled ones."""

    def adopt(self, state: OracleState, offered: HiddenSet) -> tuple[OracleState, Verdict]:
        """Adopt a set of hidden layers or refuse it. A refusal leaves the network unchanged."""
        return state, Verdict("refused", f"the oracle {self.name} has no hidden layers")

    def confirm(self, state: OracleState) -> tuple[OracleState, str]:
        """Check after a new sample whether the last adopted set is as good as its trial predicted.

        Returns:
            The state and "", or the state with the previous network and the reason.
        """
        return state, ""

    def network(self, state: OracleState) -> LearnedNetwork | None:
        """Return the network of this state; None without one."""
        return None


def remembered(oracle: Oracle) -> int:
    """Return the number of entries of s behind x, (k - 1) (d + m)."""
    return (oracle.pairs - 1) * (oracle.d + oracle.m)


def follow(s: np.ndarray, u: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return s+ (D,) from s (D,), the input u (m,) and x+ = `after` (d,)."""
    d = len(after)
    if len(s) == d:
        return after
    return np.concatenate([after, s[2 * d + len(u) :], s[:d], u])


def follow_symbols(s: ca.MX, u: ca.MX, after: ca.MX) -> ca.MX:
    """Do the same as `follow` with CasADi expressions."""
    d, m = after.shape[0], u.shape[0]
    if s.shape[0] == d:
        return after
    return ca.vertcat(after, s[2 * d + m :], s[:d], u)


def by_point(slopes: list[ca.MX]) -> list[ca.MX]:
    """Convert the slopes of n points along each variable, (d, n) each, to one Jacobian per point."""
    return [ca.horzcat(*columns) for columns in zip(*(ca.horzsplit(slope) for slope in slopes), strict=True)]
