"""The replay buffer: its contents for each strategy, no repetitions, and reproducibility."""

from __future__ import annotations

import time
import tracemalloc
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from node_runtime.config.literals import Strategy
from trainer_node.replay_buffer import ReplayBuffer, Seen

STRATEGIES: list[Strategy] = ["fifo", "reservoir", "novelty"]
SCALE = [0.5, 2.0, 1.0]


def add(buffer: ReplayBuffer, run: str, seq: int, xu: ArrayLike, h: ArrayLike) -> bool:
    """Add one sample; return whether it is new."""
    return buffer.add(run, [seq], np.array([xu], dtype=float), np.array([h], dtype=float)) == 1


def offer(buffer: ReplayBuffer, points: np.ndarray, run: str = "run-1", first: int = 0) -> None:
    """Offer points (n, 3) as (x, u) with 2 states; h identifies the point."""
    for i, point in enumerate(points, start=first):
        assert add(buffer, run, i, point, [float(i), -float(i)])


def kept(buffer: ReplayBuffer) -> list[int]:
    """Return the stored sequence numbers, ascending."""
    return sorted(int(h) for h in buffer.contents()[1][:, 0])


def closest_pair(points: np.ndarray) -> float:
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    return float(distances[np.triu_indices(len(points), 1)].min())


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(STRATEGIES),
    st.integers(1, 12),
    st.integers(0, 3),
    st.lists(
        st.tuples(st.sampled_from(["a", "b"]), st.integers(0, 30), st.tuples(*[st.integers(-2, 2)] * 3)),
        max_size=60,
    ),
)
def test_samples_are_stored_once_consistently_and_within_capacity(
    strategy: Strategy, capacity: int, seed: int, offers: list[tuple[str, int, tuple[int, int, int]]]
) -> None:
    buffers = [ReplayBuffer(capacity, strategy, seed, SCALE) for _ in range(2)]
    met: dict[tuple[str, int], tuple[int, int, int]] = {}
    for run, seq, point in offers:
        for buffer in buffers:
            new = add(buffer, run, seq, point, [float(seq), 1000.0 * (run == "b")])
            assert new == ((run, seq) not in met)
        met.setdefault((run, seq), point)
    assert len(buffers[0]) == min(capacity, len(met))
    assert buffers[0].offered == len(met)
    xu, h = buffers[0].contents()
    stored = [("b" if label[1] else "a", int(label[0])) for label in h]
    assert len(set(stored)) == len(stored)
    assert all(tuple(point) == met[which] for point, which in zip(xu, stored, strict=True))
    for one, other in zip(buffers[0].contents(), buffers[1].contents(), strict=True):
        assert one.tobytes() == other.tobytes()


def test_fifo_keeps_the_newest() -> None:
    buffer = ReplayBuffer(10, "fifo", 0, SCALE)
    offer(buffer, np.random.default_rng(0).normal(size=(37, 3)))
    assert kept(buffer) == list(range(27, 37))


def test_samples_before_a_controllers_restart_are_kept() -> None:
    buffer = ReplayBuffer(10, "fifo", 0, SCALE)
    points = np.random.default_rng(0).normal(size=(4, 3))
    offer(buffer, points, "run-1")
    assert buffer.last("run-2") == -1
    offer(buffer, points, "run-2")
    assert len(buffer) == 8
    assert buffer.last("run-1") == buffer.last("run-2") == 3
    assert not add(buffer, "run-1", 3, points[3], np.zeros(2))


def test_the_reservoir_keeps_every_sample_with_the_same_probability() -> None:
    capacity, offered, repetitions = 20, 100, 400
    counts = np.zeros(offered)
    points = np.zeros((offered, 3))
    for seed in range(repetitions):
        buffer = ReplayBuffer(capacity, "reservoir", seed, SCALE)
        offer(buffer, points)
        counts[kept(buffer)] += 1
    p = capacity / offered
    z = (counts - repetitions * p) / np.sqrt(repetitions * p * (1 - p))
    # The sum of 100 squared standard normal variables is 100 +- 14.
    assert 60 < np.sum(z**2) < 140
    assert np.abs(z.reshape(4, -1).mean(axis=1)).max() < 0.6


