"""The deep network: hidden layers from the trainer, last layer adapted at every sample.

    h_hat(x, u) = s * K' phi_j(x, u),    phi_j = (1, psi_L[W_{L-1}' (1, psi_{L-1}[ ... (1, (x, u) / scale)])])

(e:NN_structure), or another architecture on a window of the last k pairs. `network_model.description` describes it; the
trainer builds the same function in torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from lbmpc.oracles import base
from lbmpc.oracles.base import OracleState
from lbmpc.oracles.dnn import rollback
from lbmpc.oracles.dnn.adaptation_law import project_columns, refit
from lbmpc.oracles.dnn.backends import ACTIVATIONS, Numbers, Symbols
from lbmpc.oracles.dnn.last_layer import LastLayer, Realise
from lbmpc.oracles.dnn.trial import Finding, Trial, empty, had, newest, only, remember, tried
from network_model.description import NetworkDescription, hash_layers, initial_hidden, why_unacceptable
from network_model.operations import get_architecture

SYMBOLS, NUMBERS = Symbols(), Numbers()
Start = Literal["random", "zero", "pretrained"]
"""K_0: drawn with `initial_scale`; all zero; or drawn, then fitted to h = 0, the middle of W, all over X x U."""
PRETRAINING, PRETRAINING_RIDGE = 2000, 1e-4
IN_USE, NEWEST = 0, 1
"""Entries of `version`: that of the hidden layers in use, and the highest that was ever adopted."""
LEAP = 10**9
"""By which a version may rise at once: after the largest number that there is nobody's weights would be newer."""
NOTHING = np.zeros(0)
Network = tuple[list[np.ndarray], np.ndarray]
"""W_1..W_{L-1} and K."""


@dataclass(frozen=True)
class Refit:
    """At an adoption K is fitted to the newest samples under the new features; see `adaptation_law.refit`."""

    window: int
    """Samples remembered for it."""
    ridge: float


