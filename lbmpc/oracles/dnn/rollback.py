"""The network that an adopted set replaced, kept until the set is confirmed: part of an oracle's state.

A set that is adopted while another one is still watched does not take that one's place as the reference, or a row of
sets, each a little worse than the one before, would be compared with its like only. The reference moves on when it is a
whole window old and what is in use has been in use for a part of one.
"""

from __future__ import annotations

import numpy as np

from lbmpc.oracles.dnn.trial import State, Trial

SETTLED = 0.35
"""Share of a window for which a set must have been in use to become the reference: a trainer sends two or three sets in
that time, whoever sends more is measured against what was there before them."""
# Entries of `watch`, in samples seen: 1 while it is on; when the reference was left; when the set in use was adopted;
# when it is confirmed; the reference's version.
ON, SINCE, ADOPTED, UNTIL, VERSION = range(5)


def nothing(hidden: list[np.ndarray], last: State) -> State:
    """Nothing to be confirmed; last: K and what its law remembers beside it."""
    entries: State = {f"before.W{i + 1}": np.zeros(layer.shape, np.float32) for i, layer in enumerate(hidden)}
    entries |= {f"before.{name}": np.zeros(array.shape) for name, array in last.items()}
    entries["adopted.K"] = np.zeros(last["K"].shape)
    entries["watch"] = np.zeros(5, dtype=np.int64)
    return entries


def adopted(trial: Trial, state: State, hidden: list[np.ndarray], K: np.ndarray) -> State:
    """What an adoption changes; `state`, `hidden`: from before it, K: what the new set begins with."""
    on, left, since_when, _until, version = (int(value) for value in state["watch"])
    now = int(state["seen"][0])
    settled = now - left >= trial.window and now - since_when >= SETTLED * trial.window
    changed: State = {"adopted.K": K}
    if not on or settled:
        # Hidden layers are float32 values.
        changed |= {f"before.W{i + 1}": layer.astype(np.float32) for i, layer in enumerate(hidden)}
        changed |= {f"before.{name}": state[name] for name in _last(state)}
        left, version = now, int(state["version"][0])
    changed["watch"] = np.array([1, left, now, now + trial.window, version], dtype=np.int64)
    return changed


def due(trial: Trial, state: State) -> bool:
    """Whether it is time to judge the set in use."""
    watched = state["watch"].tolist()
    if not watched[ON]:
        return False
    seen = int(state["seen"][0])
    return (seen - watched[ADOPTED]) % trial.check_every == 0 or seen >= watched[UNTIL]


def ends(state: State) -> bool:
    """Whether the set in use is confirmed once it has been judged now."""
    return bool(state["seen"][0] >= state["watch"][UNTIL])


def over(state: State) -> State:
    """What the end of a watch changes."""
    layers = [array for name, array in state.items() if name.startswith("before.W")]
    return nothing(layers, _last(state))


def since(state: State) -> int:
    """Number of the first sample after the reference was left."""
    return int(state["watch"][SINCE])


def version(state: State) -> int:
    """The reference's."""
    return int(state["watch"][VERSION])


def before(state: State, layers: int) -> tuple[list[np.ndarray], State]:
    """The reference: hidden layers, and the last one with what its law remembered, as they were."""
    hidden = [state[f"before.W{i + 1}"].astype(float) for i in range(layers)]
    return hidden, {name: state[f"before.{name}"] for name in _last(state)}


def K_adopted(state: State) -> np.ndarray:
    """K with which the set in use began."""
    return state["adopted.K"]


def _last(state: State) -> State:
    """K and what its law remembers beside it: what a reference holds besides hidden layers."""
    names = [name.removeprefix("before.") for name in state if name.startswith("before.")]
    return {name: state[name] for name in names if not name.startswith("W")}
