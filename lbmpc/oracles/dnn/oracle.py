"""The network oracle: the trainer sends the hidden layers, and the last layer is adapted at every sample."""

from __future__ import annotations

from typing import Literal

import numpy as np

from lbmpc.oracles.base import HiddenSet, LearnedNetwork, OracleState, Realise, Variance, Verdict
from lbmpc.oracles.dnn import rollback
from lbmpc.oracles.dnn.adaptation_law import AdaptationLaw, project_columns, refit
from lbmpc.oracles.dnn.adoption import IN_USE, NEWEST, Adoption, Refit
from lbmpc.oracles.dnn.evidence import Evidence, counting, weights
from lbmpc.oracles.dnn.expressions import NetworkExpressions
from lbmpc.oracles.dnn.gradient_law import GradientLaw
from lbmpc.oracles.dnn.kalman_law import Kalman, KalmanLaw
from lbmpc.oracles.dnn.last_layer import LastLayer
from lbmpc.oracles.dnn.trial import Trial, empty, only, remember
from network_model.description import NetworkDescription, hash_layers, initial_hidden

Start = Literal["random", "zero", "pretrained"]
"""Kinds of K_0: random with `initial_scale`; zero; or random and then fitted to h = 0 over X x U."""
PRETRAINING, PRETRAINING_RIDGE = 2000, 1e-4
NOTHING = np.zeros(0)


class DnnOracle(NetworkExpressions):
    """A bounded network h_hat whose hidden weights and output weights are parameters.

    Args:
        description: sizes, activations and scaling.
        gamma: learning rate of the last layer under the gradient law; 0 keeps it constant.
        column_bound: Wbar_i, (d,), in units of h, or one number for every column.
        initial_scale: standard deviation of the entries of each column of K_0, likewise.
        start: kind of K_0.
        refit: settings for the fit of K when hidden layers are adopted; None keeps K.
        trial: settings of the trial of hidden layers before and after their adoption; None for no trial.
        kalman: the filter by which the last layer learns; None for the gradient law.
        evidence: the filter of the constant beside the network, for noisy labels. Network and constant are then
            weighted by how well labels confirm them. With None, as for exact labels, the network alone counts.
    """

    name = "dnn"

    def __init__(
        self,
        description: NetworkDescription,
        gamma: float = 0.5,
        column_bound: np.ndarray | float = 0.05,
        initial_scale: np.ndarray | float = 1e-3,
        start: Start = "random",
        refit: Refit | None = None,
        trial: Trial | None = None,
        kalman: Kalman | None = None,
        evidence: Kalman | None = None,
    ):
        super().__init__(description)
        self.gamma = gamma
        self.bounds = column_bound / self.output_scale
        self.initial_scale, self.start, self.refit, self.trial = initial_scale, start, refit, trial
        self.law: AdaptationLaw = (
            GradientLaw(gamma, self.bounds) if kalman is None else KalmanLaw(kalman, self.bounds)
        )
        self.evidence: Evidence | None = None
        if evidence is not None:
            self.evidence = Evidence(evidence, self.output_scale, self.bounds * self.output_scale)
        self._adoption = Adoption(self, self.bounds, refit, trial)
        self._last_layer: LastLayer | None = None

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        hidden = initial_hidden(self.description, rng)
        state = self.named(hidden)
        state["K"] = self._first_K(hidden, rng)
        state |= self.law.begin(self.description.features)
        state["version"] = np.zeros(2, dtype=np.int64)
        if self.pairs > 1:
            state["past"] = np.zeros((self.pairs - 1, self.d + self.m))
        if self.refit is not None:
            state["samples"] = np.zeros((self.refit.window, self.pairs * (self.d + self.m) + self.d))
            state["sampled"] = np.zeros(1, dtype=np.int64)
        if self.evidence is not None:
            state |= self.evidence.nothing()
        if self.trial is not None:
            state |= empty(self.trial, self.pairs * (self.d + self.m) + self.d)
            state |= rollback.nothing(hidden, {name: state[name] for name in ("K", *self.law.remembers)})
            state |= only(hash_layers(hidden))
        return state

    def _first_K(self, hidden: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """Return K_0, scaled, (1 + n_L, d)."""
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

    def passed(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> OracleState:
        if self.pairs == 1:
            return state
        return {**state, "past": np.vstack([state["past"][1:], np.concatenate([x, u])])}

    def past(self, state: OracleState) -> np.ndarray:
        return state["past"] if self.pairs > 1 else np.zeros((0, self.d + self.m))

    def theta(self, state: OracleState) -> np.ndarray:
        return self.pack(self.hidden(state), self._counting(state))

    def compile(self, realise: Realise) -> None:
        """Replace the functions that every tick calls by `realise` of them; CasADi interprets them otherwise."""
        self._last_layer = LastLayer(self, self.law, realise)

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return self._every_tick().estimate(
            self.hidden(state), self._counting(state), x, self._before(state), u
        )

    def learn(
        self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray, variance: Variance = 0.0
    ) -> OracleState:
        before = self._before(state)
        learned = {**state, **self._every_tick().learn(self.hidden(state), state, x, before, u, h, variance)}
        if self.evidence is not None:
            h_hat = self._every_tick().estimate(self.hidden(state), state["K"], x, before, u)
            learned |= self.evidence.with_label(state, h, h_hat, variance)
        learned = self.passed(learned, x, u)
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

    def adopt(self, state: OracleState, offered: HiddenSet) -> tuple[OracleState, Verdict]:
        return self._adoption.adopt(state, offered)

    def confirm(self, state: OracleState) -> tuple[OracleState, str]:
        return self._adoption.confirm(state)

    def network(self, state: OracleState) -> LearnedNetwork:
        version = state["version"]
        return LearnedNetwork(self.hidden(state), state["K"], int(version[IN_USE]), int(version[NEWEST]))

    def weights(self, state: OracleState) -> np.ndarray:
        return super().weights(state) if self.evidence is None else weights(state)

    def _counting(self, state: OracleState) -> np.ndarray:
        """Return K with its weight in the prediction, (1 + n_L, d)."""
        return state["K"] if self.evidence is None else counting(state, state["K"], self.output_scale)

    def _every_tick(self) -> LastLayer:
        if self._last_layer is None:
            self._last_layer = LastLayer(self, self.law, lambda function: function)
        return self._last_layer

    def _before(self, state: OracleState) -> np.ndarray:
        """Return the pairs before the present one as one vector, ((k - 1) (d + m),)."""
        return state["past"].ravel() if self.pairs > 1 else NOTHING
