"""Lock-step simulation: the real controller, trainer and plant in one process, on a virtual clock.

Deterministic for a seed: a tick's state is the plant's sample at exactly that time, its command acts from that time
on, a training takes no time at all and its weights arrive `weights_delay` ticks later.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from controller_node.build import initial_state
from controller_node.core import ControllerCore, Outputs
from lbmpc.plants import PlantError
from node_runtime.config import Config
from node_runtime.realtime import one_blas_thread
from plant_sim.plant import PlantSim
from protocol import messages as m
from protocol import topics
from protocol.topics import Topic
from run_log.reader import Run, gather

if TYPE_CHECKING:
    from trainer_node.training import Trainer

Progress = Callable[[int], None]
CONTROLLER, PLANT, TRAINER = "controller-simulated", "plant-simulated", "trainer-simulated"


def simulate(
    config: Config,
    steps: int,
    adapt_only: bool = False,
    progress: Progress | None = None,
    weights_delay: int = 1,
) -> Run:
    """Run `steps` periods from x0.

    Args:
        config: the resolved configuration.
        steps: ticks.
        adapt_only: hidden layers are never trained.
        progress: told the number of finished steps.
        weights_delay: ticks between the end of the samples that a training saw and the arrival of its weights.

    Returns:
        What a recorder would have seen; times are virtual and start at 0.

    Raises:
        ConfigError: the configuration admits no controller.
        PlantError: the true plant left every state from which its equations can be followed.
    """
    with one_blas_thread():
        return _LockStep(config, adapt_only, weights_delay).run(steps, progress)


class _LockStep:
    def __init__(self, config: Config, adapt_only: bool, weights_delay: int):
        self.config = config
        self.core = ControllerCore(config, CONTROLLER)
        x0 = initial_state(config, self.core.plant)
        self.plant = PlantSim(self.core.plant, config.period, x0, config.plant.plan_patience, PLANT)
        self.trainer = None if adapt_only or not config.trainer.enabled else self._trainer()
        self.weights_delay = weights_delay
        self.on_the_way: list[tuple[int, m.HiddenWeights]] = []
        self.log: list[tuple[Topic, m.Message, int]] = []

    def _trainer(self) -> Trainer | None:
        snapshot = self.core.hidden_snapshot(-1)
        if snapshot is None or self.core.description is None:
            return None
        # torch is imported only where there is a network to train.
        from trainer_node.training import Trainer, use_one_thread

        use_one_thread()
        hidden = [layer.numpy().astype(float) for layer in snapshot.layers]
        return Trainer(self.core.description, self.config.trainer, self.config.seed, TRAINER, hidden)

    def run(self, steps: int, progress: Progress | None) -> Run:
        self._note(topics.RUN_INFO["controller"], self.core.run_info(0.0), 0)
        self._note(topics.KEYFRAME, self.core.keyframe(-1), 0)
        seq = -1
        for seq in range(steps):
            try:
                self._step(seq)
            except PlantError as error:
                raise PlantError(f"at step {seq} of {steps}: {error}") from error
            if progress is not None:
                progress(seq + 1)
        if seq >= 0 and (seq + 1) % self.config.controller.keyframe_every:
            self._note(topics.KEYFRAME, self.core.keyframe(seq), seq)
        self._note(topics.PLANT_STATE, self.plant.sample(steps * self.config.period), steps)
        return gather(self.config, self.log)

    def _step(self, seq: int) -> None:
        started = time.perf_counter()
        t = seq * self.config.period
        state = self.plant.sample(t)
        self._note(topics.PLANT_STATE, state, seq)
        weights = None
        while self.on_the_way and self.on_the_way[0][0] <= seq:
            weights = self.on_the_way.pop(0)[1]
        tick = m.Tick(
            run_id=CONTROLLER,
            seq=seq,
            slot=seq,
            t=t,
            skipped=0,
            lateness=0.0,
            late=False,
            state_verdict="fresh",
            state=state,
            weights=weights,
        )
        stepped = time.perf_counter()
        outputs = self.core.step(tick)
        timing = m.TickTiming(
            run_id=CONTROLLER,
            seq=seq,
            solve_ms=self.core.solve_seconds * 1e3,
            tick_ms=(time.perf_counter() - stepped) * 1e3,
            lateness_ms=0.0,
            state_age_ms=(stepped - started) * 1e3,
        )
        self.plant.command(outputs.command, t)
        for topic, message in (
            (topics.TICK, tick),
            (topics.COMMAND, outputs.command),
            (topics.RESULT, outputs.result),
            (topics.TIMING, timing),
        ):
            self._note(topic, message, seq)
        self._learn(seq, outputs)
        if (seq + 1) % self.config.controller.keyframe_every == 0:
            self._note(topics.KEYFRAME, self.core.keyframe(seq), seq)

    def _learn(self, seq: int, outputs: Outputs) -> None:
        if outputs.output_weights is not None:
            self._note(topics.OUTPUT_WEIGHTS, outputs.output_weights, seq)
        if outputs.sample is not None:
            batch = m.Samples(run_id=CONTROLLER, seq=outputs.sample.seq, samples=[outputs.sample])
            self._note(topics.SAMPLES, batch, seq)
        if self.trainer is None or outputs.output_weights is None:
            return
        if outputs.sample is not None:
            self.trainer.add(CONTROLLER, [outputs.sample])
        if self.trainer.due():
            weights = self.trainer.train(outputs.output_weights, CONTROLLER)
            if weights is not None:
                self._note(topics.HIDDEN_WEIGHTS, weights, seq)
                self.on_the_way.append((seq + self.weights_delay, weights))

    def _note(self, topic: Topic, message: m.Message, seq: int) -> None:
        self.log.append((topic, message, round(seq * self.config.period * 1e9)))
