"""Lock-step simulation: the real controller, trainer and plant in one process, on a virtual clock.

The simulation is deterministic for a seed. The state of a tick is the plant's sample at exactly that time. Its command
acts from that time on, a training takes no time unless `Faults` set one, and its weights arrive at the next tick.

In each episode the plant restarts at x0; controller and trainer keep their memory.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from controller_node.build import GivenPlant
from controller_node.core import ControllerCore, Outputs
from lbmpc.plants import Known, Plant, PlantError, TrueMotion, get_plant, get_truth, true_motion
from node_runtime.config.architecture import register_architecture
from node_runtime.config.plant import files_of, initial_state, true_dead_time, true_plant_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.realtime.scheduling import one_blas_thread
from plant_sim.sensors import Sensors
from plant_sim.shield import measurement
from plant_sim.simulator import PlantSim
from plant_sim.way_back import WayBack
from protocol import messages as m
from protocol import topics
from protocol.topics import Topic
from run_log.run import Run, gather
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.person import Person

if TYPE_CHECKING:
    from trainer_node.training import Trainer

Progress = Callable[[int], None]
NO_FAULTS = Faults()
CONTROLLER, PLANT, TRAINER = "controller-simulated", "plant-simulated", "trainer-simulated"


@dataclass(frozen=True)
class Outcome:
    """A run, complete or until the plant was lost."""

    run: Run
    """The messages that a recorder would have logged; times are virtual and start at 0."""
    lost: str | None
    """Why the true motion ended early; None if it did not."""
    episodes: int
    """Number of complete episodes."""


def simulate(
    config: Config,
    steps: int,
    progress: Progress | None = None,
    episodes: int = 1,
    set_points: m.Reference | None = None,
) -> Run:
    """Run `follow` without faults; raise an error if the plant is lost.

    Raises:
        ConfigError: the configuration does not give a controller.
        PlantError: the true plant left every state from which its equations can be followed.
    """
    outcome = follow(config, steps, progress=progress, episodes=episodes, set_points=set_points)
    if outcome.lost is not None:
        raise PlantError(outcome.lost)
    return outcome.run


def follow(
    config: Config,
    steps: int,
    faults: Faults = NO_FAULTS,
    progress: Progress | None = None,
    episodes: int = 1,
    set_points: m.Reference | None = None,
) -> Outcome:
    """Run `steps` periods from x0, `episodes` times.

    Args:
        config: the resolved configuration.
        steps: ticks of each episode.
        faults: the faults; their times count from the begin of the first episode.
        progress: called with the number of finished steps of all episodes.
        episodes: number of starts of the plant.
        set_points: the reference from the begin of each episode; None: the configured one.

    Raises:
        ConfigError: the configuration does not give a controller, or the faults do not fit the plant.
    """
    with one_blas_thread():
        return drive(LockStep(config, faults, set_points=set_points), steps, progress, episodes)


def drive(loop: LockStep, steps: int, progress: Progress | None = None, episodes: int = 1) -> Outcome:
    """Run `steps` periods, `episodes` times; the arguments are those of `follow`."""
    lost, ended = None, 0
    try:
        for step in range(steps * episodes):
            if step and step % steps == 0:
                loop.start_again()
                ended += 1
            loop.step()
            if progress is not None:
                progress(step + 1)
        run = loop.so_far()
        ended += 1
    except PlantError as error:
        where = min(loop.taken, steps * episodes - 1)
        episode = f" in episode {where // steps + 1} of {episodes}" if episodes > 1 else ""
        lost, run = f"at step {where % steps} of {steps}{episode}: {error}", loop.so_far(lost=True)
    return Outcome(run, lost, ended)


class _Motion:
    """The motion of the plant, unless its states are given."""

    def __init__(self, true: TrueMotion):
        self._true = true
        self.at: np.ndarray | None = None

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        return self._true.step(x, u, dt) if self.at is None else self.at


class LockStep:
    """The whole loop, one period at a time.

    Args:
        config: the resolved configuration.
        faults: the faults of the run.
        given: objects that replace the configured plant and its truth.
        set_points: as of `follow`.

    Raises:
        ConfigError: the configuration does not give a controller, or the faults do not fit the plant.
    """

    def __init__(
        self,
        config: Config,
        faults: Faults = NO_FAULTS,
        given: GivenPlant | None = None,
        set_points: m.Reference | None = None,
    ):
        self.config, self.faults = config, faults
        self.person = Person(config.period, set_points)
        register_architecture(config)
        self.core = ControllerCore(config, CONTROLLER, given=given)
        truth = None if given is None else given.truth
        self.true = true_plant_of(config, get_plant, get_truth) if truth is None else truth
        self.motion = self._motion(self.true)
        self.dead_time = true_dead_time(config, self.core.plant, self.true)
        self.taken, self.episode, self.began, self.elsewhere = 0, 1, 0, False
        settings = config.controller
        self.way_back = WayBack(self.core.controller.model, settings.backup.margin, settings.horizon)
        self.acting = self.core.plant.safe_input
        """Input, (m,), of the last step."""
        self.plant = self._started_plant(initial_state(config, self.core.plant))
        self.changes = self._changes()
        self.sensors = Sensors(config, self.core.plant)
        if faults.command_seconds >= config.period:
            raise ConfigError(
                f"faults.command_seconds = {faults.command_seconds:g} is not less than a period, {config.period:g} s"
            )
        self.trainer = self._trainer() if config.trainer.enabled else None
        self.on_the_way: list[tuple[int, m.HiddenWeights]] = []
        self.log: list[tuple[Topic, m.Message, int]] = []
        self._note(topics.RUN_INFO["controller"], self.core.run_info(0.0), 0)
        if (sets := self.core.certified_sets()) is not None:
            self._note(topics.SETS, sets, 0)
        self._note(topics.KEYFRAME, self.core.memory.keyframe(-1), 0)

    def _motion(self, true: Known | Plant | TrueMotion) -> _Motion:
        try:
            return _Motion(true_motion(true))
        except PlantError as error:
            raise ConfigError(f"plant.truth: {error}") from error

    def _started_plant(self, x0: np.ndarray) -> PlantSim:
        run_id = PLANT if self.episode == 1 else f"{PLANT}-{self.episode}"
        plant, patience = self.core.plant, self.config.plant.plan_patience
        dead_time, way_back = self.dead_time, self.way_back
        return PlantSim(plant, self.motion, self.config.period, x0, patience, run_id, dead_time, way_back)

    def _changes(self) -> list[tuple[float, Plant]]:
        if self.faults.drift is None:
            return []
        try:
            return self.faults.drift.plants(self.true)
        except (KeyError, PlantError) as error:
            raise ConfigError(f"faults.drift: {error.args[0]}") from error

    def _trainer(self) -> Trainer | None:
        snapshot = self.core.memory.hidden_snapshot(-1)
        if snapshot is None or self.core.controller.oracle.description is None:
            return None
        # torch is imported only if there is a network to train.
        from trainer_node.training import Trainer, use_one_thread

        use_one_thread()
        hidden = [layer.numpy().astype(float) for layer in snapshot.layers]
        return Trainer(
            self.core.controller.oracle.description, self.config.trainer, self.config.seed, TRAINER, hidden
        )

    def so_far(self, lost: bool = False) -> Run:
        """Return the messages that a recorder would have received so far. The loop can continue.

        lost: without the state after the last command.

        Raises:
            PlantError: the true motion cannot be followed to the end of the last period.
        """
        last, log = self.taken - 1, [*self.log, *([] if lost else self._end())]
        if last >= 0 and self.taken % self.config.controller.keyframe_every:
            log.append(self._noted(topics.KEYFRAME, self.core.memory.keyframe(last), last))
        run = gather(self.config, log)
        run.plant, run.truth, run.files = self.core.plant, self.true, files_of(self.config)
        return run

    def manual(self, u: np.ndarray) -> None:
        """Let u, (m,), plant units, act manually from the next sample until `auto`, or until X would be left."""
        self._override(self.person.manual(u), self.taken * self.config.period)

    def auto(self) -> None:
        """Let the controller's commands act again from the next sample."""
        self._override(self.person.auto(), self.taken * self.config.period)

    def _override(self, word: m.Override, t: float) -> None:
        self.plant.override(word, t)
        self._note(topics.OVERRIDE, word, self.taken)

    def start_again(self, lost: bool = False) -> None:
        """Begin another episode at x0. Argument and errors are those of `so_far`."""
        self.log += [] if lost else self._end()
        self.episode, self.began, self.elsewhere = self.episode + 1, self.taken, False
        self.plant = self._started_plant(initial_state(self.config, self.core.plant))
        self.person.start_again()

    def ask(self, reference: m.Reference) -> None:
        """Give a reference that holds from the next period."""
        self.person.ask(reference)

    def _end(self) -> list[tuple[Topic, m.Message, int]]:
        """Return the state after the last command; unknown for an external plant."""
        if self.elsewhere:
            return []
        end = self.plant.look(self.taken * self.config.period)
        return [self._noted(topics.PLANT_STATE, end, self.taken)]

    def step(self, x: np.ndarray | None = None) -> tuple[m.PlantState, Outputs]:
        """Run the next period, up to the command that acts in it.

        Args:
            x: state of an external plant, (d,); None: the simulated true motion gives it.

        Returns:
            The plant's sample, without noise, and the controller's messages.

        Raises:
            PlantError: the true plant left every state from which its equations can be followed.
        """
        started, seq = time.perf_counter(), self.taken
        self.elsewhere, self.motion.at = x is not None, x
        if x is not None and seq == self.began:
            self.plant = self._started_plant(x)
        t = seq * self.config.period
        true = self.plant.sample(t)
        for word, at in self.person.renewals(self.plant.hand, t):
            self._override(word, at)
        truth: Mapping[str, float] = {}
        while self.changes and self.changes[0][0] <= t + self.config.period / 2:
            now = self.changes.pop(0)[1]
            self.motion = self._motion(now)
            self.plant.change(self.motion)
            truth = now.parameters
        self._note(topics.PLANT_STATE, true, seq)
        state = self._measured(true)
        weights = self._arriving(seq)
        asked = self.person.reference()
        if asked is not None:
            self._note(topics.REFERENCE, asked, seq)
        reference = msgspec.UNSET if asked is None else asked
        tick = m.Tick.punctual(CONTROLLER, seq, self.config.period, state, weights, truth, reference)
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
        self.plant.command(outputs.command, t + self.faults.command_seconds)
        by_hand = self.plant.hand.input(t) is not None
        self.acting = self.plant.acting if by_hand else np.array(outputs.command.u)
        for topic, message in (
            (topics.TICK, tick),
            (topics.COMMAND, outputs.command),
            (topics.RESULT, outputs.result),
            (topics.TIMING, timing),
        ):
            self._note(topic, message, seq)
        self._learn(seq, outputs)
        if (seq + 1) % self.config.controller.keyframe_every == 0:
            self._note(topics.KEYFRAME, self.core.memory.keyframe(seq), seq)
        self.taken += 1
        return true, outputs

    def _arriving(self, seq: int) -> m.HiddenWeights | None:
        """Return the newest hidden weights that have arrived."""
        weights = None
        while self.on_the_way and self.on_the_way[0][0] <= seq:
            weights = self.on_the_way.pop(0)[1]
        return weights

    def _learn(self, seq: int, outputs: Outputs) -> None:
        if outputs.output_weights is not None:
            self._note(topics.OUTPUT_WEIGHTS, outputs.output_weights, seq)
        if outputs.sample is not None:
            batch = m.Samples(run_id=CONTROLLER, seq=outputs.sample.seq, samples=[outputs.sample])
            self._note(topics.SAMPLES, batch, seq)
        if self.trainer is None or outputs.output_weights is None or self._trainer_is_dead(seq):
            return
        if outputs.sample is not None:
            self.trainer.add(CONTROLLER, [outputs.sample])
        if self.trainer.due(outputs.output_weights) and not self.on_the_way:
            weights = self.trainer.train(outputs.output_weights, CONTROLLER)
            if weights is not None:
                takes = max(1, math.ceil(self.faults.training_seconds / self.config.period - 1e-9))
                if self._trainer_is_dead(seq + takes):
                    return
                self._note(topics.HIDDEN_WEIGHTS, weights, seq)
                self.on_the_way.append((seq + takes, weights))

    def _trainer_is_dead(self, seq: int) -> bool:
        dies = self.faults.trainer_dies_at
        return dies is not None and seq * self.config.period > dies

    def _measured(self, true: m.PlantState) -> m.PlantState | None:
        """Return the sample that the controller gets; None if it is lost."""
        x = self.sensors.measure(np.array(true.x), true.t)
        return None if x is None else msgspec.structs.replace(true, **measurement(self.core.plant, x))

    def _note(self, topic: Topic, message: m.Message, seq: int) -> None:
        self.log.append(self._noted(topic, message, seq))

    def _noted(self, topic: Topic, message: m.Message, seq: int) -> tuple[Topic, m.Message, int]:
        return topic, message, round(seq * self.config.period * 1e9)
