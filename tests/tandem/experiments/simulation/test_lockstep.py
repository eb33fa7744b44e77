"""The closed loop in lock-step: the paper's claims on every seed, and bitwise equal repetitions."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from node_runtime.config.loading import load
from protocol import topics
from run_log.reporting.summary import Summary, summarise
from run_log.run import Run
from tandem.experiments.simulation.lockstep import simulate

STEPS = 200
SEEDS = range(3)


def run_summary(case: tuple[str, int, bool]) -> Summary:
    oracle, seed, adapt_only = case
    settings = [
        f"controller.oracle={oracle}",
        f"seed={seed}",
        *(["trainer.enabled=false"] if adapt_only else []),
    ]
    return summarise(simulate(load(None, settings), STEPS))


@pytest.fixture(scope="module")
def results() -> dict[tuple[str, int, bool], Summary]:
    """All runs that these tests compare, on both cores; a run is the same in any process."""
    cases = [("linear", 0, False), ("l2nw", 0, False)]
    cases += [("dnn", seed, adapt_only) for seed in SEEDS for adapt_only in (False, True)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        return dict(zip(cases, pool.map(run_summary, cases), strict=True))


Results = dict[tuple[str, int, bool], Summary]


def test_no_oracle_violates_a_true_constraint(results: Results) -> None:
    for case, summary in results.items():
        if not case[2]:
            assert summary.constraint_violations == 0, case
            assert summary.fallback_ticks == 0, case
            assert summary.soft_ticks == 0, case


@pytest.mark.parametrize("seed", SEEDS)
def test_the_network_does_not_overshoot_and_settles_earlier(results: Results, seed: int) -> None:
    both, linear = results["dnn", seed, False], results["linear", 0, False]
    assert both.overshoot["z"] < 0.0143
    assert both.settled_s <= 0.9 * linear.settled_s
    assert both.prediction_error.last_second is not None
    assert both.prediction_error.last_second < 1e-4
    assert both.weights_adopted >= 5
    assert both.weights_refused == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_the_last_layer_alone_overshoots_more(results: Results, seed: int) -> None:
    alone = results["dnn", seed, True]
    assert alone.overshoot["z"] > results["dnn", seed, False].overshoot["z"]
    assert alone.weights_adopted == 0


def test_the_kernel_overshoots_and_linear_mpc_is_slow(results: Results) -> None:
    assert results["l2nw", 0, False].overshoot["z"] > 0.086
    assert results["linear", 0, False].overshoot["z"] < 0.086
    assert results["linear", 0, False].J > results["l2nw", 0, False].J


def payloads(run: Run) -> dict[str, list[bytes]]:
    return {
        topic.name: [entry.payload for entry in run.entries(topic)]
        for topic in topics.ALL
        if topic is not topics.TIMING
    }


def test_a_run_is_bit_identical_for_a_seed_and_differs_for_another() -> None:
    config = load(None, ["seed=3"])
    first, second = simulate(config, 45), simulate(config, 45)
    assert payloads(first) == payloads(second)
    assert len(first.commands) == 45
    assert len(first.hidden_weights) >= 3
    other = simulate(load(None, ["seed=4"]), 45)
    assert payloads(first)["controller/command"] != payloads(other)["controller/command"]


@pytest.mark.long
def test_another_rate_settles_too() -> None:
    # Compiling a solver for one run takes longer than the run without it.
    settings = ["rate=30", "controller.horizon=90", "controller.solver.compile=never"]
    summary = summarise(simulate(load(None, settings), 300))
    assert summary.constraint_violations == 0
    assert summary.settled_s is not None


def test_progress_is_reported_step_by_step() -> None:
    told: list[int] = []
    simulate(load(None, ["controller.oracle=linear"]), 5, progress=told.append)
    assert told == [1, 2, 3, 4, 5]


def test_every_adopted_set_is_one_that_was_trained() -> None:
    run = simulate(load(None, []), 60)
    adopted = [result for result in run.results if result.weights_outcome == "adopted"]
    hashes = [weights.sha256 for weights in run.hidden_weights]
    assert [result.hidden_sha256 for result in adopted] == hashes[: len(adopted)]
    assert np.all(np.diff([result.hidden_version for result in adopted]) == 1)
