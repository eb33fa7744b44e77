"""The interface of an architecture of hidden layers, and the operations that it is written in.

An architecture maps the last k pairs (x, u), oldest first, to the activations of its last hidden layer. It uses a few
operations that numpy, CasADi and torch each provide, so the controller's network and the trainer's compute the same
function. Derivatives follow from the operations. docs/tutorials/architectures.md shows a complete example.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Protocol

Activation = Literal["tanh", "sigmoid", "softsign", "softplus", "relu"]
BOUNDED: tuple[Activation, ...] = ("tanh", "sigmoid", "softsign")

Value = Any
"""A batch of vectors in the backend's own layout. Values of equal length can be added, subtracted and multiplied entry
by entry. A value can also be combined with a number."""
Layer = Any
"""One weight matrix with its bias, in the backend's own layout."""


class Sizes(NamedTuple):
    """The sizes of a network, as configured."""

    pair: int
    """Length of (x, u), d + m."""
    window: int
    """k, the number of pairs that the network sees."""
    hidden: tuple[int, ...]
    """Neurons of each hidden layer, n_1..n_L."""
    activations: tuple[Activation, ...]
    """psi_1..psi_L; the last one is bounded by 1."""
    options: dict[str, int]
    """All options of the architecture, by name."""


class Operations(Protocol):
    """The operations that a backend provides."""

    def affine(self, layer: Layer, a: Value) -> Value:
        """Return b + V'a for a layer of shape (1 + n_a, n) whose first row is the bias b."""

    def activate(self, name: Activation, a: Value) -> Value:
        """Return psi(a), entry by entry."""

    def join(self, parts: Sequence[Value]) -> Value:
        """Return the concatenation of the vectors of several values."""


class Architecture:
    """The hidden layers: shapes of their weights, and their action on a window. An architecture has no state.

    Every entry of `forward`'s result must be bounded by 1 for any weights, because the theory needs a bounded phi.
    """

    window: int = 1
    """k if the configuration does not set it."""
    options: dict[str, int] = {}  # noqa: RUF012  (never written to)
    """Names and defaults of the architecture's options (`network.options` in the configuration)."""

    def shapes(self, sizes: Sizes) -> list[tuple[int, int]]:
        """Return the shapes of the weights, (1 + inputs, outputs) each. The first row is the bias.

        Raises:
            ValueError: the architecture cannot have these sizes.
        """
        raise NotImplementedError

    def outputs(self, sizes: Sizes) -> int:
        """Return the length of the result of `forward`."""
        return sizes.hidden[-1]

    def forward(
        self, net: Operations, sizes: Sizes, layers: Sequence[Layer], window: Sequence[Value]
    ) -> Value:
        """Return the activations of the last hidden layer.

        Args:
            net: the operations.
            sizes: as for `shapes`.
            layers: the weights, in the order of `shapes`.
            window: k pairs (x, u) divided by their scale, oldest first; the last one is the present pair.
        """
        raise NotImplementedError


def dense_shapes(inputs: int, widths: Sequence[int]) -> list[tuple[int, int]]:
    """Return the shapes of consecutive dense layers."""
    sizes = [inputs, *widths]
    return [(1 + a, b) for a, b in itertools.pairwise(sizes)]


def dense(net: Operations, layers: Sequence[Layer], activations: Sequence[Activation], a: Value) -> Value:
    """Apply consecutive dense layers."""
    for layer, activation in zip(layers, activations, strict=True):
        a = net.activate(activation, net.affine(layer, a))
    return a
