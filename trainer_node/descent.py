"""Adam on the hidden layers, of one network or of several networks of one shape in each step.

For several networks the layers, samples and output weights are stacked, and every operation of a step is called once
for all of them. No sum runs across plants, so a plant's numbers never influence another's. Up to rounding the result is
that of `descend` for each network, because a stack sums in another order.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch.optim.adam import adam

from network_model.description import NetworkDescription
from trainer_node.network import ACTIVATIONS, BACKWARD, Loss, Network, build_loss

CACHED_ROWS = 2048
"""Samples in a stack on a CPU. With more, every step accesses main memory and is slower than separate steps."""
LOOK_EVERY = 10
"""Steps between two evaluations of the held-out samples; the last step is evaluated too."""
LANES = 256
"""Plants in a stack on a GPU."""


@dataclass(frozen=True)
class Problem:
    """One plant's training."""

    network: Network
    """Contains the initial hidden layers."""
    window: np.ndarray
    """(M, k (d + m)), plant units."""
    h: np.ndarray
    """(M, d)."""
    K: np.ndarray
    """(1 + n_L, d), constant."""
    held_out: tuple[np.ndarray, np.ndarray] | None = None
    """Windows and h of samples that are not trained on and determine the best step; None takes all steps."""


class Descent(NamedTuple):
    """The result for one plant's hidden layers."""

    hidden: list[np.ndarray]
    """W_1..W_{L-1}, (1 + n_{i-1}, n_i) each; not finite if the samples or K cause that."""
    before: float
    after: float
    """Losses before and after."""


def shape_of(description: NetworkDescription) -> Hashable:
    """Return a key that is equal for networks that can be stacked. Scales may differ, because they are data."""
    d = description
    return (
        d.states,
        d.inputs,
        tuple(d.hidden),
        tuple(d.activations),
        d.architecture,
        d.window,
        tuple(sorted(d.options.items())),
    )


def descend(problem: Problem, steps: int, learning_rate: float) -> Descent:
    """Take `steps` of Adam on one network. With held-out samples the best evaluated step is the result."""
    network = problem.network
    loss = build_loss(network, problem.window, problem.h, problem.K)
    if problem.held_out is not None:
        held_out = build_loss(network, *problem.held_out, problem.K)
        before = held_out.value()
        after = _best(network, loss, held_out, steps, learning_rate)
        return Descent(network.hidden(), before, after)
    before = loss.value()
    _adam(network.flat, loss.gradient, steps, learning_rate)
    return Descent(network.hidden(), before, loss.value())


def _best(network: Network, loss: Loss, held_out: Loss, steps: int, learning_rate: float) -> float:
    """Train, leave the network at the lowest value of `held_out`, and return that value."""
    best = [held_out.value(), network.flat.detach().clone()]

    def look(taken: int) -> None:
        if (taken % LOOK_EVERY == 0 or taken == steps) and (now := held_out.value()) < best[0]:
            best[:] = now, network.flat.detach().clone()

    _adam(network.flat, loss.gradient, steps, learning_rate, look)
    with torch.no_grad():
        network.flat.copy_(best[1])
    return best[0]


