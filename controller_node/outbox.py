"""The controller's last samples, kept for a trainer that joins late."""

from __future__ import annotations

import threading
from collections import deque

from protocol import codec
from protocol.messages import Sample, Samples

CAPACITY = 20_000
BATCH = 500


class Outbox:
    """The newest `capacity` samples of one controller run. Any thread may call."""

    def __init__(self, run_id: str, capacity: int = CAPACITY):
        self.run_id = run_id
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

        Raises:
            ValueError: a parameter that is unknown or not a number.
        """
        unknown = parameters.keys() - {"run", "since", "last"}
        if unknown:
            raise ValueError(f"unknown parameter {min(unknown)!r}; known are run, since, last")
        if parameters.get("run", "") not in ("", self.run_id):
            return []
        since, last = _number(parameters, "since", -1), _number(parameters, "last", CAPACITY)
        return [codec.encode(batch) for batch in self.batches(self.since(since, last))]


def _number(parameters: dict[str, str], name: str, default: int) -> int:
    text = parameters.get(name, "")
    if not text:
        return default
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{name} = {text[:40]!r} is not a whole number") from None
