"""Savings of a stack of networks: their descents one by one and together, in turns, in a process of its own.

    python -m benchmarks.live.stacked_descent '[[512, 64], [8, 64]]'

The argument is [samples drawn, numbers of networks]. Prints [samples, networks, ms a network one by one, ms stacked].
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence

import numpy as np

from benchmarks.live.fleet import NETWORK
from network_model.description import initial_hidden
from node_runtime.config.sections import TrainerConfig
from trainer_node.descent import Problem, descend, descend_together
from trainer_node.network import Network
from trainer_node.training import use_one_thread
from trainer_node.training_round import MOST_STACKED

TURNS = 5
"""The first repetition does not count."""


def main(batches: Sequence[int], counts: Sequence[int]) -> list[list[float]]:
    """One row for each batch and number of networks, up to the largest stack."""
    use_one_thread()
    stacks = sorted({min(count, MOST_STACKED) for count in counts})
    return [[batch, count, *_times(batch, count)] for batch in batches for count in stacks]


def _times(batch: int, count: int) -> list[float]:
    """Medians in ms a network: one by one, stacked."""
    settings = TrainerConfig()
    alone: list[float] = []
    stacked: list[float] = []
    for _ in range(TURNS):
        problems = [_problem(k, batch) for k in range(count)]
        began = time.perf_counter()
        for problem in problems:
            descend(problem, settings.steps, settings.learning_rate)
        alone.append(time.perf_counter() - began)
        problems = [_problem(k, batch) for k in range(count)]
        began = time.perf_counter()
        descend_together(problems, settings.steps, settings.learning_rate)
        stacked.append(time.perf_counter() - began)
    return [float(np.median(times[1:])) / count * 1e3 for times in (alone, stacked)]


def _problem(number: int, batch: int) -> Problem:
    rng = np.random.default_rng(number)
    network = Network(NETWORK)
    network.load(initial_hidden(NETWORK, rng))
    xu = rng.uniform(-1, 1, (batch, 5)) * NETWORK.input_scale
    h, K = rng.normal(size=(batch, 4)) * 0.01, rng.normal(size=(NETWORK.features, 4)) * 0.1
    return Problem(network, xu, h, K)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(main(*json.loads(sys.argv[1]))) + "\n")