class DnnOracle:
    """A bounded network h_hat whose hidden weights and output weights are parameters.

    Args:
        description: sizes, activations and scaling.
        gamma: learning rate of the last layer; 0: it stays as it is.
        column_bound: Wbar_i, in units of h.
        initial_scale: standard deviation of the entries of K_0, in units of h.
        start: how K_0 comes about.
        refit: what happens to K when hidden layers are adopted; None: it is kept.
        trial: what hidden layers must show before and after they are adopted; None: nothing.
    """

    name = "dnn"

    def __init__(
        self,
        description: NetworkDescription,
        gamma: float = 0.5,
        column_bound: float = 0.05,
        initial_scale: float = 1e-3,
        start: Start = "random",
        refit: Refit | None = None,
        trial: Trial | None = None,
    ):
        self.description = description
        self.d, self.m = description.states, description.inputs
        self.gamma = gamma
        self.output_scale = np.array(description.output_scale)
        self.input_scale = np.array(description.input_scale)
        self.bounds = column_bound / self.output_scale
        self.initial_scale, self.start, self.refit, self.trial = initial_scale, start, refit, trial
        self.shapes = [*description.layer_shapes, (description.features, self.d)]
        self.parameters = sum(rows * columns for rows, columns in self.shapes)
        self.pairs = description.window
        self._architecture, self._sizes = get_architecture(description.architecture), description.sizes
        self._dense = description.architecture == "mlp" and self.pairs == 1
        self._hidden = [f"W{i + 1}" for i in range(len(self.shapes) - 1)]
        self._last_layer: LastLayer | None = None

    # -- expressions ---------------------------------------------------------------------------------------------

    def split(self, theta: ca.MX) -> list[ca.MX]:
        parts, start = [], 0
        for rows, columns in self.shapes:
            # theta holds each matrix row by row, CasADi reshapes column by column: this is W', biases first.
            transposed = ca.reshape(theta[start : start + rows * columns], columns, rows)
            parts += [transposed[:, 0], transposed[:, 1:]]
            start += rows * columns
        return parts

    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        return SYMBOLS.affine((parts[-2], parts[-1]), self.activation(su, parts)) * self.output_scale

    def activation(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        """phi without its leading 1, (n_L, n), of n points (s, u) at once, (D + m, n)."""
        layers = list(zip(parts[:-2:2], parts[1:-2:2], strict=True))
        return self._architecture.forward(SYMBOLS, self._sizes, layers, self._window(su))

    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        return self._forward_mode(su, parts) if self._dense else self._reverse_mode(su, parts)

    def _window(self, su: ca.MX) -> list[ca.MX]:
        """The network's input pair by pair, scaled, from points (s, u), (D + m, n)."""
        start = self.d + base.remembered(self)
        ordered = ca.vertcat(su[self.d : start, :], su[: self.d, :], su[start:, :]) if self.pairs > 1 else su
        scaled = ordered / np.tile(self.input_scale, self.pairs)
        return ca.vertsplit(scaled, self.d + self.m) if self.pairs > 1 else [scaled]

    def _reverse_mode(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        """Any architecture: one sweep back for each entry of h_hat, for all points at once."""
        rows, points = su.shape
        symbols = [ca.MX.sym("su", rows, points), *(ca.MX.sym("part", *part.shape) for part in parts)]
        h = self.value(symbols[0], symbols[1:])
        seeds = [ca.DM(np.outer(row, np.ones(points))) for row in np.eye(self.d)]
        swept = ca.vertcat(*(ca.jtimes(h, symbols[0], seed, True) for seed in seeds))
        gradients = ca.Function("gradients", symbols, [swept])(su, *parts)
        return [ca.reshape(column, rows, self.d).T for column in ca.horzsplit(gradients)]

    def _forward_mode(self, xu: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        """Dense layers on one pair, where (x, u) is hardly longer than h: the fewest products of all."""
        points, variables = xu.shape[1], self.d + self.m
        activation = xu / self.input_scale
        # All directions and all points side by side: each layer is one matrix product.
        tangent: ca.MX | None = None
        psis = [ACTIVATIONS[name] for name in self.description.activations]
        for bias, weights, psi in zip(parts[:-2:2], parts[1:-2:2], psis, strict=True):
            total = SYMBOLS.affine((bias, weights), activation)
            activation = psi.value(total)
            slope = psi.slope(total, activation)
            if tangent is None:
                directions = weights / ca.repmat(ca.DM(self.input_scale).T, weights.shape[0], 1)
                tangent = ca.horzcat(*(ca.repmat(directions[:, i], 1, points) for i in range(variables)))
            else:
                tangent = weights @ tangent
            tangent = tangent * ca.repmat(slope, 1, variables)
        return base.by_point(ca.horzsplit(parts[-1] @ tangent * self.output_scale, points))

    def function(self) -> ca.Function:
        """(s, u, theta) -> h_hat and Jacobian."""
        return base.function(self)

    # -- state ---------------------------------------------------------------------------------------------------

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        hidden = initial_hidden(self.description, rng)
        state = {f"W{i + 1}": layer for i, layer in enumerate(hidden)}
        state["K"] = self._first_K(hidden, rng)
        state["version"] = np.zeros(2, dtype=np.int64)
        if self.pairs > 1:
            state["past"] = np.zeros((self.pairs - 1, self.d + self.m))
        if self.refit is not None:
            state["samples"] = np.zeros((self.refit.window, self.pairs * (self.d + self.m) + self.d))
            state["sampled"] = np.zeros(1, dtype=np.int64)
        if self.trial is not None:
            state |= empty(self.trial, self.pairs * (self.d + self.m) + self.d)
            state |= rollback.nothing(self.hidden(state), state["K"]) | only(hash_layers(hidden))
        return state

    def _first_K(self, hidden: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """K_0, scaled, (1 + n_L, d)."""
        drawn = rng.standard_normal(self.shapes[-1]) * (self.initial_scale / self.output_scale)
        if self.start == "zero":
            return np.zeros_like(drawn)
        if self.start == "random":
            return project_columns(drawn, self.bounds)
        shape = (PRETRAINING, self.pairs, self.d + self.m)
        phi = self.features_of(hidden, rng.uniform(-1.0, 1.0, shape) * self.input_scale)
        return refit(drawn, phi, np.zeros((PRETRAINING, self.d)), PRETRAINING_RIDGE, self.bounds)

    def begin(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> OracleState:
        if self.pairs == 1:
            return state
        return {**state, "past": np.tile(np.concatenate([x, u]), (self.pairs - 1, 1))}

    def past(self, state: OracleState) -> np.ndarray:
        return state["past"] if self.pairs > 1 else np.zeros((0, self.d + self.m))

    def hidden(self, state: OracleState) -> list[np.ndarray]:
        """W_1..W_{L-1}."""
        return [state[name] for name in self._hidden]

    def pack(self, hidden: list[np.ndarray], K: np.ndarray) -> np.ndarray:
        """theta from hidden layers and scaled output weights K, (1 + n_L, d)."""
        return np.concatenate([matrix.ravel() for matrix in (*hidden, K)])

    def theta(self, state: OracleState) -> np.ndarray:
        return self.pack(self.hidden(state), state["K"])

    def features(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """phi_j(x, u) with the past in this state, (1 + n_L,), with phi[0] = 1."""
        return self.features_of(self.hidden(state), np.vstack([self.past(state), np.concatenate([x, u])]))

    def features_of(self, hidden: Sequence[np.ndarray], window: np.ndarray) -> np.ndarray:
        """phi of a window, (k, d + m), oldest pair first, under hidden layers; or of many, (points, k, d + m)."""
        pairs = list(np.moveaxis(window / self.input_scale, -2, 0))
        activation = self._architecture.forward(NUMBERS, self._sizes, hidden, pairs)
        return np.concatenate([np.ones((*activation.shape[:-1], 1)), activation], axis=-1)

    def compile(self, realise: Realise) -> None:
        """Let `realise` turn what every tick calls into something faster; the virtual machine runs it otherwise."""
        self._last_layer = LastLayer(self, realise)

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return self._every_tick().estimate(self.hidden(state), state["K"], x, self._before(state), u)

    def learn(self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray) -> OracleState:
        before = self._before(state)
        K = self._every_tick().learn(self.hidden(state), state["K"], x, before, u, h)
        learned = {**state, "K": K}
        if self.pairs > 1:
            learned["past"] = np.vstack([state["past"][1:], np.concatenate([x, u])])
        if self.refit is not None or self.trial is not None:
            parts = (before, x, u, h / self.output_scale)
            if self.refit is not None:
                number = int(state["sampled"][0])
                learned["samples"] = state["samples"].copy()
                learned["samples"][number % self.refit.window] = np.concatenate(parts)
                learned["sampled"] = np.array([number + 1], dtype=np.int64)
            if self.trial is not None:
                learned |= remember(self.trial, state, *parts)
        return learned

    def adopt(
        self, state: OracleState, version: int, layers: list[np.ndarray], sha256: str, network_sha256: str
    ) -> tuple[OracleState, str]:
        """Swap in a new set of hidden weights; K is kept, or refitted to the samples remembered.

        Returns:
            The state and "adopted", or the state as it was, but for the memory of trials, and "refused: <reason>".
        """
        known = int(state["version"][NEWEST])
        if version <= known:
            return state, f"refused: version {version} is not newer than {known}"
        if version > known + LEAP:
            return state, f"refused: version {version} leaps too far ahead of {known}"
        if network_sha256 != self.description.sha256():
            return state, "refused: trained for another network description"
        reason = why_unacceptable(self.description, layers)
        if reason is not None:
            return state, f"refused: {reason}"
        if hash_layers(layers) != sha256:
            return state, "refused: sha256 does not match the layers"
        # What the hash is of.
        hidden = [layer.astype(np.float32).astype(float) for layer in layers]
        K = self._K_under(hidden, state)
        watched: OracleState = {}
        if self.trial is not None:
            samples = newest(self.trial, state)
            if len(samples) < self.trial.least:
                return state, f"refused: trial: {len(samples)} samples so far, {self.trial.least} are needed"
            if tried(state, sha256):
                return state, "refused: stale: these layers were in use or on trial before"
            state = {**state, **had(state, sha256)}
            found = self._compare(samples, (hidden, K), (self.hidden(state), state["K"]))
            if self.trial.refuses(found):
                return state, f"refused: trial: {found}"
            watched = rollback.adopted(self.trial, state, self.hidden(state), K)
        swapped = {f"W{i + 1}": layer for i, layer in enumerate(hidden)}
        swapped["version"] = np.array([version, version], dtype=np.int64)
        return {**state, **swapped, **watched, "K": K}, "adopted"

    def confirm(self, state: OracleState) -> tuple[OracleState, str]:
        """After a sample was learned: whether the set that was adopted last holds what its trial promised.

        Returns:
            The state and "", or the state with the hidden layers and K from before, and a text that says why.
        """
        if self.trial is None or not rollback.due(self.trial, state):
            return state, ""
        samples = newest(self.trial, state, rollback.since(state))
        before = rollback.before(state, len(self.shapes) - 1)
        found = self._compare(samples, (self.hidden(state), rollback.K_adopted(state)), before)
        if self.trial.regrets(found):
            hidden, K = before
            version = np.array([rollback.version(state), state["version"][NEWEST]], dtype=np.int64)
            text = f"version {int(state['version'][0])} back to version {int(version[0])}: {found}"
            restored = {f"W{i + 1}": layer for i, layer in enumerate(hidden)}
            return {**state, **restored, "K": K, "version": version, **rollback.over(state)}, text
        return (state if not rollback.ends(state) else {**state, **rollback.over(state)}), ""

    def _compare(self, samples: np.ndarray, new: Network, old: Network) -> Finding:
        """Two networks, each hidden layers and K, on the same samples, (n, row)."""
        windows = samples[:, : -self.d].reshape(len(samples), self.pairs, self.d + self.m)
        h = samples[:, -self.d :]

        def error(hidden: list[np.ndarray], K: np.ndarray) -> float:
            missed = self.features_of(hidden, windows) @ K - h
            return float((missed * missed).sum() / max(1, len(samples)))

        return Finding(error(*new), error(*old), len(samples))

    def _every_tick(self) -> LastLayer:
        if self._last_layer is None:
            self._last_layer = LastLayer(self, lambda function: function)
        return self._last_layer

    def _before(self, state: OracleState) -> np.ndarray:
        """The pairs before the present one, one after the other, ((k - 1) (d + m),)."""
        return state["past"].ravel() if self.pairs > 1 else NOTHING

    def _K_under(self, hidden: list[np.ndarray], state: OracleState) -> np.ndarray:
        """K for new hidden layers, scaled, (1 + n_L, d)."""
        if self.refit is None:
            return state["K"]
        known = state["samples"][: int(state["sampled"][0])]
        if not len(known):
            return state["K"]
        windows = known[:, : -self.d].reshape(len(known), self.pairs, self.d + self.m)
        phi = self.features_of(hidden, windows)
        return refit(state["K"], phi, known[:, -self.d :], self.refit.ridge, self.bounds)
