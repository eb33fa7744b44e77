"""A gated recurrent unit along the window, dense layers on its last state."""

from __future__ import annotations

from collections.abc import Sequence

from network_model.operations import Architecture, Layer, Operations, Sizes, Value, dense, dense_shapes


class Gru(Architecture):
    window = 5

    def shapes(self, sizes: Sizes) -> list[tuple[int, int]]:
        if sizes.window < 2:
            raise ValueError(
                "a gru needs a window of at least 2 pairs: with one it has nothing to recur over"
            )
        n, *rest = sizes.hidden
        gate = (1 + sizes.pair + n, n)
        return [(1 + sizes.pair, n), gate, gate, gate, *dense_shapes(n, rest)]

    def forward(
        self, net: Operations, sizes: Sizes, layers: Sequence[Layer], window: Sequence[Value]
    ) -> Value:
        first, keep, reset, candidate, *rest = layers
        state = net.activate("tanh", net.affine(first, window[0]))
        for pair in window[1:]:
            both = net.join([pair, state])
            k = net.activate("sigmoid", net.affine(keep, both))
            r = net.activate("sigmoid", net.affine(reset, both))
            new = net.activate("tanh", net.affine(candidate, net.join([pair, r * state])))
            state = k * state + (1 - k) * new
        return dense(net, rest, sizes.activations[1:], state)


GRU = Gru()
