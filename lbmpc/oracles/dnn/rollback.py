"""The reference network for a rollback: the network before an adoption. It is part of an oracle's state.

A set adopted while another one is still under observation does not turn that one into the reference. Otherwise, in a
sequence of sets that each are slightly worse than the last, every set would be compared with a similar one. The
reference changes when it is a whole window old and the set in use has been in use for part of a window.
"""

from __future__ import annotations

import numpy as np

from lbmpc.oracles.dnn.trial import State, Trial

SETTLED = 0.35
"""Share of a window for which a set must be in use to become the reference. A trainer sends two or three sets in that
time. More frequent sets are compared with the network before them."""
# Entries of `watch`, in samples seen: 1 while a set is under observation; end of the reference's use; adoption of the
# set in use; time of its confirmation; version of the reference.
ON, SINCE, ADOPTED, UNTIL, VERSION = range(5)


def nothing(hidden: list[np.ndarray], last: State) -> State:
    """Return the entries without a reference; `last` is K and the law's memory."""
    entries: State = {f"before.W{i + 1}": np.zeros(layer.shape, np.float32) for i, layer in enumerate(hidden)}
    entries |= {f"before.{name}": np.zeros(array.shape) for name, array in last.items()}
    entries["adopted.K"] = np.zeros(last["K"].shape)
    entries["watch"] = np.zeros(5, dtype=np.int64)
    return entries


def adopted(trial: Trial, state: State, hidden: list[np.ndarray], K: np.ndarray) -> State:
    """Return the changes by an adoption; `state` and `hidden` are from before it, K is the initial K of the new set."""
    on, left, since_when, _until, version = (int(value) for value in state["watch"])
    now = int(state["seen"][0])
    settled = now - left >= trial.window and now - since_when >= SETTLED * trial.window
    changed: State = {"adopted.K": K}
    if not on or settled:
        # Hidden layers have float32 values.
        changed |= {f"before.W{i + 1}": layer.astype(np.float32) for i, layer in enumerate(hidden)}
        changed |= {f"before.{name}": state[name] for name in _last(state)}
        left, version = now, int(state["version"][0])
    changed["watch"] = np.array([1, left, now, now + trial.window, version], dtype=np.int64)
    return changed


def due(trial: Trial, state: State) -> bool:
    """Return whether the set in use must be judged now."""
    watched = state["watch"].tolist()
    if not watched[ON]:
        return False
    seen = int(state["seen"][0])
    return (seen - watched[ADOPTED]) % trial.check_every == 0 or seen >= watched[UNTIL]


def ends(state: State) -> bool:
    """Return whether the set in use is confirmed after the present judgement."""
    return bool(state["seen"][0] >= state["watch"][UNTIL])


def over(state: State) -> State:
    """Return the changes at the end of an observation."""
    layers = [array for name, array in state.items() if name.startswith("before.W")]
    return nothing(layers, _last(state))


def since(state: State) -> int:
    """Return the number of the first sample after the reference went out of use."""
    return int(state["watch"][SINCE])


def version(state: State) -> int:
    """Return the version of the reference."""
    return int(state["watch"][VERSION])


def before(state: State, layers: int) -> tuple[list[np.ndarray], State]:
    """Return the reference: hidden layers, and the last layer with the law's memory."""
    hidden = [state[f"before.W{i + 1}"].astype(float) for i in range(layers)]
    return hidden, {name: state[f"before.{name}"] for name in _last(state)}


def K_adopted(state: State) -> np.ndarray:
    """Return the initial K of the set in use."""
    return state["adopted.K"]


def _last(state: State) -> State:
    """Return K and the law's memory: the entries of a reference besides the hidden layers."""
    names = [name.removeprefix("before.") for name in state if name.startswith("before.")]
    return {name: state[name] for name in names if not name.startswith("W")}
