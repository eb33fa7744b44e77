"""A 1-D convolution along the window with n_1 channels, followed by dense layers on all its positions.

    c_j = psi_1(W' (1, p_j .. p_{j+w-1})),  j = 1 .. k - w + 1,    phi from (c_1 .. c_{k-w+1}) through n_2..n_L

where w is the option `kernel`.
"""

from __future__ import annotations

from collections.abc import Sequence

from network_model.operations import Architecture, Layer, Operations, Sizes, Value, dense, dense_shapes


class Cnn(Architecture):
    window = 5
    options = {"kernel": 3}  # noqa: RUF012  (never written to)

    def shapes(self, sizes: Sizes) -> list[tuple[int, int]]:
        kernel = sizes.options["kernel"]
        if not 1 <= kernel <= sizes.window:
            raise ValueError(
                f"the kernel of a cnn covers 1 to {sizes.window} pairs (the window); it is {kernel}"
            )
        channels = sizes.hidden[0]
        return [
            (1 + kernel * sizes.pair, channels),
            *dense_shapes(_positions(sizes) * channels, sizes.hidden[1:]),
        ]

    def outputs(self, sizes: Sizes) -> int:
        # With a single layer, the channels of every position are the output.
        return sizes.hidden[-1] * (_positions(sizes) if len(sizes.hidden) == 1 else 1)

    def forward(
        self, net: Operations, sizes: Sizes, layers: Sequence[Layer], window: Sequence[Value]
    ) -> Value:
        filters, *rest = layers
        kernel, psi = sizes.options["kernel"], sizes.activations[0]
        places = [net.join(window[j : j + kernel]) for j in range(_positions(sizes))]
        maps = [net.activate(psi, net.affine(filters, place)) for place in places]
        return dense(net, rest, sizes.activations[1:], net.join(maps))


def _positions(sizes: Sizes) -> int:
    return sizes.window - sizes.options["kernel"] + 1


ARCHITECTURE = Cnn()
