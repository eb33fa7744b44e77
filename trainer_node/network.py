"""The network of network_model/description.py in torch, for training its hidden layers under a fixed output layer.

A layer is (1 + n_{i-1}, n_i) with its bias as the first row. All layers lie one behind the other in a single
parameter. The gradient of dense layers is written out by hand: with layers of this size nearly all the time of a
training step is the cost of calling torch, and this makes the fewest calls: about half the time of autograd, which
does every other architecture.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from network_model.description import NetworkDescription
from network_model.operations import Activation
from network_model.registry import get_architecture

# torch's softplus becomes the identity above `threshold`; at its default, 20, that is off by 2e-9.
ACTIVATIONS: dict[Activation, Callable[[torch.Tensor], torch.Tensor]] = {
    "tanh": torch.tanh,
    "sigmoid": torch.sigmoid,
    "softsign": torch.nn.functional.softsign,
    "softplus": lambda a: torch.nn.functional.softplus(a, threshold=50.0),
    "relu": torch.relu,
}

# Each activation's way back, from the gradient g and its value s = psi(a) alone.
BACKWARD: dict[Activation, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    "tanh": torch.ops.aten.tanh_backward,
    "sigmoid": torch.ops.aten.sigmoid_backward,
    "softsign": lambda g, s: g * (1.0 - s.abs()).square_(),
    "softplus": lambda g, s: g * torch.expm1(-s).neg_(),
    "relu": lambda g, s: torch.ops.aten.threshold_backward(g, s, 0.0),
}


class _Tensors:
    """The operations of `network_model.operations`: a value is (M, n), a layer its bias (n,) and weights (n_a, n)."""

    def affine(self, layer: tuple[torch.Tensor, torch.Tensor], a: torch.Tensor) -> torch.Tensor:
        return torch.addmm(layer[0], a, layer[1])

    def activate(self, name: Activation, a: torch.Tensor) -> torch.Tensor:
        return ACTIVATIONS[name](a)

    def join(self, parts: Sequence[torch.Tensor]) -> torch.Tensor:
        return torch.cat(list(parts), dim=1)


class Network:
    """h_hat(x, u) = output_scale * K' phi(x, u), with W_1..W_{L-1} as its only parameter and K given.

    What it is given is (x, u) (M, d + m), or a window of k pairs, oldest first, (M, k (d + m)): one row a sample.

    Args:
        description: sizes, activations and scaling.
        dtype: float32 to train; float64 to compare with another implementation.
        device: where it lives; it cannot be moved afterwards.
    """

    def __init__(
        self,
        description: NetworkDescription,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ):
        self.description = description
        self.dtype = dtype
        self.device = torch.device(device)
        shapes = description.layer_shapes
        self.flat = torch.nn.Parameter(self.tensor(np.zeros(sum(rows * columns for rows, columns in shapes))))
        self._architecture, self._sizes = get_architecture(description.architecture), description.sizes
        self._input_scale = self.tensor(description.input_scale * description.window)
        self._output_scale = self.tensor(description.output_scale)

    @property
    def dense(self) -> bool:
        """Whether its gradient is written out by hand."""
        return self.description.architecture == "mlp"

    def tensor(self, values: np.ndarray | list[float] | list[list[float]]) -> torch.Tensor:
        """A copy of `values` in this network's dtype, on its device."""
        return torch.tensor(np.asarray(values, dtype=np.float64), dtype=self.dtype, device=self.device)

    def layers(self, of: torch.Tensor | None = None) -> list[torch.Tensor]:
        """W_1..W_{L-1} as views, (1 + n_{i-1}, n_i) each; `of`: of these (..., N) instead."""
        flat = self.flat if of is None else of
        views, start = [], 0
        for rows, columns in self.description.layer_shapes:
            views.append(flat[..., start : start + rows * columns].view(*flat.shape[:-1], rows, columns))
            start += rows * columns
        return views

    def load(self, hidden: list[np.ndarray]) -> None:
        """Take over W_1..W_{L-1}. Raises `ValueError` when the shapes are not the description's."""
        shapes = [tuple(layer.shape) for layer in hidden]
        if shapes != self.description.layer_shapes:
            raise ValueError(f"hidden layers have shapes {shapes}, expected {self.description.layer_shapes}")
        with torch.no_grad():
            for view, layer in zip(self.layers(), hidden, strict=True):
                view.copy_(self.tensor(layer))

    def hidden(self) -> list[np.ndarray]:
        """W_1..W_{L-1} as float64 arrays, (1 + n_{i-1}, n_i) each."""
        return [layer.detach().cpu().numpy().astype(np.float64) for layer in self.layers()]

    def scaled(self, window: torch.Tensor) -> torch.Tensor:
        """Windows in units of `input_scale`."""
        return window / self._input_scale

    def activations(
        self, scaled: torch.Tensor, layers: Sequence[tuple[torch.Tensor, torch.Tensor]]
    ) -> torch.Tensor:
        """phi without its leading 1, (M, n_L), of scaled windows under these biases and weights."""
        pairs = scaled.split(self.description.pair, dim=1)
        return self._architecture.forward(_Tensors(), self._sizes, layers, pairs)

    def scaled_targets(self, h: torch.Tensor) -> torch.Tensor:
        """h, (M, d), in units of `output_scale`."""
        return h / self._output_scale


