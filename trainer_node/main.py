"""`tandem trainer`: the process."""

from __future__ import annotations

import fnmatch
import logging
import threading

from node_runtime.bus.lanes import Lanes
from node_runtime.bus.session import OpenInterrupted
from node_runtime.config.architecture import register_architecture
from node_runtime.config.sections import Config
from node_runtime.lifecycle import stopped_by_signals
from node_runtime.realtime.scheduling import quick_handover
from trainer_node.fleet.discovery import RouterPerPlant, SharedRouter
from trainer_node.fleet.fleet import Fleet
from trainer_node.training import TrainerError, pick_device, use_one_thread

log = logging.getLogger(__name__)


def main(config: Config, stop: threading.Event | None = None, plants: str | None = None) -> int:
    """Train until told to stop.

    Args:
        config: the configuration of this process; the shapes of networks come from the controllers. A user's
            architecture must be configured here, because a file named in a message is never loaded.
        stop: ends the training; signals do too.
        plants: names of the plants, as a pattern for fnmatch; None for all of `trainer.fleet`, or for the configured
            plant if that list is empty.

    Returns:
        0 when told to stop; 2 if this machine cannot train as configured, or no plant matches the pattern.

    Raises:
        ConfigError: the file of the architecture does not exist or cannot be used.
    """
    register_architecture(config)
    try:
        pick_device(config.trainer.device)
    except TrainerError as error:
        log.error("%s", error)
        return 2
    use_one_thread()
    with stopped_by_signals(stop) as stopping, quick_handover():
        try:
            if config.trainer.fleet:
                places = [
                    place for place in config.trainer.fleet if fnmatch.fnmatchcase(place.name, plants or "*")
                ]
                if not places:
                    names = ", ".join(place.name for place in config.trainer.fleet)
                    log.error("no plant of trainer.fleet matches %r; it has %s", plants, names)
                    return 2
                Fleet(RouterPerPlant(config, places, stopping)).run(stopping)
            else:
                with Lanes(config, "trainer", stopping) as lanes:
                    Fleet(SharedRouter(config, plants or config.name, lanes)).run(stopping)
        except OpenInterrupted:
            log.info("stopped before there was a router")
    return 0
