"""Hidden weights on trial: before they are adopted, and for a while after.

Both compare two networks, each with its K held still, on the controller's own labelled samples, which nobody else can
write. A set on offer must not predict the newest samples worse than the network in use; a set that was adopted must not
predict the samples that came since worse than the network that it replaced.

    worse:   mean |h_hat_new - h|^2  >  max((1 + margin) mean |h_hat_old - h|^2, floor^2)

in units of the network's output scale. Below the floor both are as good as perfect, and rounding decides nothing.

A set has one trial: the hashes of the last sets that had theirs, or were there at first, are remembered, and one that
comes again under another version is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

State = dict[str, np.ndarray]
CHECKS = 4
"""How often an adopted set is judged before it is confirmed."""
TRIED = 128
"""Sets whose hashes are remembered: of a minute or so, with a trainer that sends two a second."""
HASH_DIGITS = 15
"""Of a sha256, in hexadecimal: what an int64 can hold."""


@dataclass(frozen=True)
class Trial:
    """What a trial asks for."""

    capacity: int
    """Samples remembered, the newest."""
    stride: int
    """Every how manieth sample is remembered: a fast loop's neighbours say the same."""
    window: int
    """Samples, remembered or not, after which an adopted set is confirmed."""
    least: int = 10
    """Remembered samples without which nothing can be tried."""
    margin: float = 0.2
    """Share by which the mean squared error may be larger."""
    floor: float = 0.003
    """RMS error, of the output scale, below which a network on offer is good enough."""
    floor_after: float = 0.1
    """The same for one that was adopted."""

    @property
    def check_every(self) -> int:
        """Samples between two judgements of an adopted set."""
        return -(-self.window // CHECKS)

    def refuses(self, found: Finding) -> bool:
        """Whether a set on offer is not to be adopted."""
        return not found.new <= max((1.0 + self.margin) * found.old, self.floor**2)

    def regrets(self, found: Finding) -> bool:
        """Whether a set that was adopted is to be rolled back."""
        return not found.new <= max((1.0 + self.margin) * found.old, self.floor_after**2)


@dataclass(frozen=True)
class Finding:
    """Two mean squared errors on the same samples."""

    new: float
    old: float
    samples: int

    def __str__(self) -> str:
        return f"error {self.new**0.5:.3g} against {self.old**0.5:.3g} (RMS of {self.samples} samples, output scale)"


# -- the ring of hashes, -1 where there is none yet ------------------------------------------------------------------


def only(sha256: str) -> State:
    """One set was there from the beginning."""
    return {"tried": np.array([_number(sha256)] + [-1] * (TRIED - 1), dtype=np.int64)}


def tried(state: State, sha256: str) -> bool:
    """Whether a set with this hash had its trial already."""
    return _number(sha256) in state["tried"].tolist()


def had(state: State, sha256: str) -> State:
    """What a trial changes: this set had one. The newest is the first."""
    return {"tried": np.concatenate([[_number(sha256)], state["tried"][:-1]])}


def _number(sha256: str) -> int:
    return int(sha256[:HASH_DIGITS], 16)


# -- the ring of samples: rows (window of pairs, h / scale) ----------------------------------------------------------


def empty(trial: Trial, row: int) -> State:
    """No samples yet; `row`: entries of one."""
    return {"recent": np.zeros((trial.capacity, row)), "seen": np.zeros(1, dtype=np.int64)}


def remember(trial: Trial, state: State, *parts: np.ndarray) -> State:
    """What one more sample changes; `parts`: its row, piece by piece."""
    seen = state["seen"]
    number = int(seen[0])
    changed = {"seen": seen + 1}
    if number % trial.stride == 0:
        # Put together only here: most samples of a fast loop are not kept.
        recent = state["recent"].copy()
        np.concatenate(parts, out=recent[number // trial.stride % trial.capacity])
        changed["recent"] = recent
    return changed


def newest(trial: Trial, state: State, since: int = 0) -> np.ndarray:
    """The remembered samples numbered `since` or later, (n, row), in no particular order."""
    stride, capacity = trial.stride, trial.capacity
    end = -(-int(state["seen"][0]) // stride)
    begin = max(end - capacity, -(-since // stride))
    return state["recent"][np.arange(begin, end) % capacity]
