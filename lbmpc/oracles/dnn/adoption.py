"""Adoption of hidden layers from a trainer: checks, refit of K, and rollback."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.oracles.base import HiddenSet, OracleState, Verdict
from lbmpc.oracles.dnn import rollback
from lbmpc.oracles.dnn.adaptation_law import refit
from lbmpc.oracles.dnn.expressions import NetworkExpressions
from lbmpc.oracles.dnn.trial import Finding, Trial, had, newest, tried
from network_model.description import hash_layers, why_unacceptable

IN_USE, NEWEST = 0, 1
"""Entries of `version`: the version in use, and the highest version adopted so far."""
LEAP = 10**9
"""Largest increase of the version at once. Without a limit the largest integer would block all later weights."""
Network = tuple[list[np.ndarray], np.ndarray]
"""Hidden layers W_1..W_{L-1} and K."""


@dataclass(frozen=True)
class Refit:
    """Settings for fitting K to the newest samples under new features; see `adaptation_law.refit`."""

    window: int
    """Number of stored samples."""
    ridge: float


@dataclass(frozen=True, eq=False)
class Adoption:
    """Checks offered hidden layers before and after their adoption."""

    net: NetworkExpressions
    bounds: np.ndarray
    """Bounds on the norm of each column of K, (d,), scaled."""
    refit: Refit | None
    """Settings for a refit of K after an adoption; None keeps K."""
    trial: Trial | None
    """Settings of the trial before and after an adoption; None for no trial."""

    def adopt(self, state: OracleState, offered: HiddenSet) -> tuple[OracleState, Verdict]:
        """Adopt a new set of hidden layers. K is kept, or refitted to the stored samples.

        Returns:
            The state and "adopted", or the previous state with an updated memory of trials and the reason.
        """
        reason = self._reason_to_refuse(state, offered)
        if reason is not None:
            return state, Verdict("refused", reason)
        # The hash covers float32 values.
        hidden = [layer.astype(np.float32).astype(float) for layer in offered.layers]
        K = self._K_under(hidden, state)
        watched: OracleState = {}
        if self.trial is not None:
            samples = newest(self.trial, state)
            if len(samples) < self.trial.least:
                missing = f"trial: {len(samples)} samples so far, {self.trial.least} are needed"
                return state, Verdict("refused", missing)
            if tried(state, offered.sha256):
                return state, Verdict("refused", "stale: these layers were in use or on trial before")
            state = {**state, **had(state, offered.sha256)}
            in_use = self.net.hidden(state)
            # A set always predicts its training samples well. If their age is unknown, only the first trial runs.
            later = self._later(state, offered)
            for tried_on in (samples, later) if len(later) else (samples,):
                found = self._compare(tried_on, (hidden, K), (in_use, state["K"]))
                if self.trial.refuses(found):
                    return state, Verdict("refused", f"trial: {found}")
            watched = rollback.adopted(self.trial, state, in_use, K)
        version = np.array([offered.version, offered.version], dtype=np.int64)
        return {**state, **self.net.named(hidden), "version": version, **watched, "K": K}, Verdict("adopted")

    def confirm(self, state: OracleState) -> tuple[OracleState, str]:
        """Check after a new sample whether the last adopted set is as good as its trial predicted.

        Returns:
            The state and "", or the state with the previous network and the reason.
        """
        if self.trial is None or not rollback.due(self.trial, state):
            return state, ""
        samples = newest(self.trial, state, rollback.since(state))
        hidden, last = rollback.before(state, len(self.net.shapes) - 1)
        in_use = (self.net.hidden(state), rollback.K_adopted(state))
        found = self._compare(samples, in_use, (hidden, last["K"]))
        if self.trial.regrets(found):
            version = np.array([rollback.version(state), state["version"][NEWEST]], dtype=np.int64)
            text = f"version {int(state['version'][IN_USE])} back to version {int(version[IN_USE])}: {found}"
            return {
                **state,
                **self.net.named(hidden),
                **last,
                "version": version,
                **rollback.over(state),
            }, text
        return (state if not rollback.ends(state) else {**state, **rollback.over(state)}), ""

    def _later(self, state: OracleState, offered: HiddenSet) -> np.ndarray:
        """Return the samples after the last training sample, (n, row); none if they are too few."""
        assert self.trial is not None
        if offered.later is None:
            return state["recent"][:0]
        later = newest(self.trial, state, int(state["seen"][0]) - offered.later)
        return later if len(later) >= self.trial.least else later[:0]

    def _reason_to_refuse(self, state: OracleState, offered: HiddenSet) -> str | None:
        """Return the reason why a set does not belong to this network, or None."""
        known, version = int(state["version"][NEWEST]), offered.version
        if version <= known:
            return f"version {version} is not newer than {known}"
        if version > known + LEAP:
            return f"version {version} leaps too far ahead of {known}"
        if offered.network_sha256 != self.net.description.sha256():
            return "trained for another network description"
        reason = why_unacceptable(self.net.description, offered.layers)
        if reason is None and hash_layers(offered.layers) != offered.sha256:
            return "sha256 does not match the layers"
        return reason

    def _compare(self, samples: np.ndarray, new: Network, old: Network) -> Finding:
        """Compare two networks (hidden layers and K) on the same samples, (n, row)."""
        windows, h = self._windows_and_labels(samples)

        def error(hidden: list[np.ndarray], K: np.ndarray) -> float:
            missed = self.net.features_of(hidden, windows) @ K - h
            return float((missed * missed).sum() / max(1, len(samples)))

        return Finding(error(*new), error(*old), len(samples))

    def _K_under(self, hidden: list[np.ndarray], state: OracleState) -> np.ndarray:
        """Return K for new hidden layers, scaled, (1 + n_L, d)."""
        if self.refit is None:
            return state["K"]
        known = state["samples"][: int(state["sampled"][0])]
        if not len(known):
            return state["K"]
        windows, h = self._windows_and_labels(known)
        return refit(state["K"], self.net.features_of(hidden, windows), h, self.refit.ridge, self.bounds)

    def _windows_and_labels(self, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the windows of pairs, (n, k, d + m), and the labels, (n, d), of stored samples, (n, row)."""
        d, m = self.net.d, self.net.m
        return samples[:, :-d].reshape(len(samples), self.net.pairs, d + m), samples[:, -d:]
