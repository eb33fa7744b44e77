"""The controller's last samples, including earlier runs after a restart, for a trainer that joins late."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Sequence

import numpy as np

from protocol import codec
from protocol.messages import Sample, Samples

CAPACITY = 20_000
BATCH = 500


class Outbox:
    """The newest `capacity` samples of one controller run. Any thread may call.

    They are stored in a ring that has its full size from the first sample on, so a controller needs no more memory
    after hours than after a minute.

    earlier: batches of the runs that this one continues, oldest first.
    """

    def __init__(self, run_id: str, capacity: int = CAPACITY, earlier: Sequence[Samples] = ()):
        self.run_id = run_id
        self.earlier = tuple(earlier)
        self._capacity = capacity
        self._count = 0
        self._seqs = np.full(capacity, -1, dtype=np.int64)
        self._rows: np.ndarray | None = None
        self._sizes = (0, 0, 0)
        self._lock = threading.Lock()

    def add(self, sample: Sample) -> None:
        """Add a sample. Samples must have ascending `seq` and the same plant. The oldest is dropped if necessary."""
        row = [*sample.x, *sample.u, *sample.h, *itertools.chain.from_iterable(sample.past)]
        with self._lock:
            if self._rows is None:
                # NaN is written to allocate the memory now.
                self._rows = np.full((self._capacity, len(row)), np.nan)
                self._sizes = (len(sample.x), len(sample.u), len(sample.h))
            slot = self._count % self._capacity
            self._seqs[slot], self._rows[slot] = sample.seq, row
            self._count += 1

    def since(self, seq: int, last: int = CAPACITY) -> list[Sample]:
        """Return the samples after `seq`, ascending, limited to the newest `last`."""
        with self._lock:
            if self._rows is None:
                return []
            kept = np.arange(max(0, self._count - self._capacity), self._count) % self._capacity
            kept = kept[self._seqs[kept] > seq]
            kept = kept[max(0, len(kept) - max(0, last)) :]
            seqs, rows = self._seqs[kept].tolist(), self._rows[kept].tolist()
        return [self._sample(number, row) for number, row in zip(seqs, rows, strict=True)]

    def _sample(self, seq: int, row: list[float]) -> Sample:
        d, m, h = self._sizes
        past = row[d + m + h :]
        pairs = [past[k : k + d + m] for k in range(0, len(past), d + m)]
        return Sample(seq, row[:d], row[d : d + m], row[d + m : d + m + h], pairs)

    def batches(self, samples: list[Sample]) -> list[Samples]:
        """Return the samples as messages of at most `BATCH` pairs each, including the pairs of their past."""
        size = max(1, BATCH // (1 + len(samples[0].past))) if samples else BATCH
        parts = (samples[i : i + size] for i in range(0, len(samples), size))
        return [Samples(run_id=self.run_id, seq=part[-1].seq, samples=part) for part in parts]

    def answer(self, parameters: dict[str, str]) -> list[bytes]:
        """Answer `?run=RUN;since=SEQ;last=K` with encoded `Samples`; [] for another run, or without samples.

        A query for all samples from the start also gets those of earlier runs, under the ids of those runs.

        Raises:
            ValueError: a parameter is unknown or not a number.
        """
        unknown = parameters.keys() - {"run", "since", "last"}
        if unknown:
            raise ValueError(f"unknown parameter {min(unknown)!r}; known are run, since, last")
        if parameters.get("run", "") not in ("", self.run_id):
            return []
        since, last = _number(parameters, "since", -1), _number(parameters, "last", CAPACITY)
        own = self.since(since, last)
        earlier = self._earlier(last - len(own)) if since < 0 else []
        return [codec.encode(batch) for batch in (*earlier, *self.batches(own))]

    def _earlier(self, room: int) -> list[Samples]:
        """Return the newest batches of earlier runs that fit into `room` samples."""
        found: list[Samples] = []
        for batch in reversed(self.earlier):
            room -= len(batch.samples)
            if room < 0:
                break
            found.append(batch)
        return found[::-1]


def _number(parameters: dict[str, str], name: str, default: int) -> int:
    text = parameters.get(name, "")
    if not text:
        return default
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{name} = {text[:40]!r} is not a whole number") from None
