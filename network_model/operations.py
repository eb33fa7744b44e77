"""What an architecture of the hidden layers is, in operations that every backend has.

An architecture sees the last k pairs (x, u), oldest first, and returns the activations of its last hidden layer. It
is written in a few operations that numpy, CasADi and torch each provide, so that the controller's network and the
trainer's cannot differ. Derivatives follow from the operations. docs/tutorials/architectures.md shows a whole one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Protocol

Activation = Literal["tanh", "sigmoid", "softsign", "softplus", "relu"]
BOUNDED: tuple[Activation, ...] = ("tanh", "sigmoid", "softsign")

Value = Any
"""A batch of vectors, in the backend's own layout. Two of the same length can be added, subtracted and multiplied,
entry by entry; so can a value and a number."""
Layer = Any
"""One weight matrix with its bias, in the backend's own layout."""


class Sizes(NamedTuple):
    """What the configuration says about a network's shape."""

    pair: int
    """Length of (x, u), d + m."""
    window: int
    """k, pairs that the network sees."""
    hidden: tuple[int, ...]
    """Neurons of each hidden layer, n_1..n_L."""
    activations: tuple[Activation, ...]
    """psi_1..psi_L; the last one is bounded by 1."""
    options: dict[str, int]
    """The architecture's own settings, all of them."""


class Operations(Protocol):
    """What a backend computes."""

    def affine(self, layer: Layer, a: Value) -> Value:
        """b + V'a for a layer of shape (1 + n_a, n) with the bias b as its first row."""

    def activate(self, name: Activation, a: Value) -> Value:
        """psi(a), entry by entry."""

    def join(self, parts: Sequence[Value]) -> Value:
        """The vectors of several values one behind the other."""


class Architecture:
    """The hidden layers: shapes of their weights, and how they act on a window. No state of its own.

    Whatever `forward` returns must be bounded by 1 in every entry, for any weights: the theory needs bounded phi.
    """

    window: int = 1
    """k where the configuration does not say."""
    options: dict[str, int] = {}  # noqa: RUF012  (never written to)
    """Names and defaults of its own settings, `network.options` in the configuration."""

    def shapes(self, sizes: Sizes) -> list[tuple[int, int]]:
        """Shapes of the weights, (1 + inputs, outputs) each: the first row is the bias.

        Raises:
            ValueError: these sizes make no network; the text says why.
        """
        raise NotImplementedError

    def outputs(self, sizes: Sizes) -> int:
        """Length of what `forward` returns."""
        return sizes.hidden[-1]

    def forward(
        self, net: Operations, sizes: Sizes, layers: Sequence[Layer], window: Sequence[Value]
    ) -> Value:
        """The last hidden layer's activations.

        Args:
            net: the operations.
            sizes: as for `shapes`.
            layers: the weights, in the order of `shapes`.
            window: k pairs (x, u) in units of their scale, oldest first; the last one is the present pair.
        """
        raise NotImplementedError


def dense_shapes(inputs: int, widths: Sequence[int]) -> list[tuple[int, int]]:
    """Shapes of dense layers one behind the other."""
    sizes = [inputs, *widths]
    return [(1 + a, b) for a, b in itertools.pairwise(sizes)]


def dense(net: Operations, layers: Sequence[Layer], activations: Sequence[Activation], a: Value) -> Value:
    """Dense layers one behind the other."""
    for layer, activation in zip(layers, activations, strict=True):
        a = net.activate(activation, net.affine(layer, a))
    return a
