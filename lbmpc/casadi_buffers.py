"""CasADi functions that are called on shared numpy arrays."""

from __future__ import annotations

import casadi as ca
import numpy as np


class Bound:
    """A CasADi function bound to fixed numpy arrays, so that a call converts and allocates nothing.

    `inputs[name]` and `outputs[name]` are Fortran-ordered arrays shared with CasADi. Write the inputs, call the
    object, and read the outputs.
    """

    def __init__(self, function: ca.Function):
        self.function = function
        self._buffer, self._evaluate = function.buffer()
        self.inputs: dict[str, np.ndarray] = {}
        self.outputs: dict[str, np.ndarray] = {}
        for i, name in enumerate(function.name_in()):
            self.inputs[name] = self._array(function.size_in(i))
            self._buffer.set_arg(i, self.inputs[name].ravel(order="K").data)
        for i, name in enumerate(function.name_out()):
            self.outputs[name] = self._array(function.size_out(i))
            self._buffer.set_res(i, self.outputs[name].ravel(order="K").data)

    @staticmethod
    def _array(shape: tuple[int, int]) -> np.ndarray:
        return np.zeros(shape, order="F")

    def __call__(self) -> None:
        self._evaluate()
