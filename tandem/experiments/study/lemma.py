"""Lemma 1 on a real run: the accumulated squared prediction error beside its bound.

    sum |xtilde_{t+1}|^2  <=  c_0 (V_a(K_0) + sum |eps_j(x_t, u_t)|^2),      c_0 = sigma^2 / (1 - gamma)
    V_a(K) = |K - W*|_F^2 / gamma,      eps_j(x, u) = h(x, u) - W*' phi_j(x, u)

This is the sum of the lemma's (ii), for any W* within the bounds on the columns. Part (iii) puts 4 Wbar / gamma for
V_a and the largest |eps| for each of them. All values are in units of h.
"""

from __future__ import annotations

import msgspec
import numpy as np

from lbmpc.oracles import DnnOracle
from lbmpc.oracles.dnn.adaptation_law import refit
from lbmpc.oracles.dnn.gradient_law import GradientLaw
from run_log.run import Run

RIDGE = 1e-8


class Lemma(msgspec.Struct, frozen=True, kw_only=True):
    """n samples."""

    error: list[float]
    """|xtilde_{t+1}|^2, (n,)."""
    epsilon: list[float]
    """|eps_j(x_t, u_t)|^2 with W* fitted to the whole run, (n,)."""
    sigma2: float
    """Largest |phi_j(x_t, u_t)|^2 of the run."""
    sigma2_bound: float
    """Its bound for bounded neurons: 1 + n_L."""
    gamma: float
    V0: float
    """V_a(K_0)."""
    W_bar: float
    """Sum of the squared bounds on the columns."""

    @property
    def accumulated(self) -> np.ndarray:
        return np.cumsum(self.error)

    @property
    def bound(self) -> np.ndarray:
        """Bound (ii) with the values of the run: sigma, V_a(K_0) and every eps; (n,)."""
        return self.sigma2 / (1 - self.gamma) * (self.V0 + np.cumsum(self.epsilon))

    @property
    def bound_beforehand(self) -> np.ndarray:
        """Bound (iii) with the constants known before the run and its largest eps; (n,)."""
        c0 = self.sigma2_bound / (1 - self.gamma)
        n = np.arange(1, len(self.error) + 1)
        return c0 * n * max(self.epsilon) + 4 * c0 / self.gamma * self.W_bar


def measure(run: Run, oracle: DnnOracle) -> Lemma | None:
    """Evaluate the lemma from the log. None if it does not apply: no sample, labels with a variance, or another law."""
    samples = {sample.seq: sample for sample in run.samples}
    weights = [w for w in run.output_weights if w.seq in samples]
    if any(sample.variance for sample in samples.values()):
        return None
    if not weights or not isinstance(oracle.law, GradientLaw) or oracle.gamma == 0.0:
        return None
    hidden = _hidden_by_hash(run, oracle)
    phis, Ks, labels = [], [], []
    for w in weights:
        sample = samples[w.seq]
        window = np.vstack([np.reshape(sample.past, (-1, oracle.d + oracle.m)), [*sample.x, *sample.u]])
        phis.append(oracle.features_of(hidden[w.hidden_sha256], window))
        Ks.append(w.K.numpy())
        labels.append(sample.h)
    scale, phi, K = oracle.output_scale, np.array(phis), np.array(Ks)
    h = np.array(labels) / scale
    star = refit(np.zeros_like(K[0]), phi, h, RIDGE, oracle.bounds)
    error = (np.einsum("nf,nfd->nd", phi, K) - h) * scale
    epsilon = (h - phi @ star) * scale
    return Lemma(
        error=(error**2).sum(axis=1).tolist(),
        epsilon=(epsilon**2).sum(axis=1).tolist(),
        sigma2=float((phi**2).sum(axis=1).max()),
        sigma2_bound=float(phi.shape[1]),
        gamma=oracle.gamma,
        V0=float((((K[0] - star) * scale) ** 2).sum() / oracle.gamma),
        W_bar=float(((oracle.bounds * scale) ** 2).sum()),
    )


def _hidden_by_hash(run: Run, oracle: DnnOracle) -> dict[str, list[np.ndarray]]:
    start = run.keyframes[0].arrays
    first = [start[f"oracle.W{i + 1}"].numpy() for i in range(len(oracle.shapes) - 1)]
    sets = {run.output_weights[0].hidden_sha256: first}
    for sent in run.hidden_weights:
        sets[sent.sha256] = [layer.numpy().astype(float) for layer in sent.layers]
    return sets
