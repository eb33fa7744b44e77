"""`tandem simulate`: controller, trainer and plant in lock-step in one process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from node_runtime.config.literals import OracleName, TighteningName
from tandem import terminal
from tandem.commands.base import FROM_CONFIG, Configured, require
from tandem.terminal import Refused

MOST_STEPS = 1_000_000
"""All ticks are in memory until the end."""


@dataclass(frozen=True, kw_only=True)
class Simulate(Configured):
    """Run controller, trainer and plant in lock-step in one process: deterministic, faster than real time."""

    EXTRAS = "trainer,log"
    KEYS = (
        *(("oracle", "controller.oracle"), ("tightening", "controller.tightening")),
        *(("seed", "seed"), ("x0", "plant.x0"), ("noise", "plant.sensors.noise")),
    )

    oracle: Annotated[
        OracleName | None, arg(metavar="linear|constant|l2nw|dnn|perfect", help_behavior_hint=FROM_CONFIG)
    ] = None
    """Estimate of h."""
    steps: Annotated[int, arg(metavar="INT")] = 200
    """Number of ticks of each episode."""
    episodes: Annotated[int, arg(metavar="INT")] = 1
    """Number of times that the plant starts from x0; controller and trainer keep all they have learned."""
    seed: Annotated[int | None, arg(metavar="INT", help_behavior_hint=FROM_CONFIG)] = None
    """Seed of everything random; the same seed gives the same run, bit for bit."""
    tightening: Annotated[
        TighteningName | None,
        arg(metavar="none|first_step|tube|invariant", help_behavior_hint=FROM_CONFIG),
    ] = None
    """Tightening of the nominal constraints."""
    adapt_only: bool = False
    """Never train the hidden layers; adapt the last layer only."""
    x0: Annotated[
        list[float] | None, arg(metavar="X...", help_behavior_hint="(default: the plant's own)")
    ] = None
    """Initial state, in the plant's own units."""
    noise: Annotated[float | None, arg(metavar="SHARE", help_behavior_hint=FROM_CONFIG)] = None
    """Measurement noise of every state: its standard deviation as a share of the half-width, for example 0.01."""
    set_points: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: the configured reference)")
    ] = None
    """Set-points from the beginning of each episode on: a CSV file with the columns time and states."""
    log: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none is written)")] = None
    """Also write the run's log, in the format of a live run."""

    def run(self) -> int:
        config, plant = self.resolve_with_plant()
        terminal.limited("--steps", self.steps, 1, MOST_STEPS)
        terminal.limited("--episodes", self.episodes, 1, MOST_STEPS // self.steps)
        if self.log is not None and self.log.exists():
            raise Refused(
                f"{self.log}: exists already, and a log never overwrites a file; choose another name"
            )
        from controller_node.build import build_model
        from controller_node.guarantee import guarantee
        from lbmpc.plants import PlantError
        from node_runtime.config.loading import override
        from run_log.reporting.summary import summarise
        from run_log.writing.save import save
        from tandem import summary_table
        from tandem.experiments.simulation.lockstep import simulate
        from tandem.operating import set_points

        require("zstandard")
        asked = None
        if self.set_points is not None:
            asked = set_points.from_file(self.set_points)
            set_points.require_fit(asked, plant, config.period, str(self.set_points))
        if self.adapt_only:
            config = override(config, ["trainer.enabled=false"])
        self.say(guarantee(config, build_model(config)))
        with terminal.progress_bar(self.console) as bar:
            task = bar.add_task(f"simulating, {config.controller.oracle}", total=self.steps * self.episodes)
            try:
                ran = simulate(
                    config,
                    self.steps,
                    progress=lambda step: bar.update(task, completed=step),
                    episodes=self.episodes,
                    set_points=asked,
                )
            except PlantError as error:
                terminal.complain(f"the plant was lost: {error}", self.json)
                return 1
        if self.log is not None:
            save(ran, self.log)
            ran.path = self.log
        summary = summarise(ran)
        self.console.print(summary_table.table(summary))
        self.emit(summary_table.of(summary))
        return 0
