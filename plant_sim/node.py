"""`tandem plant`: the simulated plant in real time, on a gateway."""

from __future__ import annotations

import logging
import threading

import numpy as np

from lbmpc.plants import PlantError, get_plant, get_truth, true_motion
from node_runtime.config.plant import initial_state, plant_of, true_dead_time, true_plant_of
from node_runtime.config.sections import Config
from node_runtime.lifecycle import run_process
from plant_sim.gateway import Gateway
from plant_sim.machine import NotMeasured
from plant_sim.sensors import Sensors
from plant_sim.simulator import Motion

log = logging.getLogger(__name__)


def motion_of(config: Config) -> Motion:
    """Return the true motion of the configured plant. Raises `ConfigError`."""
    plant, truth = plant_of(config, get_plant), true_plant_of(config, get_plant, get_truth)
    x0, dead_time = initial_state(config, plant), true_dead_time(config, plant, truth)
    return Motion(true_motion(truth), x0, config.period, dead_time, plant.safe_input)


def main(config: Config, stop: threading.Event | None = None) -> int:
    """Run `tandem plant`. Return 0 when told to stop, 2 for a wrong configuration, 3 if the plant's motion ended."""
    return run_process(lambda stopping: _live(config, stopping), stop)


def _live(config: Config, stopping: threading.Event) -> int:
    motion, gateway = motion_of(config), Gateway(None, config, simulated=True)
    sensors = Sensors(config, gateway.known)

    def read() -> np.ndarray:
        x = sensors.measure(motion.read(gateway.due), gateway.due)
        if x is None:
            raise NotMeasured
        return x

    def write(u: np.ndarray) -> None:
        motion.write(u, gateway.due)
        # There is time for it after a write.
        motion.look_ahead()

    try:
        gateway.serve(read, write, stopping)
    except PlantError as error:
        log.error("%s", error)
        return 3
    return 0
