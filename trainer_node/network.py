"""The network of network_model/description.py in torch, for training its hidden layers under a fixed output layer.

A layer is (1 + n_{i-1}, n_i) with its bias as the first row. All layers are stored in a single parameter. The gradient
of dense layers is written by hand. For layers of this size most of the time of a training step is the cost of calling
torch, and the handwritten gradient needs the fewest calls, about half the time of autograd. Autograd is used for all
other architectures.
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

# Above `threshold` torch's softplus is the identity; at the default of 20 its error would be 2e-9.
ACTIVATIONS: dict[Activation, Callable[[torch.Tensor], torch.Tensor]] = {
    "tanh": torch.tanh,
    "sigmoid": torch.sigmoid,
    "softsign": torch.nn.functional.softsign,
    "softplus": lambda a: torch.nn.functional.softplus(a, threshold=50.0),
    "relu": torch.relu,
}

# Backward pass of each activation from the gradient g and its value s = psi(a).
BACKWARD: dict[Activation, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    "tanh": torch.ops.aten.tanh_backward,
    "sigmoid": torch.ops.aten.sigmoid_backward,
    "softsign": lambda g, s: g * (1.0 - s.abs()).square_(),
    "softplus": lambda g, s: g * torch.expm1(-s).neg_(),
    "relu": lambda g, s: torch.ops.aten.threshold_backward(g, s, 0.0),
}


class _Tensors:
    """The operations of `network_model.operations`. A value is (M, n); a layer is bias (n,) and weights (n_a, n)."""

    def affine(self, layer: tuple[torch.Tensor, torch.Tensor], a: torch.Tensor) -> torch.Tensor:
        return torch.addmm(layer[0], a, layer[1])

    def activate(self, name: Activation, a: torch.Tensor) -> torch.Tensor:
        return ACTIVATIONS[name](a)

    def join(self, parts: Sequence[torch.Tensor]) -> torch.Tensor:
        return torch.cat(list(parts), dim=1)


class Network:
    """h_hat(x, u) = output_scale * K' phi(x, u), with W_1..W_{L-1} as its only parameter and a given K.

    Its input is (x, u) (M, d + m), or a window of k pairs, oldest first, (M, k (d + m)): one row per sample.

    Args:
        description: sizes, activations and scaling.
        dtype: float32 to train; float64 to compare with another implementation.
        device: the device of its tensors, which cannot be changed later.
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
        """Whether its gradient is written by hand."""
        return self.description.architecture == "mlp"

    def tensor(self, values: np.ndarray | list[float] | list[list[float]]) -> torch.Tensor:
        """Return a copy of `values` in this network's dtype, on its device."""
        return torch.tensor(np.asarray(values, dtype=np.float64), dtype=self.dtype, device=self.device)

    def layers(self, of: torch.Tensor | None = None) -> list[torch.Tensor]:
        """Return W_1..W_{L-1} as views, (1 + n_{i-1}, n_i) each, of `of` (..., N) or of the parameter."""
        flat = self.flat if of is None else of
        views, start = [], 0
        for rows, columns in self.description.layer_shapes:
            views.append(flat[..., start : start + rows * columns].view(*flat.shape[:-1], rows, columns))
            start += rows * columns
        return views

    def load(self, hidden: list[np.ndarray]) -> None:
        """Take over W_1..W_{L-1}. Raises `ValueError` if the shapes differ from the description's."""
        shapes = [tuple(layer.shape) for layer in hidden]
        if shapes != self.description.layer_shapes:
            raise ValueError(f"hidden layers have shapes {shapes}, expected {self.description.layer_shapes}")
        with torch.no_grad():
            for view, layer in zip(self.layers(), hidden, strict=True):
                view.copy_(self.tensor(layer))

    def hidden(self) -> list[np.ndarray]:
        """Return W_1..W_{L-1} as float64 arrays, (1 + n_{i-1}, n_i) each."""
        return [layer.detach().cpu().numpy().astype(np.float64) for layer in self.layers()]

    def scaled(self, window: torch.Tensor) -> torch.Tensor:
        """Return windows in units of `input_scale`."""
        return window / self._input_scale

    def activations(
        self, scaled: torch.Tensor, layers: Sequence[tuple[torch.Tensor, torch.Tensor]]
    ) -> torch.Tensor:
        """Return phi without its leading 1, (M, n_L), of scaled windows under these biases and weights."""
        pairs = scaled.split(self.description.pair, dim=1)
        return self._architecture.forward(_Tensors(), self._sizes, layers, pairs)

    def scaled_targets(self, h: torch.Tensor) -> torch.Tensor:
        """Return h, (M, d), in units of `output_scale`."""
        return h / self._output_scale


class Loss(ABC):
    """Mean over M samples of |(h - h_hat) / output_scale|^2 under a fixed K, and its gradient.

    Args:
        network: the network whose hidden layers are trained.
        window: its inputs, (M, k (d + m)), plant units.
        h: (M, d), units of h.
        K: (1 + n_L, d), fixed; a copy is kept.
    """

    def __init__(self, network: Network, window: np.ndarray, h: np.ndarray, K: np.ndarray):
        self._network = network
        output = network.tensor(K)
        self._inputs = network.scaled(network.tensor(window))
        # With the targets folded into the bias of the output layer, K' phi - h is one fused call.
        self._offset = output[0] - network.scaled_targets(network.tensor(h))
        self._weights = output[1:]
        self._gradient = torch.zeros_like(network.flat, requires_grad=False)

    @abstractmethod
    def value(self) -> float:
        """Return the loss at the present hidden layers."""

    @abstractmethod
    def gradient(self) -> torch.Tensor:
        """Return the gradient at the present layers in the layout of `network.flat`; the next call overwrites it."""


def build_loss(network: Network, window: np.ndarray, h: np.ndarray, K: np.ndarray) -> Loss:
    """Return the fastest implementation of the loss for this network; arguments as for `Loss`."""
    kind = DenseLoss if network.dense else AutogradLoss
    return kind(network, window, h, K)


class AutogradLoss(Loss):
    """The loss of any architecture, by autograd."""

    def __init__(self, network: Network, window: np.ndarray, h: np.ndarray, K: np.ndarray):
        super().__init__(network, window, h, K)
        # Separate leaves on the same memory. Views of one parameter would each give a gradient of its full length.
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
    """The loss of dense layers, with a handwritten gradient."""

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
        """Return the values of the input and every hidden layer without their leading 1, and the residual, (M, d)."""
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
    """Views of the parameter and its gradient, created once because each costs as much as a small product."""

    bias: torch.Tensor
    weights: torch.Tensor
    weights_transposed: torch.Tensor
    bias_gradient: torch.Tensor
    weights_gradient: torch.Tensor
    activation: Callable[[torch.Tensor], torch.Tensor]
    backward: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
