"""A recurrent network (Elman): one hidden state runs along the window, and dense layers act on its last value.

s_1 = psi_1(W' (1, p_1)),    s_j = psi_1(W' (1, p_j) + R' (1, s_{j-1})),    phi from s_k through n_2..n_L
"""

from __future__ import annotations

from collections.abc import Sequence

from network_model.operations import Architecture, Layer, Operations, Sizes, Value, dense, dense_shapes


class Rnn(Architecture):
    window = 5

    def shapes(self, sizes: Sizes) -> list[tuple[int, int]]:
        if sizes.window < 2:
            raise ValueError(
                "an rnn needs a window of at least 2 pairs, because it recurs over the pairs; raise network.window"
            )
        n = sizes.hidden[0]
        return [(1 + sizes.pair, n), (1 + n, n), *dense_shapes(n, sizes.hidden[1:])]

    def forward(
        self, net: Operations, sizes: Sizes, layers: Sequence[Layer], window: Sequence[Value]
    ) -> Value:
        pairs, recurrence, *rest = layers
        psi = sizes.activations[0]
        state = net.activate(psi, net.affine(pairs, window[0]))
        for pair in window[1:]:
            state = net.activate(psi, net.affine(pairs, pair) + net.affine(recurrence, state))
        return dense(net, rest, sizes.activations[1:], state)


ARCHITECTURE = Rnn()
