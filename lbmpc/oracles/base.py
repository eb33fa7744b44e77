"""The contract of an oracle.

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

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np

from network_model.description import NetworkDescription

OracleState = dict[str, np.ndarray]
Variance = np.ndarray | float
"""Of a label, (d,), or one for all states; 0 where it is exact."""
Realise = Callable[[ca.Function], ca.Function]
"""Turns a CasADi function into the one that is called, a compiler for instance."""


@dataclass(frozen=True, eq=False)
class HiddenSet:
    """A trained set of hidden layers on offer."""

    version: int
    layers: list[np.ndarray]
    sha256: str
    """Of the layers."""
    network_sha256: str
    """Of the description that they were trained for."""
    later: int | None = None
    """Samples, at most, since the newest that had a part in the training; None: nobody says."""


class Verdict(NamedTuple):
    """What became of the hidden layers on offer."""

    outcome: Literal["none", "adopted", "refused"]
    """none: there were none."""
    reason: str = ""
    """Why they were refused."""


class LearnedNetwork(NamedTuple):
    """The network that an oracle's state stands for."""

    hidden: list[np.ndarray]
    """W_1..W_{L-1}, the bias of each as its first row."""
    K: np.ndarray
    """Output weights, (1 + n_L, d), scaled."""
    version: int
    """Of the hidden layers in use."""
    newest: int
    """The highest version that was ever adopted."""


class Oracle(ABC):
    """h_hat(s, u; theta) for d states and m inputs, in deviation coordinates.

    The defaults below are those of an oracle that sees the present pair alone and has no hidden layers.
    """

    name: str
    d: int
    m: int
    parameters: int
    """Length of theta."""
    pairs: int = 1
    """k, the pairs (x, u) that it sees, 1 when only the present one; s has d + (k - 1) (d + m) entries, here D."""
    description: NetworkDescription | None = None
    """The network whose hidden layers a trainer may send; None: it has none."""

    # -- expressions ---------------------------------------------------------------------------------------------

    @abstractmethod
    def split(self, theta: ca.MX) -> list[ca.MX]:
        """theta as the matrices that the expressions use, so that a rollout unpacks it once and not at every stage."""

    @abstractmethod
    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        """h_hat for n points (s, u) at once: (D + m, n) -> (d, n)."""

    @abstractmethod
    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        """d h_hat / d(s, u) for n points (s, u) at once, (D + m, n): one matrix (d, D + m) for each point."""

    # -- state and learning --------------------------------------------------------------------------------------

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        """The memory before the first sample."""
        return {}

    def begin(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> OracleState:
        """The state when what came before x is not known: as if the plant had stood at x under the input u."""
        return state

    def past(self, state: OracleState) -> np.ndarray:
        """The k - 1 pairs before the present one, (k - 1, d + m), oldest first."""
        return np.zeros((0, self.d + self.m))

    def theta(self, state: OracleState) -> np.ndarray:
        """The parameters that this state stands for, (parameters,)."""
        return np.zeros(0)

    @abstractmethod
    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """h_hat(x, u) of this state, with the past that it remembers, (d,)."""

    def learn(
        self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray, variance: Variance = 0.0
    ) -> OracleState:
        """The state after one labelled sample, (x, u) now in its past; the state given is left as it was.

        variance: of h.
        """
        return state

    def weights(self, state: OracleState) -> np.ndarray:
        """What of each part of h_hat counts in the prediction, (parts, d), 0 to 1; of no part where labels say nothing
        of it."""
        return np.zeros((0, self.d))

    def passed(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> OracleState:
        """The state with (x, u) as the last pair of its past, of which nothing is learned."""
        return state

    def told(self, state: OracleState, truth: Mapping[str, float]) -> OracleState:
        """The state once an experiment has said what the true plant's parameters are from now on, by name.

        Only `perfect` listens: whoever learns is told nothing.
        """
        return state

    # -- hidden layers of a trainer ------------------------------------------------------------------------------

    def compile(self, realise: Realise) -> None:  # noqa: B027  (a default that does nothing)
        """Let `realise` turn what every tick calls into something faster."""

    def adopt(self, state: OracleState, offered: HiddenSet) -> tuple[OracleState, Verdict]:
        """Swap in a set of hidden layers, or refuse it; a refusal leaves the network as it was."""
        return state, Verdict("refused", f"the oracle {self.name} has no hidden layers")

    def confirm(self, state: OracleState) -> tuple[OracleState, str]:
        """After a sample was learned: whether the set that was adopted last holds what it promised.

        Returns:
            The state and "", or the state with the network from before, and a text that says why.
        """
        return state, ""

    def network(self, state: OracleState) -> LearnedNetwork | None:
        """The network of this state; None without one."""
        return None


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
