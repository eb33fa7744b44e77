"""The network's description, which the trainer's torch network and the controller's CasADi network share.

    h_hat(x, u) = output_scale * K' phi(x, u),        phi = (1, psi_L[W_{L-1}' (1, psi_{L-1}[ ... ])])

Equation (e:NN_structure) of the paper. The input is (x, u) in deviation coordinates divided by `input_scale`, or a
window of the last k such pairs. The first row of every weight matrix is its bias. The activations of every layer
carry a leading 1, including those of the last. The architecture (a file of `network_model/architectures`) says how
the hidden layers act on the window. The last hidden activation is bounded, so |phi|^2 <= 1 + n_L = sigma^2.
"""

from __future__ import annotations

import hashlib
from typing import Annotated

import msgspec
import numpy as np

from network_model.operations import BOUNDED, Activation, Sizes
from network_model.registry import get_architecture

__all__ = [
    "BOUNDED",
    "Activation",
    "NetworkDescription",
    "Width",
    "hash_layers",
    "initial_hidden",
    "why_unacceptable",
]

Width = Annotated[int, msgspec.Meta(ge=1, le=4096)]
Length = Annotated[int, msgspec.Meta(ge=1, le=128)]
Window = Annotated[int, msgspec.Meta(ge=1, le=64)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
LAYERS = 32
"""Maximum number of hidden layers. A description may come from another machine, and its layers take memory."""


class NetworkDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sizes, activations and scaling of one network. Two processes agree when the `sha256` of theirs are equal."""

    states: Length
    inputs: Length
    hidden: Annotated[list[Width], msgspec.Meta(max_length=LAYERS)]
    """Neurons of each hidden layer, input side first."""
    activations: list[Activation]
    """One for each hidden layer; the last must be bounded."""
    input_scale: list[Positive]
    """Units of (x, u) that count as 1: the half-widths of X and U."""
    output_scale: list[Positive]
    """Units of h that count as 1, one per state."""
    max_layer_norm: Positive = 100.0
    """Largest Frobenius norm of a hidden layer that a controller accepts."""
    architecture: str = "mlp"
    """Name of a file of `network_model/architectures`, or of a user's file together with the hash of its text."""
    window: Window = 1
    """k, the number of pairs (x, u) that the network sees: the present one and the k - 1 before it."""
    options: dict[str, int] = {}
    """All options of the architecture, by name."""

    def __post_init__(self) -> None:
        if not self.hidden:
            raise ValueError("hidden is empty: the network needs at least one hidden layer")
        if len(self.activations) != len(self.hidden):
            raise ValueError(f"{len(self.hidden)} hidden layers but {len(self.activations)} activations")
        if self.activations[-1] not in BOUNDED:
            raise ValueError(
                f"the last activation, {self.activations[-1]}, is not bounded; use one of {', '.join(BOUNDED)}"
            )
        if len(self.input_scale) != self.states + self.inputs:
            raise ValueError(
                f"input_scale has {len(self.input_scale)} entries, (x, u) has {self.states + self.inputs}"
            )
        if len(self.output_scale) != self.states:
            raise ValueError(f"output_scale has {len(self.output_scale)} entries, h has {self.states}")
        known = get_architecture(self.architecture).options
        if self.options.keys() != known.keys():
            raise ValueError(
                f"the options of {self.architecture} are {sorted(known) or 'none'}, not {sorted(self.options)}"
            )
        _ = self.layer_shapes

    @property
    def pair(self) -> int:
        """Length of (x, u), d + m."""
        return self.states + self.inputs

    @property
    def sizes(self) -> Sizes:
        """The sizes that the architecture works with."""
        return Sizes(self.pair, self.window, tuple(self.hidden), tuple(self.activations), self.options)

    @property
    def layer_shapes(self) -> list[tuple[int, int]]:
        """Shapes of the hidden weights, each with its bias as first row; (1 + n_{i-1}, n_i) for an mlp."""
        return get_architecture(self.architecture).shapes(self.sizes)

    @property
    def features(self) -> int:
        """Length of phi, 1 + n_L."""
        return 1 + get_architecture(self.architecture).outputs(self.sizes)

    def sha256(self) -> str:
        """Return the SHA-256 of all fields, in hexadecimal."""
        return hashlib.sha256(msgspec.json.encode(self)).hexdigest()


def initial_hidden(description: NetworkDescription, rng: np.random.Generator) -> list[np.ndarray]:
    """Return random hidden layers in float32 precision: Glorot-uniform weights, zero biases."""
    layers = []
    for rows, columns in description.layer_shapes:
        limit = np.sqrt(6.0 / (rows - 1 + columns))
        weights = rng.uniform(-limit, limit, size=(rows, columns))
        weights[0] = 0.0
        layers.append(weights.astype(np.float32).astype(np.float64))
    return layers


def hash_layers(layers: list[np.ndarray]) -> str:
    """Return the SHA-256 of the layers as little-endian float32, row-major, with their shapes."""
    digest = hashlib.sha256()
    for layer in layers:
        digest.update(repr(tuple(layer.shape)).encode())
        digest.update(np.ascontiguousarray(layer, dtype="<f4").tobytes())
    return digest.hexdigest()


def why_unacceptable(description: NetworkDescription, layers: list[np.ndarray]) -> str | None:
    """Return the first reason to reject these hidden layers, or None if they are acceptable."""
    shapes = [tuple(layer.shape) for layer in layers]
    if shapes != description.layer_shapes:
        return f"shapes {shapes}, expected {description.layer_shapes}"
    for i, layer in enumerate(layers):
        if not np.isfinite(layer).all():
            return f"layer {i + 1} is not finite"
        norm = float(np.linalg.norm(layer))
        if norm > description.max_layer_norm:
            return f"layer {i + 1} has norm {norm:.3g}, at most {description.max_layer_norm:.3g}"
    return None
