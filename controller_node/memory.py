"""A controller's memory for others: keyframes, checkpoints, and the hidden layers for a trainer."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Literal

import msgspec
import numpy as np

from lbmpc.controller.state import ControllerState
from lbmpc.controller.step import Controller
from network_model.description import hash_layers
from node_runtime.config.sections import Config
from protocol import messages as m

GIVEN = ("target", "reference.")
"""Prefixes of arrays that exist only after a reference was given."""
WIRE: dict[str, Literal["<i8", "<f8", "<f4"]] = {"int64": "<i8", "float64": "<f8", "float32": "<f4"}


class Memory:
    """The state of one controller.

    Args:
        controller: the controller.
        config: the resolved configuration.
        run_id: written into every message.
    """

    def __init__(self, controller: Controller, config: Config, run_id: str):
        self._controller, self._config, self._run_id = controller, config, run_id
        self.state: ControllerState = controller.initial_state(config.seed)
        self._resumed = ""
        self._hash_hidden()

    def advance(self, state: ControllerState, new_network: bool) -> None:
        """Take over the state after a step; `new_network` says whether its hidden layers changed."""
        self.state = state
        if new_network:
            self._hash_hidden()

    def _hash_hidden(self) -> None:
        network = self._controller.oracle.network(self.state.oracle)
        self.hidden_sha256 = "" if network is None else hash_layers(network.hidden)

    def keyframe(self, seq: int, state: ControllerState | None = None) -> m.Keyframe:
        """Return the whole memory after tick `seq`, -1 before the first.

        state: the value of `self.state` after that tick; None for the present one.
        """
        of = self.state if state is None else state
        arrays = {name: m.Array.of(array, WIRE[array.dtype.name]) for name, array in of.to_arrays().items()}
        return m.Keyframe(
            run_id=self._run_id, seq=seq, arrays=arrays, resumed=self._resumed if seq == -1 else ""
        )

    def restore(self, keyframe: m.Keyframe) -> None:
        """Take over a keyframe's memory.

        Raises:
            ValueError: the keyframe does not fit this configuration. The text names the array.
        """
        arrays = {name: array.numpy() for name, array in keyframe.arrays.items()}
        expected, unfit = (
            self._expected(arrays),
            f"the keyframe of tick {keyframe.seq} does not fit this configuration",
        )
        for name in sorted(expected.keys() | arrays.keys()):
            if name not in arrays or name not in expected or arrays[name].shape != expected[name].shape:
                raise ValueError(f"{unfit}: array {name}")
        try:
            self.state = ControllerState.from_arrays(arrays)
        except ValueError as error:
            raise ValueError(f"{unfit}: array {error}") from error
        self._hash_hidden()
        self._resumed = keyframe.resumed

    def _expected(self, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the arrays of a valid memory. Only a given reference and its target are optional."""
        expected = {
            name: array for name, array in self.state.to_arrays().items() if not name.startswith(GIVEN)
        }
        if "target" in arrays or self._controller.aims.nothing_yet.size:
            model = self._controller.model
            expected["target"] = np.zeros(model.d + model.m)
        # The arrays of a reference are checked when they are read.
        return expected | {name: array for name, array in arrays.items() if name.startswith("reference.")}

    def lasting(self) -> dict[str, m.Array]:
        """Return the part of the memory that survives this process: everything learned, without plans."""
        arrays = self.keyframe(0).arrays
        return {name: array for name, array in arrays.items() if _lasts(name)}

    def go_on(self, lasting: dict[str, m.Array], run_id: str) -> None:
        """Start with the lasting memory of the run `run_id`, and without a plan. Call it before the first tick.

        Raises:
            ValueError: it does not fit this configuration. The text names the array.
        """
        begin = self.keyframe(-1).arrays
        expected = {name for name in begin if _lasts(name)}
        for name in sorted(expected ^ {name for name in lasting if not name.startswith("reference.")}):
            raise ValueError(f"array {name} is {'missing' if name in expected else 'not known'}")
        for name in sorted(expected):
            if (lasting[name].shape, lasting[name].dtype) != (begin[name].shape, begin[name].dtype):
                raise ValueError(f"array {name} is {lasting[name].shape} there and {begin[name].shape} here")
        arrays = {**begin, **lasting}
        self.restore(m.Keyframe(run_id=self._run_id, seq=-1, arrays=arrays, resumed=run_id))

    def belongs(self) -> dict[str, str]:
        """Return the identity of this memory as texts, which must be equal in a process that continues with it."""
        model, what = self._controller.model, self._controller.oracle.description
        plant = model.plant
        numbers = b"".join(array.tobytes() for array in (model.A, model.B, plant.x_e, plant.u_e))
        words = {
            "plant": self._config.name,
            "model": f"{plant.name} {hashlib.sha256(numbers).hexdigest()[:12]}",
            "rate": f"{self._config.rate:g} Hz",
            "oracle": self._config.controller.oracle,
        }
        if plant.dead_time:
            words["dead time"] = f"{plant.dead_time!r} s"
        truth = self._config.plant.truth
        if isinstance(truth, str):
            words["truth"] = truth
        elif truth:
            words["truth"] = ", ".join(f"{name} {value!r}" for name, value in sorted(truth.items()))
        if what is not None:
            layers = "-".join(map(str, what.hidden))
            words["network"] = f"{what.architecture} {layers} {what.sha256()[:12]}"
        return words

    def hidden_snapshot(self, seq: int) -> m.HiddenSnapshot | None:
        """Return the hidden weights in use, for a trainer that joins late; None without a network."""
        network = self._controller.oracle.network(self.state.oracle)
        if network is None:
            return None
        return m.HiddenSnapshot(
            run_id=self._run_id,
            seq=seq,
            hidden_version=network.newest,
            hidden_sha256=self.hidden_sha256,
            description=msgspec.json.encode(self._controller.oracle.description).decode(),
            layers=[m.Array.of(layer, "<f4") for layer in network.hidden],
        )


def _lasts(name: str) -> bool:
    """Return whether a new process can use this array. Plans and states before an interruption are excluded."""
    return name == "delay" or name.startswith(("oracle.", "estimator.", "reference."))