class Loss(ABC):
    """Mean over M samples of |(h - h_hat) / output_scale|^2 under a fixed K, and its gradient.

    Args:
        network: whose hidden layers are trained.
        window: what it is given, (M, k (d + m)), plant units.
        h: (M, d), units of h.
        K: (1 + n_L, d), fixed; a copy is kept.
    """

    def __init__(self, network: Network, window: np.ndarray, h: np.ndarray, K: np.ndarray):
        self._network = network
        output = network.tensor(K)
        self._inputs = network.scaled(network.tensor(window))
        # K' phi - h is one fused call when the targets are folded into the bias of the output layer.
        self._offset = output[0] - network.scaled_targets(network.tensor(h))
        self._weights = output[1:]
        self._gradient = torch.zeros_like(network.flat, requires_grad=False)

    @abstractmethod
    def value(self) -> float:
        """The loss at the present hidden layers."""

    @abstractmethod
    def gradient(self) -> torch.Tensor:
        """The gradient at the present layers, laid out as `network.flat`; the next call overwrites it."""


def build_loss(network: Network, window: np.ndarray, h: np.ndarray, K: np.ndarray) -> Loss:
    """The loss as it is computed fastest for this network; arguments as for `Loss`."""
    kind = DenseLoss if network.dense else AutogradLoss
    return kind(network, window, h, K)


class AutogradLoss(Loss):
    """Of any architecture."""

    def __init__(self, network: Network, window: np.ndarray, h: np.ndarray, K: np.ndarray):
        super().__init__(network, window, h, K)
        # Leaves of their own on the same memory: views of one parameter would each give a gradient of its full length.
        self._layers = [
            (layer[0].detach().requires_grad_(), layer[1:].detach().requires_grad_())
            for layer in network.layers()
        ]
        self._leaves = [leaf for layer in self._layers for leaf in layer]
        self._parts = [part for layer in network.layers(self._gradient) for part in (layer[0], layer[1:])]

    def _loss(self) -> torch.Tensor:
        psi = self._network.activations(self._inputs, self._layers)
        residual = torch.addmm(self._offset, psi, self._weights)
        return residual.square().sum() / len(self._inputs)

    @torch.no_grad()
    def value(self) -> float:
        return float(self._loss())

    def gradient(self) -> torch.Tensor:
        with torch.enable_grad():
            gradients = torch.autograd.grad(self._loss(), self._leaves)
        for part, gradient in zip(self._parts, gradients, strict=True):
            part.copy_(gradient)
        return self._gradient


class DenseLoss(Loss):
    """Of dense layers, its gradient by hand."""

    def __init__(self, network: Network, window: np.ndarray, h: np.ndarray, K: np.ndarray):
        super().__init__(network, window, h, K)
        self._samples = len(window)
        self._back = (2.0 / self._samples) * self._weights.T.contiguous()
        self._layers = [
            _Layer(W[0], W[1:], W[1:].T, dW[0], dW[1:], ACTIVATIONS[activation], BACKWARD[activation])
            for W, dW, activation in zip(
                network.layers(network.flat.detach()),
                network.layers(self._gradient),
                network.description.activations,
                strict=True,
            )
        ]

    def _forward(self) -> tuple[list[torch.Tensor], torch.Tensor]:
        """The input's and every hidden layer's values without their leading 1, and the residual, (M, d)."""
        values = [self._inputs]
        for layer in self._layers:
            values.append(layer.activation(torch.addmm(layer.bias, values[-1], layer.weights)))
        return values, torch.addmm(self._offset, values[-1], self._weights)

    @torch.no_grad()
    def value(self) -> float:
        _, residual = self._forward()
        return float(residual.square().sum()) / self._samples

    @torch.no_grad()
    def gradient(self) -> torch.Tensor:
        values, residual = self._forward()
        towards = residual @ self._back
        for i in reversed(range(len(self._layers))):
            layer = self._layers[i]
            delta = layer.backward(towards, values[i + 1])
            torch.sum(delta, 0, out=layer.bias_gradient)
            torch.mm(values[i].T, delta, out=layer.weights_gradient)
            if i:
                towards = delta @ layer.weights_transposed
        return self._gradient


class _Layer(NamedTuple):
    """Views into the parameter and its gradient, made once: each costs as much as a small product."""

    bias: torch.Tensor
    weights: torch.Tensor
    weights_transposed: torch.Tensor
    bias_gradient: torch.Tensor
    weights_gradient: torch.Tensor
    activation: Callable[[torch.Tensor], torch.Tensor]
    backward: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
