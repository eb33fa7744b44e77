"""The controller's last samples, kept for a trainer that joins late; after a restart those of the runs before too."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

from protocol import codec
from protocol.messages import Sample, Samples

CAPACITY = 20_000
BATCH = 500


class Outbox:
    """The newest `capacity` samples of one controller run. Any thread may call.

    earlier: batches of the runs that this one goes on from, oldest first.
    """

    def __init__(self, run_id: str, capacity: int = CAPACITY, earlier: Sequence[Samples] = ()):
        self.run_id = run_id
        self.earlier = tuple(earlier)
        self._samples: deque[Sample] = deque(maxlen=capacity)
        self._lock = threading.Lock()

    def add(self, sample: Sample) -> None:
        """Samples come in ascending order of `seq`; the oldest makes room."""
        with self._lock:
            self._samples.append(sample)

    def since(self, seq: int, last: int = CAPACITY) -> list[Sample]:
        """Samples after `seq`, ascending; of those, the newest `last`."""
        found: list[Sample] = []
        with self._lock:
            for sample in reversed(self._samples):
                if sample.seq <= seq or len(found) >= last:
                    break
                found.append(sample)
        found.reverse()
        return found

    def batches(self, samples: list[Sample]) -> list[Samples]:
        """The same samples as messages of at most `BATCH` pairs each, those of their past included."""
        size = max(1, BATCH // (1 + len(samples[0].past))) if samples else BATCH
        parts = (samples[i : i + size] for i in range(0, len(samples), size))
        return [Samples(run_id=self.run_id, seq=part[-1].seq, samples=part) for part in parts]

    def answer(self, parameters: dict[str, str]) -> list[bytes]:
        """Answer `?run=RUN;since=SEQ;last=K`: encoded `Samples`; [] for another run, or when there are none.

        Who asks for all, from the beginning, gets those of earlier runs too, under the names of those runs.

        Raises:
            ValueError: a parameter that is unknown or not a number.
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
        """The newest batches of earlier runs that have room."""
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
