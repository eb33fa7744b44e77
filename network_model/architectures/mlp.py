"""The multilayer perceptron of the paper: dense layers on (x, u), or on the whole window when it is longer."""

from __future__ import annotations

from collections.abc import Sequence

from network_model.operations import Architecture, Layer, Operations, Sizes, Value, dense, dense_shapes


class Mlp(Architecture):
    def shapes(self, sizes: Sizes) -> list[tuple[int, int]]:
        return dense_shapes(sizes.window * sizes.pair, sizes.hidden)

    def forward(
        self, net: Operations, sizes: Sizes, layers: Sequence[Layer], window: Sequence[Value]
    ) -> Value:
        return dense(net, layers, sizes.activations, net.join(window))


ARCHITECTURE = Mlp()
