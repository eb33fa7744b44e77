"""Lock-step runs with a stolen trainer: it sends hidden weights of its own that are valid in form and harmful."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from controller_node.core import Outputs
from network_model.description import hash_layers
from node_runtime.config.sections import Config
from node_runtime.realtime.scheduling import one_blas_thread
from protocol import messages as m
from run_log.run import Run
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import CONTROLLER, LockStep, drive
from trainer_node.node import ADOPTION_PATIENCE

Layers = list[np.ndarray]
KNOWN = 80
"""Number of the newest samples that the attacker knows."""


@dataclass(frozen=True, eq=False)
class Known:
    """What the attacker knows when it sends a set."""

    tick: int
    good: Layers
    """Hidden layers in use, or those that were just trained."""
    points: np.ndarray
    """(n, d + m) newest pairs (x, u), in the network's scale."""


Forge = Callable[[Known, np.random.Generator], Layers]
"""The layers to send."""


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
        return drive(_Attacked(config, forge, every, instead), steps).run


class _Attacked(LockStep):
    def __init__(self, config: Config, forge: Forge, every: int, instead: bool):
        super().__init__(config, Faults())
        self.forge, self.every, self.instead = forge, every, instead
        self.strange = 0
        self.points: list[list[float]] = []
        self.rng = np.random.default_rng([config.seed, 0xBAD])

    def _arriving(self, seq: int) -> m.HiddenWeights | None:
        real = super()._arriving(seq)
        if self.instead:
            return None if real is None else self._forged(seq, _numbers(real.layers), real.seq)
        if real is not None or seq % self.every:
            return real
        snapshot = self.core.memory.hidden_snapshot(seq)
        assert snapshot is not None
        return self._forged(seq, _numbers(snapshot.layers), snapshot.hidden_version + 1)

    def _learn(self, seq: int, outputs: Outputs) -> None:
        if outputs.sample is not None:
            self.points = [*self.points, [*outputs.sample.x, *outputs.sample.u]][-KNOWN:]
        self._rejoin(outputs)
        super()._learn(seq, outputs)

    def _rejoin(self, outputs: Outputs) -> None:
        """Continue from another sender's layers when these have been in use long enough, as the live trainer does."""
        output = outputs.output_weights
        if self.trainer is None or output is None or output.hidden_sha256 == self.trainer.sha256:
            self.strange = 0
            return
        self.strange += 1
        if self.strange * self.config.period > ADOPTION_PATIENCE:
            snapshot = self.core.memory.hidden_snapshot(output.seq)
            assert snapshot is not None
            self.trainer.resume(_numbers(snapshot.layers), snapshot.hidden_version)

    def _forged(self, seq: int, good: Layers, version: int) -> m.HiddenWeights:
        assert self.core.controller.oracle.description is not None
        scale = np.array(self.core.controller.oracle.description.input_scale)
        known = Known(seq, good, np.array(self.points).reshape(-1, len(scale)) / scale)
        layers = [layer.astype(np.float32) for layer in self.forge(known, self.rng)]
        return m.HiddenWeights(
            run_id="stolen",
            seq=version,
            for_run=CONTROLLER,
            trained_on=seq,
            base_sha256="",
            samples=1,
            loss_before=1.0,
            loss_after=0.0,
            network_sha256=self.core.controller.oracle.description.sha256(),
            sha256=hash_layers(layers),
            layers=[m.Array.of(layer, "<f4") for layer in layers],
        )


def _numbers(layers: list[m.Array]) -> Layers:
    return [layer.numpy().astype(float) for layer in layers]


# -- what is sent --------------------------------------------------------------------------------------------


def crude(known: Known, rng: np.random.Generator) -> Layers:
    """In turn: NaN, huge within the norm, of another shape, sign reversed, and random three times."""
    kind = known.tick % 7
    if kind == 0:
        return [layer * np.nan for layer in known.good]
    if kind == 1:
        return [layer * (99.0 / np.linalg.norm(layer)) for layer in known.good]
    if kind == 2:
        return [layer[:, :-1] for layer in known.good]
    if kind == 3:
        return reversed_sign(known, rng)
    return random(known, rng)


def reversed_sign(known: Known, _rng: np.random.Generator) -> Layers:
    """Reverse the sign of the last hidden layer."""
    return [*known.good[:-1], -known.good[-1]]


def random(known: Known, rng: np.random.Generator) -> Layers:
    """Random layers of the size of the good ones."""
    return [rng.standard_normal(layer.shape) * np.std(layer) for layer in known.good]


def noise(share: float) -> Forge:
    """The good layers with noise, `share` of their own standard deviation."""
    return lambda known, rng: [
        layer + share * np.std(layer) * rng.standard_normal(layer.shape) for layer in known.good
    ]


def drift(known: Known, _rng: np.random.Generator) -> Layers:
    """The good layers, moved further each time in one direction."""
    always = np.random.default_rng(5)
    return [layer + 0.01 * np.std(layer) * always.standard_normal(layer.shape) for layer in known.good]


def elsewhere(size: float) -> Forge:
    """Right where the plant has just been and wrong elsewhere, for tanh layers on one pair.

    The last hidden layer moves in the null space of the activations before it on the newest samples, by `size` of
    its norm.
    """

    def forge(known: Known, rng: np.random.Generator) -> Layers:
        *before, last = known.good
        activation = known.points
        for layer in before:
            activation = np.tanh(_with_one(activation) @ layer)
        _, strengths, directions = np.linalg.svd(_with_one(activation))
        null = directions[int((strengths > 1e-3 * strengths.max(initial=0.0)).sum()) :]
        moved = null.T @ rng.standard_normal((len(null), last.shape[1]))
        return [*before, last + moved * (size * np.linalg.norm(last) / np.linalg.norm(moved))]

    return forge


def _with_one(rows: np.ndarray) -> np.ndarray:
    return np.concatenate([np.ones((len(rows), 1)), rows], axis=1)
