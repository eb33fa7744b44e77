"""A machine with a thread of its own that moves the compressor, and two functions to access it. Also a process."""

from __future__ import annotations

import logging
import threading

import numpy as np

from lbmpc.plants import get_plant, true_motion
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from plant_sim import Gateway

log = logging.getLogger(__name__)
STEP = 0.004


class Rig:
    """A machine that moves by its own clock, independent of calls. A context manager."""

    def __init__(self) -> None:
        plant = get_plant("moore_greitzer")
        self._motion = true_motion(plant)
        self._x, self._u = plant.x_e + np.array([0.02, 0.0, 0.0, 0.0]), plant.u_e
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._move, daemon=True)

    def read(self) -> np.ndarray:
        with self._lock:
            return self._x

    def write(self, u: np.ndarray) -> None:
        with self._lock:
            self._u = u

    def _move(self) -> None:
        t = clock.now()
        while not self._end.is_set():
            clock.sleep_until(t + STEP)
            dt, t = clock.now() - t, clock.now()
            with self._lock:
                self._x = self._motion.step(self._x, self._u, dt)

    def __enter__(self) -> Rig:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()


def main(config: Config) -> int:
    """Run the rig behind a gateway, and log its last input at the end."""
    with Rig() as rig:
        Gateway(None, config).serve(rig.read, rig.write)
        log.warning("left with %s", rig._u.tolist())
    return 0
