"""Output of a trainer's network, computed with the parts that a training uses."""

from __future__ import annotations

import torch

from trainer_node.network import Network


def phi_of(network: Network, window: torch.Tensor) -> torch.Tensor:
    """phi, (M, 1 + n_L), of windows in deviation coordinates and plant units."""
    psi = network.activations(network.scaled(window), [(W[0], W[1:]) for W in network.layers()])
    return torch.cat([torch.ones_like(psi[:, :1]), psi], dim=1)


def h_hat_of(network: Network, window: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """(M, d), in units of h, for K of shape (1 + n_L, d)."""
    return network.tensor(network.description.output_scale) * (phi_of(network, window) @ K)
