"""The samples of a log as transitions: the state, the input, and the state a period later."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.identification import Transitions
from lbmpc.model import Model
from protocol import topics
from protocol.messages import Sample
from run_log.errors import LogError
from run_log.run import Run


@dataclass(frozen=True, eq=False)
class Observed:
    """n samples as the controllers saw them, in order of time."""

    transitions: Transitions
    missed: np.ndarray
    """(n, d): h, the error of the log's own model at the next sample; plant units."""


def observed(run: Run, model: Model) -> Observed:
    """All labelled samples of a log.

    A controller labels a pair of consecutive samples of one start of the plant, with the input that acted between them.
    So no transition spans an episode, a gap or a restart. If several inputs acted within a period, `u` is their mean,
    and `after` is the state to which this mean would have led: the log's model with the labelled h.

    Args:
        run: a log, as read.
        model: the model of the log's controllers, to which h refers.

    Raises:
        LogError: no samples, or samples of another plant.
    """
    plant = model.plant
    found: dict[tuple[str, int], Sample] = {}
    controllers = run.controllers
    for entry in run.entries(topics.SAMPLES):
        if not controllers or entry.message.run_id in controllers:
            found |= {(entry.message.run_id, sample.seq): sample for sample in entry.message.samples}
    if not found:
        raise LogError(f"{run.path}: contains no samples{run.unreadable}")
    order = sorted(found, key=lambda key: (controllers.index(key[0]) if controllers else 0, key[1]))
    samples = [found[key] for key in order]
    sizes = {(len(sample.x), len(sample.u), len(sample.h)) for sample in samples}
    if sizes != {(plant.d, plant.m, plant.d)}:
        raise LogError(
            f"{run.path}: its samples do not fit a plant with the states {', '.join(plant.states)} and the "
            f"inputs {', '.join(plant.inputs)}"
        )
    x, u, h = (np.array([getattr(sample, name) for sample in samples]) for name in ("x", "u", "h"))
    after = x @ model.A.T + u @ model.B.T + h
    return Observed(Transitions(x + plant.x_e, u + plant.u_e, after + plant.x_e), h)
