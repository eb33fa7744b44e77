"""Runs in lock-step whose logs say what A and B are: several starts, each under another feedback."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from run_log.run import Run
from run_log.writing.save import save
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import follow


def ran(settings: Sequence[str], steps: int, noise: list[float] | None = None) -> Run:
    """One run of the configuration with these settings, without a trainer."""
    config = override(Config(), [*settings, "trainer.enabled=false", "controller.solver.compile=never"])
    return follow(config, steps, Faults(noise=noise)).run


def logged(folder: Path, starts: Sequence[Sequence[str]], settings: Sequence[str], steps: int) -> list[Path]:
    """The logs of runs that differ in the settings of `starts`."""
    files = []
    for number, own in enumerate(starts):
        files.append(folder / f"run{number}.mcap")
        save(ran([*settings, *own], steps), files[-1])
    return files