def descend_together(problems: Sequence[Problem], steps: int, learning_rate: float) -> list[Descent]:
    """Do `descend` for networks of one shape on one device, in one stack.

    Raises:
        ValueError: the networks have different shapes.
    """
    if len({shape_of(problem.network.description) for problem in problems}) > 1:
        raise ValueError("networks of different shapes cannot be stacked; group them by shape_of")
    rows = max((len(problem.window) for problem in problems), default=1)
    on_gpu = bool(problems) and problems[0].network.device.type == "cuda"
    lanes = LANES if on_gpu else max(1, CACHED_ROWS // rows)
    found: list[Descent] = []
    for first in range(0, len(problems), lanes):
        found += _descend(problems[first : first + lanes], steps, learning_rate)
    return found


def _descend(problems: Sequence[Problem], steps: int, learning_rate: float) -> list[Descent]:
    if len(problems) == 1 or any(problem.held_out is not None for problem in problems):
        return [descend(problem, steps, learning_rate) for problem in problems]
    stack = _Dense(problems) if problems[0].network.dense else _Mapped(problems)
    before = stack.values().tolist()
    _adam(stack.flat, stack.gradient, steps, learning_rate)
    after = stack.values().tolist()
    # One copy from the device for all layers and plants.
    rows = stack.flat.cpu()
    hidden = [[W.numpy().astype(np.float64) for W in stack.network.layers(row)] for row in rows]
    return [Descent(*parts) for parts in zip(hidden, before, after, strict=True)]


def _adam(
    parameter: torch.Tensor,
    gradient: Callable[[], torch.Tensor],
    steps: int,
    learning_rate: float,
    look: Callable[[int], None] = lambda _taken: None,
) -> None:
    with torch.no_grad():
        moments, squares = torch.zeros_like(parameter), torch.zeros_like(parameter)
        taken = torch.zeros((), device=parameter.device)
        for number in range(steps):
            slope = gradient()
            # The function that torch.optim.Adam calls. The class would import much of torch, which takes over a second.
            adam(
                [parameter],
                [slope],
                [moments],
                [squares],
                [],
                [taken],
                fused=True,
                amsgrad=False,
                beta1=0.9,
                beta2=0.999,
                lr=learning_rate,
                weight_decay=0.0,
                eps=1e-8,
                maximize=False,
            )
            look(number + 1)


class _Stack(ABC):
    """P problems as tensors, and their losses. Plants with fewer than M samples are padded with rows of weight 0."""

    def __init__(self, problems: Sequence[Problem]):
        self.network = problems[0].network
        tensor, most = self.network.tensor, max(len(problem.window) for problem in problems)
        self.flat = torch.stack([problem.network.flat.detach() for problem in problems])

        def stacked(parts: list[torch.Tensor]) -> torch.Tensor:
            whole = torch.zeros(
                (len(parts), most, parts[0].shape[1]), dtype=self.flat.dtype, device=self.flat.device
            )
            for lane, part in zip(whole, parts, strict=True):
                lane[: len(part)] = part
            return whole

        networks = [problem.network for problem in problems]
        self.inputs = stacked([n.scaled(n.tensor(p.window)) for n, p in zip(networks, problems, strict=True)])
        K = torch.stack([tensor(problem.K) for problem in problems])
        self.offset = stacked(
            [
                output[0] - n.scaled_targets(n.tensor(p.h))
                for n, p, output in zip(networks, problems, K, strict=True)
            ]
        )
        self.weights = K[:, 1:].contiguous()
        """(P, n_L, d)"""
        self.share = stacked([tensor([[1.0 / len(p.window)]] * len(p.window)) for p in problems])
        """(P, M, 1): weight of a row in its plant's mean."""

    @abstractmethod
    def values(self) -> torch.Tensor:
        """Return the loss of each plant, (P,)."""

    @abstractmethod
    def gradient(self) -> torch.Tensor:
        """Return the gradients, (P, N), one row per plant; the next call may overwrite them."""


class _Mapped(_Stack):
    """Losses of any architecture, mapped over the plants."""

    def __init__(self, problems: Sequence[Problem]):
        super().__init__(problems)
        # Imported here, because the import is slow and a single plant does not need it.
        from torch.func import grad, vmap

        network = self.network

        def loss(
            flat: torch.Tensor,
            inputs: torch.Tensor,
            offset: torch.Tensor,
            weights: torch.Tensor,
            share: torch.Tensor,
        ) -> torch.Tensor:
            layers = [(W[0], W[1:]) for W in network.layers(flat)]
            residual = offset + network.activations(inputs, layers) @ weights
            return (residual.square() * share).sum()

        self._values, self._gradient = vmap(loss), vmap(grad(loss))
        self._data = self.flat, self.inputs, self.offset, self.weights, self.share

    @torch.no_grad()
    def values(self) -> torch.Tensor:
        return self._values(*self._data)

    def gradient(self) -> torch.Tensor:
        with torch.enable_grad():
            return self._gradient(*self._data).detach()


class _Dense(_Stack):
    """Losses of dense layers with a handwritten gradient: `DenseLoss` with a leading dimension of plants."""

    def __init__(self, problems: Sequence[Problem]):
        super().__init__(problems)
        description = self.network.description
        self._slope = torch.zeros_like(self.flat)
        self._back, self._double = self.weights.transpose(1, 2).contiguous(), 2.0 * self.share
        self._W, self._dW = self.network.layers(self.flat), self.network.layers(self._slope)
        self._forth = [ACTIVATIONS[name] for name in description.activations]
        self._backward = [BACKWARD[name] for name in description.activations]

    def _forward(self) -> tuple[list[torch.Tensor], torch.Tensor]:
        values = [self.inputs]
        for W, psi in zip(self._W, self._forth, strict=True):
            values.append(psi(torch.baddbmm(W[:, :1], values[-1], W[:, 1:])))
        return values, torch.baddbmm(self.offset, values[-1], self.weights)

    @torch.no_grad()
    def values(self) -> torch.Tensor:
        _, residual = self._forward()
        return (residual.square() * self.share).sum(dim=(1, 2))

    @torch.no_grad()
    def gradient(self) -> torch.Tensor:
        values, residual = self._forward()
        towards = (residual * self._double) @ self._back
        for i in reversed(range(len(self._W))):
            delta = self._backward[i](towards, values[i + 1])
            self._dW[i][:, 0] = delta.sum(1)
            self._dW[i][:, 1:] = values[i].transpose(1, 2) @ delta
            if i:
                towards = delta @ self._W[i][:, 1:].transpose(1, 2)
        return self._slope
