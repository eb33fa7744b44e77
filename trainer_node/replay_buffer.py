"""The replay buffer: it stores every sample until p_max and then replaces samples by a selected rule."""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from node_runtime.config.literals import Strategy

STRETCHES = 10_000
"""Number of intervals of sequence numbers stored for one run."""
RUNS = 8
"""Number of runs whose sequence numbers are stored."""
STALE_LOOKS = 16
"""Largest number of outdated nearest neighbours that one insertion recomputes, which keeps it O(capacity)."""


class Seen:
    """Remembers the seen samples by (run_id, seq) in bounded memory.

    Sequence numbers are stored as contiguous intervals, so memory does not grow with the length of a run. If a run has
    more than `stretches` intervals, its oldest gap counts as seen.
    """

    def __init__(self, stretches: int = STRETCHES, runs: int = RUNS):
        self._stretches = stretches
        self._runs = runs
        self._known: OrderedDict[str, tuple[list[int], list[int]]] = OrderedDict()
        """First and last numbers of every interval, ascending, by run."""

    def add(self, run_id: str, seq: int) -> bool:
        """Add a sample; return whether it was new."""
        if run_id not in self._known:
            self._known[run_id] = [], []
            while len(self._known) > self._runs:
                self._known.popitem(last=False)
        first, last = self._known[run_id]
        after = bisect_right(first, seq)
        if after and seq <= last[after - 1]:
            return False
        goes_on = after > 0 and last[after - 1] == seq - 1
        meets = after < len(first) and first[after] == seq + 1
        if goes_on and meets:
            del last[after - 1], first[after]
        elif goes_on:
            last[after - 1] = seq
        elif meets:
            first[after] = seq
        else:
            first.insert(after, seq)
            last.insert(after, seq)
            if len(first) > self._stretches:
                del last[0], first[1]
        return True

    def last(self, run_id: str) -> int:
        """Return the newest sequence number of a run, -1 if there is none."""
        _, last = self._known.get(run_id, ([], []))
        return last[-1] if last else -1


