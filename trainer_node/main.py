"""`tandem trainer`: the process."""

from __future__ import annotations

import logging
import threading

from node_runtime.config import Config
from node_runtime.lifecycle import stopped_by_signals
from node_runtime.realtime import quick_handover
from node_runtime.session import OpenInterrupted
from trainer_node.fleet import Fleet
from trainer_node.plant_bus import Sessions
from trainer_node.training import TrainerError, pick_device, use_one_thread

log = logging.getLogger(__name__)


def main(config: Config, stop: threading.Event | None = None, plants: str | None = None) -> int:
    """Train until told to stop.

    Args:
        config: of this process; the networks' shapes come from the controllers.
        stop: ends it; signals do too.
        plants: names of the plants, as a pattern of fnmatch; None: the one plant of the configuration.

    Returns:
        0 when told to stop, 2 when this machine cannot train as configured.
    """
    try:
        pick_device(config.trainer.device)
    except TrainerError as error:
        log.error("%s", error)
        return 2
    use_one_thread()
    with stopped_by_signals(stop) as stopping, quick_handover():
        try:
            with Sessions(config, "trainer", stopping) as sessions:
                Fleet(config, plants or config.name, sessions).run(stopping)
        except OpenInterrupted:
            log.info("stopped before there was a router")
    return 0
