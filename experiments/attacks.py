"""Lock-step runs with a trainer that was stolen: it sends hidden weights of its own, valid in form, to do harm."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from experiments.faults import Faults
from experiments.lockstep import CONTROLLER, _LockStep
from node_runtime.config import Config
from node_runtime.realtime import one_blas_thread
from protocol import messages as m
from protocol.network import hash_layers
from run_log.reader import Run

Layers = list[np.ndarray]
Forge = Callable[[int, Layers, np.random.Generator], Layers]
"""(tick, good layers, draws) -> the layers to send; good: those in use, or those that were just trained."""


def follow_attacked(config: Config, steps: int, forge: Forge, every: int = 1, instead: bool = False) -> Run:
    """A run under attack.

    Args:
        config: the resolved configuration.
        steps: ticks.
        forge: makes what is sent.
        every: sets are sent at each tick that this divides, if the real trainer sends none then.
        instead: only in place of the real trainer's sets, which never arrive.
    """
    with one_blas_thread():
        return _Attacked(config, forge, every, instead).run(steps, None).run


class _Attacked(_LockStep):
    def __init__(self, config: Config, forge: Forge, every: int, instead: bool):
        super().__init__(config, Faults())
        self.forge, self.every, self.instead = forge, every, instead
        self.rng = np.random.default_rng([config.seed, 0xBAD])

    def _arriving(self, seq: int) -> m.HiddenWeights | None:
        real = super()._arriving(seq)
        if self.instead:
            return None if real is None else self._forged(seq, _numbers(real.layers), real.seq)
        if real is not None or seq % self.every:
            return real
        snapshot = self.core.hidden_snapshot(seq)
        assert snapshot is not None
        return self._forged(seq, _numbers(snapshot.layers), snapshot.hidden_version + 1)

    def _forged(self, seq: int, good: Layers, version: int) -> m.HiddenWeights:
        layers = [layer.astype(np.float32) for layer in self.forge(seq, good, self.rng)]
        assert self.core.description is not None
        return m.HiddenWeights(
            run_id="stolen",
            seq=version,
            for_run=CONTROLLER,
            trained_on=seq,
            base_sha256="",
            samples=1,
            loss_before=1.0,
            loss_after=0.0,
            network_sha256=self.core.description.sha256(),
            sha256=hash_layers(layers),
            layers=[m.Array.of(layer, "<f4") for layer in layers],
        )


def _numbers(layers: list[m.Array]) -> Layers:
    return [layer.numpy().astype(float) for layer in layers]


# -- what is sent --------------------------------------------------------------------------------------------


def crude(seq: int, good: Layers, rng: np.random.Generator) -> Layers:
    """In turn: NaN, huge within the norm, of another shape, sign reversed, and random three times."""
    kind = seq % 7
    if kind == 0:
        return [layer * np.nan for layer in good]
    if kind == 1:
        return [layer * (99.0 / np.linalg.norm(layer)) for layer in good]
    if kind == 2:
        return [layer[:, :-1] for layer in good]
    if kind == 3:
        return reversed_sign(seq, good, rng)
    return random(seq, good, rng)


def reversed_sign(_seq: int, good: Layers, _rng: np.random.Generator) -> Layers:
    """Of the last hidden layer."""
    return [*good[:-1], -good[-1]]


def random(_seq: int, good: Layers, rng: np.random.Generator) -> Layers:
    """Of the size of the good ones."""
    return [rng.standard_normal(layer.shape) * np.std(layer) for layer in good]


def noise(share: float) -> Forge:
    """The good ones with noise, `share` of their own spread."""
    return lambda _seq, good, rng: [
        layer + share * np.std(layer) * rng.standard_normal(layer.shape) for layer in good
    ]


def drift(_seq: int, good: Layers, _rng: np.random.Generator) -> Layers:
    """The good ones a little further in a direction that is always the same."""
    always = np.random.default_rng(5)
    return [layer + 0.01 * np.std(layer) * always.standard_normal(layer.shape) for layer in good]