class ReplayBuffer:
    """Up to `capacity` samples (x, u, h), or (window, h) for a network with a window.

    Strategies for a full buffer:
        fifo: the oldest sample is replaced.
        reservoir: Vitter's algorithm R; every sample offered so far is kept with the same probability.
        novelty: of the closest pair among the stored samples and the new one, the younger is dropped. The distance is
            Euclidean, with (x, u) in units of `scale`. A sample that is nearer to a stored one than any two stored ones
            are to each other is not stored. A plant at rest thus cannot displace the samples of its approach. Labels of
            a known region are not renewed, however, so a changing plant needs another strategy.

    Args:
        capacity: p_max.
        strategy: one of the above.
        seed: seed of the reservoir.
        scale: units of (x, u) that count as 1, (d + m,), or of a window of k pairs, (k (d + m),).

    The same samples in the same order with the same seed give the same buffer, byte for byte.
    """

    def __init__(self, capacity: int, strategy: Strategy, seed: int, scale: list[float]):
        self.capacity = capacity
        self.strategy: Strategy = strategy
        self._scale = np.asarray(scale, dtype=np.float64)
        self._rng = np.random.default_rng([seed, 0x5EED])
        self._seen = Seen()
        self._length = 0
        self.offered = 0
        """Number of different samples offered so far."""
        self._next = 0
        self._xu = np.empty((0, len(self._scale)))
        self._h = np.empty((0, 0))
        self._pairs = _ClosestPairs(capacity, len(scale)) if strategy == "novelty" else None

    def __len__(self) -> int:
        return self._length

    def last(self, run_id: str) -> int:
        """Return the newest sequence number seen of a run, -1 if there is none."""
        return self._seen.last(run_id)

    def add(self, run_id: str, seqs: Sequence[int], windows: np.ndarray, h: np.ndarray) -> int:
        """Offer samples in order: windows (n, k (d + m)), h (n, d). Return how many were new.

        Raises:
            ValueError: a length is wrong or a number is not finite. Nothing is stored then.
        """
        width = self._h.shape[1] if self._length else h.shape[1]
        if windows.shape[1:] != self._scale.shape or h.shape[1] != width or len(h) != len(windows):
            raise ValueError(
                f"the window has {windows.shape[1]} entries, expected {len(self._scale)}; h has {h.shape[1]}"
            )
        if not (np.isfinite(windows).all() and np.isfinite(h).all()):
            raise ValueError("not finite")
        new = [k for k, seq in enumerate(seqs) if self._seen.add(run_id, seq)]
        if self.strategy == "fifo":
            self._store_in_turn(windows[new], h[new])
            return len(new)
        for k in new:
            self.offered += 1
            slot = self._slot(windows[k] / self._scale)
            if slot is not None:
                self._store(slot, windows[k], h[k])
        return len(new)

    def sample(self, M: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return M different random samples, or all if there are fewer: windows (M, k (d + m)), and h (M, d)."""
        chosen = rng.permutation(self._length)[:M]
        return self._xu[chosen], self._h[chosen]

    def contents(self) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of all stored samples: windows (len, k (d + m)), and h (len, d)."""
        return self._xu[: self._length].copy(), self._h[: self._length].copy()

    def _slot(self, scaled: np.ndarray) -> int | None:
        """Return the slot for a sample, or None if it is not stored."""
        if self._pairs is not None:
            return self._pairs.insert(scaled)
        if self._length < self.capacity:
            return self._length
        drawn = int(self._rng.integers(self.offered))
        return drawn if drawn < self.capacity else None

    def _store(self, slot: int, xu: np.ndarray, h: np.ndarray) -> None:
        self._make_room(slot + 1, len(h))
        self._xu[slot], self._h[slot] = xu, h
        self._length = max(self._length, slot + 1)

    def _store_in_turn(self, xu: np.ndarray, h: np.ndarray) -> None:
        """Store several samples by first in, first out, in a ring."""
        n = len(xu)
        if not n:
            return
        self._make_room(min(self.capacity, self._length + n), h.shape[1])
        slots = (self._next + np.arange(n)) % self.capacity
        # If there are more than the buffer holds, the last ones are stored.
        kept = slice(max(0, n - self.capacity), n)
        self._xu[slots[kept]], self._h[slots[kept]] = xu[kept], h[kept]
        self._length = min(self.capacity, self._length + n)
        self._next = (self._next + n) % self.capacity
        self.offered += n

    def _make_room(self, length: int, labels: int) -> None:
        if length > len(self._xu):
            room = min(self.capacity, max(256, 2 * len(self._xu), length))
            self._xu.resize((room, len(self._scale)), refcheck=False)
            self._h.resize((room, labels), refcheck=False)


class _ClosestPairs:
    """The `novelty` rule: points with their nearest neighbours, with O(capacity) per insertion.

    If a point is removed, the distances of points with this nearest neighbour become lower bounds. They are recomputed
    only when one of them is the smallest.
    """

    def __init__(self, capacity: int, dimensions: int):
        self._capacity = capacity
        self._points = np.empty((0, dimensions))
        self._nearest = np.empty(0)
        self._neighbour = np.empty(0, dtype=np.int64)
        self._born = np.empty(0, dtype=np.int64)
        self._length = 0
        self._births = 0

    def insert(self, point: np.ndarray) -> int | None:
        """Return the slot of the inserted point, or None if it is the younger one of the closest pair."""
        distances = self._distances(point)
        if self._length < self._capacity:
            slot = self._length
            if slot == len(self._points):
                room = min(self._capacity, max(256, 2 * slot))
                self._points.resize((room, len(point)), refcheck=False)
                for figures in (self._nearest, self._neighbour, self._born):
                    figures.resize(room, refcheck=False)
            self._length += 1
        else:
            one, other = self._closest()
            if distances.min() <= self._nearest[one]:
                return None
            slot = one if self._born[one] > self._born[other] else other
            self._neighbour[self._neighbour == slot] = -1
            distances[slot] = np.inf
        self._place(slot, point, distances)
        return slot

    def _place(self, slot: int, point: np.ndarray, distances: np.ndarray) -> None:
        self._points[slot] = point
        self._born[slot] = self._births
        self._births += 1
        nearest, neighbour = self._nearest[: len(distances)], self._neighbour[: len(distances)]
        closer = distances < nearest
        nearest[closer], neighbour[closer] = distances[closer], slot
        self._settle(slot, distances)

    def _settle(self, slot: int, distances: np.ndarray) -> None:
        if len(distances) and np.isfinite(distances).any():
            found = int(distances.argmin())
            self._nearest[slot], self._neighbour[slot] = distances[found], found
        else:
            self._nearest[slot], self._neighbour[slot] = np.inf, -1

    def _closest(self) -> tuple[int, int]:
        """Return the closest stored pair; a single point is returned twice."""
        if self._length == 1:
            return 0, 0
        for _ in range(STALE_LOOKS):
            first = int(self._nearest[: self._length].argmin())
            if self._neighbour[first] >= 0:
                break
            self._look_up(first)
        else:
            self._look_up(first)
        return first, int(self._neighbour[first])

    def _look_up(self, slot: int) -> None:
        distances = self._distances(self._points[slot])
        distances[slot] = np.inf
        self._settle(slot, distances)

    def _distances(self, point: np.ndarray) -> np.ndarray:
        difference = self._points[: self._length] - point
        return np.einsum("ij,ij->i", difference, difference)
