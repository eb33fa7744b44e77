"""One round of training: the plants of one network shape that have waited longest, in one descent."""

from __future__ import annotations

from collections.abc import Sequence

from node_runtime.realtime import clock
from trainer_node.descent import descend_together, shape_of
from trainer_node.node import TrainerNode
from trainer_node.training import Draw

MOST_STACKED = 16
"""Largest number of plants in a round. Samples of the other plants wait until it is finished."""


def train_round(nodes: Sequence[TrainerNode], now: float) -> float:
    """Train up to `MOST_STACKED` plants of one shape, that of the plant that has waited longest.

    Returns:
        The duration in seconds.
    """
    waiting = sorted(
        (since, k) for k, node in enumerate(nodes) if (since := node.waits_since(now)) is not None
    )
    began, shape = clock.now(), None
    chosen: list[tuple[TrainerNode, Draw]] = []
    for _, k in waiting:
        trainer = nodes[k].trainer
        assert trainer is not None
        found = shape_of(trainer.description)
        if len(chosen) == MOST_STACKED or (shape is not None and found != shape):
            continue
        draw = nodes[k].begin()
        if draw is not None:
            shape = found
            chosen.append((nodes[k], draw))
    if not chosen:
        return 0.0
    settings = nodes[0].settings
    descents = descend_together([draw.problem for _, draw in chosen], settings.steps, settings.learning_rate)
    took = clock.now() - began
    for (node, draw), descent in zip(chosen, descents, strict=True):
        node.rest(now, took)
        node.finish(draw, descent)
    return clock.now() - began