def settling(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return (n, 3): a spiral into the origin that then stays there, with noise."""
    t = np.arange(n)
    decay = np.exp(-t / 60.0)
    path = np.stack([decay * np.cos(t / 10), decay * np.sin(t / 10), decay], axis=1)
    return path + 1e-3 * rng.normal(size=(n, 3))


def spread(buffer: ReplayBuffer) -> float:
    """Return the mean distance to the centre, in units of the scale."""
    points = buffer.contents()[0] / np.asarray(SCALE)
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).mean())


def uncovered(buffer: ReplayBuffer, points: np.ndarray) -> float:
    """Return the largest distance of an offered point from the nearest stored one, in units of the scale."""
    stored = buffer.contents()[0] / np.asarray(SCALE)
    return float(np.linalg.norm((points / SCALE)[:, None] - stored[None], axis=2).min(axis=1).max())


def test_novelty_keeps_the_spread_of_a_trajectory_that_settles() -> None:
    points = settling(2000, np.random.default_rng(3))
    buffers = {name: ReplayBuffer(100, name, 0, SCALE) for name in STRATEGIES}
    for buffer in buffers.values():
        offer(buffer, points)
    assert spread(buffers["novelty"]) > 3 * spread(buffers["reservoir"]) > 3 * spread(buffers["fifo"])
    # No region of the trajectory is lost.
    assert 2 * uncovered(buffers["novelty"], points) < uncovered(buffers["reservoir"], points)


def test_novelty_accepts_new_points_after_a_long_rest() -> None:
    buffer = ReplayBuffer(50, "novelty", 0, SCALE)
    rng = np.random.default_rng(0)
    offer(buffer, 1e-3 * rng.normal(size=(500, 3)))
    excursion = np.linspace(0.1, 2.0, 20)[:, None] * np.ones(3)
    offer(buffer, excursion, first=500)
    assert set(range(500, 520)) <= set(kept(buffer))


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 15), st.integers(0, 10_000), st.booleans())
def test_novelty_drops_the_younger_of_the_closest_pair(capacity: int, seed: int, grid: bool) -> None:
    """The result is compared with a direct evaluation of all pairs. On a grid many distances are equal."""
    rng = np.random.default_rng(seed)
    points = rng.integers(-2, 3, (60, 3)).astype(float) if grid else rng.normal(size=(60, 3))
    buffer = ReplayBuffer(capacity, "novelty", 0, [1.0] * 3)
    offer(buffer, points[:capacity])
    for i in range(capacity, len(points)):
        before = kept(buffer)
        offer(buffer, points[i : i + 1], first=i)
        everything = points[[*before, i]]
        gone = {*before, i} - set(kept(buffer))
        assert len(gone) == 1
        youngest = gone.pop()
        shortest = closest_pair(everything)
        others = [j for j in [*before, i] if j != youngest]
        to_others = np.linalg.norm(points[others] - points[youngest], axis=1)
        assert to_others.min() == pytest.approx(shortest, rel=1e-9, abs=1e-12)
        partners = [j for j, d in zip(others, to_others, strict=True) if d <= shortest * (1 + 1e-9)]
        assert min(partners) < youngest


def test_a_novelty_insertion_takes_time_proportional_to_the_capacity() -> None:
    rng = np.random.default_rng(0)
    taken = []
    for capacity in (500, 4000):
        buffer = ReplayBuffer(capacity, "novelty", 0, SCALE)
        offer(buffer, rng.normal(size=(capacity, 3)))
        start = time.thread_time()
        offer(buffer, rng.normal(size=(300, 3)) * 3, first=capacity)
        taken.append((time.thread_time() - start) / 300)
    # For 8 times the capacity; evaluating all pairs would take 64 times as long.
    assert taken[1] / taken[0] < 24, taken
    assert taken[1] < 5e-3


def test_samples_are_drawn_without_replacement() -> None:
    buffer = ReplayBuffer(50, "fifo", 0, SCALE)
    offer(buffer, np.random.default_rng(0).normal(size=(50, 3)))
    rng = np.random.default_rng(7)
    seen = np.zeros(50)
    for _ in range(200):
        xu, h = buffer.sample(20, rng)
        assert xu.shape == (20, 3)
        assert len(set(h[:, 0])) == 20
        seen[h[:, 0].astype(int)] += 1
    assert seen.min() > 50
    assert len(buffer.sample(500, rng)[0]) == 50
    again = [ReplayBuffer.sample(buffer, 9, np.random.default_rng(5))[1] for _ in range(2)]
    assert again[0].tobytes() == again[1].tobytes()


@pytest.mark.parametrize(
    ("x", "u", "h"),
    [
        ([0.0, np.nan], [0.0], [0.0, 0.0]),
        ([0.0, 0.0], [np.inf], [0.0, 0.0]),
        ([0.0, 0.0], [0.0], [0.0, np.nan]),
        ([0.0, 0.0, 0.0], [0.0], [0.0, 0.0]),
        ([0.0, 0.0], [0.0], [0.0]),
    ],
)
def test_invalid_samples_are_refused_and_can_be_sent_again(
    x: list[float], u: list[float], h: list[float]
) -> None:
    buffer = ReplayBuffer(5, "fifo", 0, SCALE)
    offer(buffer, np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"not finite|entries"):
        add(buffer, "run-1", 1, [*x, *u], h)
    assert len(buffer) == 1
    assert add(buffer, "run-1", 1, np.zeros(3), np.zeros(2))


def test_a_sample_is_new_once_in_any_order() -> None:
    rng = np.random.default_rng(11)
    seen, met = Seen(), set[int]()
    # The sequence has intervals, gaps that are filled later, and repetitions.
    for seq in [*rng.permutation(300), *range(250, 400), *rng.integers(0, 600, 2000)]:
        assert seen.add("a", int(seq)) == (int(seq) not in met)
        met.add(int(seq))
        assert seen.last("a") == max(met)


def test_the_memory_of_sequence_numbers_is_bounded() -> None:
    seen = Seen(stretches=100, runs=2)
    order = [*range(0, 1000, 3), *range(999, 0, -1)]
    new = [seq for seq in order if seen.add("a", seq)]
    assert len(set(new)) == len(new)
    # Recent gaps can still be filled, old ones cannot.
    assert set(range(900, 1000)) <= set(new)
    assert 1 not in new
    assert seen.last("a") == 999
    for run in ("b", "c"):
        assert seen.add(run, 0)
    assert seen.last("a") == -1


def test_a_long_run_takes_no_more_memory_than_a_short_one() -> None:
    def memory(samples: int) -> int:
        tracemalloc.start()
        seen = Seen()
        # Every second sample is late, so that the gaps close later.
        for seq in [*range(0, samples, 2), *range(1, samples, 2)]:
            seen.add("a", seq)
        found = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        return found

    assert memory(16_000) < memory(1000) + 1000


@pytest.mark.parametrize("strategy", ["fifo", "reservoir", "novelty"])
def test_batches_equal_single_samples(strategy: Strategy) -> None:
    rng = np.random.default_rng(8)
    one, many = (ReplayBuffer(20, strategy, 3, [1.0, 2.0, 0.5]) for _ in range(2))
    seq = 0
    # The batches fill the buffer, wrap around, exceed it, and repeat some samples.
    for size in (1, 7, 11, 4, 30, 0, 45, 20, 3):
        seqs = [max(0, seq + k - 2) for k in range(size)]
        seq += size
        windows, h = rng.normal(size=(size, 3)), rng.normal(size=(size, 2))
        new = sum(add(one, "a", s, w, label) for s, w, label in zip(seqs, windows, h, strict=True))
        assert many.add("a", seqs, windows, h) == new
        for left, right in zip(one.contents(), many.contents(), strict=True):
            assert left.tobytes() == right.tobytes()
        assert (one.offered, one.last("a")) == (many.offered, many.last("a"))


def test_fifo_with_batches_is_a_bounded_queue() -> None:
    rng = np.random.default_rng(9)
    buffer, queue, seq = ReplayBuffer(20, "fifo", 3, [1.0, 2.0, 0.5]), deque[bytes](maxlen=20), 0
    for size in (1, 7, 11, 4, 30, 45, 20, 3, 20, 40):
        windows, h = rng.normal(size=(size, 3)), rng.normal(size=(size, 2))
        buffer.add("a", range(seq, seq + size), windows, h)
        seq += size
        queue.extend(np.concatenate(pair).tobytes() for pair in zip(windows, h, strict=True))
        held = [np.concatenate(pair).tobytes() for pair in zip(*buffer.contents(), strict=True)]
        assert sorted(held) == sorted(queue)


def test_a_bad_sample_rejects_its_whole_batch() -> None:
    buffer = ReplayBuffer(20, "fifo", 3, [1.0, 2.0, 0.5])
    windows, h = np.zeros((3, 3)), np.zeros((3, 2))
    windows[1, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        buffer.add("a", [0, 1, 2], windows, h)
    with pytest.raises(ValueError, match="expected 3"):
        buffer.add("a", [0, 1, 2], windows[:, :2], h)
    assert (len(buffer), buffer.last("a")) == (0, -1)
