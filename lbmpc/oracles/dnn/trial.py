"""Trial of hidden weights before they are adopted, and for some time after.

Both trials compare two networks, each with a constant K, on the controller's own labelled samples, which no other
process can write. An offered set must not predict the newest samples worse than the network in use. An adopted set must
not predict the samples since its adoption worse than the network that it replaced.

    worse:   mean |h_hat_new - h|^2  >  max((1 + margin) mean |h_hat_old - h|^2, floor^2)

in units of the network's output scale. Below the floor both networks count as perfect, so rounding decides nothing.

A set has one trial. The hashes of the initial set and of the last tried sets are stored, and a set that is sent again
under another version is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

State = dict[str, np.ndarray]
CHECKS = 4
"""Number of judgements of an adopted set before it is confirmed."""
TRIED = 128
"""Number of stored hashes: about a minute of a trainer that sends two sets per second."""
HASH_DIGITS = 15
"""Stored hexadecimal digits of a SHA-256, limited by the size of an int64."""


@dataclass(frozen=True)
class Trial:
    """Settings of a trial."""

    capacity: int
    """Number of stored samples, the newest ones."""
    stride: int
    """Every stride-th sample is stored, because neighbouring samples of a fast loop are almost equal."""
    window: int
    """Number of samples, stored or not, after which an adopted set is confirmed."""
    least: int = 10
    """Minimum number of stored samples for a trial."""
    margin: float = 0.2
    """Share by which the mean squared error may increase."""
    floor: float = 0.003
    """RMS error, relative to the output scale, below which an offered network is accepted."""
    floor_after: float = 0.1
    """The same for an adopted network."""

    @property
    def check_every(self) -> int:
        """Number of samples between two judgements of an adopted set."""
        return -(-self.window // CHECKS)

    def refuses(self, found: Finding) -> bool:
        """Return whether an offered set must be refused."""
        return not found.new <= max((1.0 + self.margin) * found.old, self.floor**2)

    def regrets(self, found: Finding) -> bool:
        """Return whether an adopted set must be rolled back."""
        return not found.new <= max((1.0 + self.margin) * found.old, self.floor_after**2)


@dataclass(frozen=True)
class Finding:
    """Mean squared errors of two networks on the same samples."""

    new: float
    old: float
    samples: int

    def __str__(self) -> str:
        return f"error {self.new**0.5:.3g} against {self.old**0.5:.3g} (RMS of {self.samples} samples, output scale)"


# -- the ring of hashes; unused entries are -1 -----------------------------------------------------------------------


def only(sha256: str) -> State:
    """Return the ring with the initial set."""
    return {"tried": np.array([_number(sha256)] + [-1] * (TRIED - 1), dtype=np.int64)}


def tried(state: State, sha256: str) -> bool:
    """Return whether a set with this hash was tried already."""
    return _number(sha256) in state["tried"].tolist()


def had(state: State, sha256: str) -> State:
    """Return the ring with this set as newest, first entry."""
    return {"tried": np.concatenate([[_number(sha256)], state["tried"][:-1]])}


def _number(sha256: str) -> int:
    return int(sha256[:HASH_DIGITS], 16)


# -- the ring of samples: rows (window of pairs, h / scale) ----------------------------------------------------------


def empty(trial: Trial, row: int) -> State:
    """Return the empty ring; `row` is the number of entries of a sample."""
    return {"recent": np.zeros((trial.capacity, row)), "seen": np.zeros(1, dtype=np.int64)}


def remember(trial: Trial, state: State, *parts: np.ndarray) -> State:
    """Return the changes by one more sample; `parts` are the pieces of its row."""
    seen = state["seen"]
    number = int(seen[0])
    changed = {"seen": seen + 1}
    if number % trial.stride == 0:
        # The row is assembled only here, because most samples of a fast loop are not stored.
        recent = state["recent"].copy()
        np.concatenate(parts, out=recent[number // trial.stride % trial.capacity])
        changed["recent"] = recent
    return changed


def newest(trial: Trial, state: State, since: int = 0) -> np.ndarray:
    """Return the stored samples with number `since` or later, (n, row), in no particular order."""
    stride, capacity = trial.stride, trial.capacity
    end = -(-int(state["seen"][0]) // stride)
    begin = max(end - capacity, -(-since // stride))
    return state["recent"][np.arange(begin, end) % capacity]
