"""Check that numpy, CasADi and torch compute the same network of an architecture, and that phi is bounded.

The controller's network uses the first two and the trainer's the third, all from one `forward`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, get_args

import casadi as ca
import numpy as np
import torch

from lbmpc.oracles.base import remembered
from lbmpc.oracles.dnn.oracle import DnnOracle
from network_model.description import NetworkDescription
from network_model.operations import BOUNDED, Activation
from network_model.registry import get_architecture
from node_runtime.config.strict import ConfigError
from trainer_node.network import Network

ACTIVATIONS: tuple[Activation, ...] = get_args(Activation)
VALUE, SLOPE, BOUND = 1e-12, 1e-11, 1e-12
"""Largest difference of values and slopes, and largest excess of an entry of phi over 1."""
POINTS = 5
LONGEST_TEXT = 300
_Pair = tuple[np.ndarray, np.ndarray]


class Parity(NamedTuple):
    """The largest of each over some points, in float64."""

    value: float
    """Difference between h_hat of CasADi, of numpy and of torch, in units of the output scale."""
    slope: float
    """Between its slopes along every entry of the window, CasADi's and torch's, in units of the scales; relative where
    slopes are above 1, since they are sums that cancel."""
    phi: float
    """An entry of phi."""

    @property
    def holds(self) -> bool:
        """False for NaN too."""
        return self.value < VALUE and self.slope < SLOPE and self.phi <= 1.0 + BOUND

    def worst(self, other: Parity) -> Parity:
        """Return the larger of each; NaN counts as larger than all."""
        return Parity(*(float(np.maximum(a, b)) for a, b in zip(self, other, strict=True)))


def drawn(name: str, rng: np.random.Generator) -> NetworkDescription:
    """Return a network of that architecture with random sizes, activations, scales and options.

    Raises:
        ValueError: the architecture refuses these sizes; the text is its own.
    """
    architecture = get_architecture(name)
    layers, window = int(rng.integers(1, 5)), int(rng.integers(1, 6))
    states, inputs = int(rng.integers(1, 7)), int(rng.integers(1, 4))
    options = {
        option: int(rng.integers(1, max(default, window) + 1)) if rng.random() < 0.5 else default
        for option, default in architecture.options.items()
    }
    return NetworkDescription(
        states=states,
        inputs=inputs,
        hidden=rng.integers(1, 41, layers).tolist(),
        activations=[*_any(ACTIVATIONS, layers - 1, rng), *_any(BOUNDED, 1, rng)],
        input_scale=(10.0 ** rng.uniform(-3, 3, states + inputs)).tolist(),
        output_scale=(10.0 ** rng.uniform(-3, 3, states)).tolist(),
        architecture=name,
        window=window,
        options=options,
    )


def _any(of: tuple[Activation, ...], count: int, rng: np.random.Generator) -> list[Activation]:
    return [of[i] for i in rng.integers(0, len(of), count)]


def parity(description: NetworkDescription, seed: int, size: float = 1.0) -> Parity:
    """Measure random weights of that size at a few random points.

    Raises:
        ConfigError: `forward` fails; the text says with which of the three.
    """
    rng = np.random.default_rng(seed)
    hidden = [size * rng.standard_normal(shape) / np.sqrt(shape[0]) for shape in description.layer_shapes]
    K = rng.standard_normal((description.features, description.states)) / description.features
    windows = rng.standard_normal((POINTS, description.window, description.pair)) * description.input_scale
    scale = np.array(description.output_scale)
    oracle = DnnOracle(description)

    def in_numpy() -> tuple[np.ndarray, np.ndarray]:
        phi = oracle.features_of(hidden, windows)
        return phi, phi @ K * scale

    phi, plain = _called("numpy", description, in_numpy)
    ours, jacobians = _called("CasADi", description, lambda: _casadi(oracle, oracle.pack(hidden, K), windows))
    theirs, slopes = _called("torch", description, lambda: _torch(description, hidden, K, windows))
    value = np.maximum(np.abs(ours - theirs), np.abs(plain - theirs)) / scale
    per_unit = np.tile(description.input_scale, description.window) / scale[:, None]
    largest = 1.0 + np.abs(slopes * per_unit).max(axis=(1, 2), keepdims=True)
    slope = np.abs(jacobians - slopes) * per_unit / largest
    return Parity(float(value.max()), float(slope.max()), float(np.abs(phi).max()))


def _called(backend: str, description: NetworkDescription, compute: Callable[[], _Pair]) -> _Pair:
    try:
        return compute()
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())[:LONGEST_TEXT]
        raise ConfigError(
            f"{description.architecture}: with {backend}, hidden = {description.hidden} and a window of "
            f"{description.window}: {said}"
        ) from error


def _torch(
    description: NetworkDescription, hidden: list[np.ndarray], K: np.ndarray, windows: np.ndarray
) -> _Pair:
    """h_hat, (points, d), and its slopes along the whole window, (points, d, k (d + m))."""
    network = Network(description, torch.float64)
    network.load(hidden)
    rows = network.tensor(windows.reshape(len(windows), -1)).requires_grad_()
    psi = network.activations(network.scaled(rows), [(W[0], W[1:]) for W in network.layers()])
    phi = torch.cat([torch.ones_like(psi[:, :1]), psi], dim=1)
    h = network.tensor(description.output_scale) * (phi @ network.tensor(K))
    slopes = [torch.autograd.grad(column.sum(), rows, retain_graph=True)[0] for column in h.T]
    return h.detach().numpy(), torch.stack(slopes, dim=1).numpy()


def _casadi(oracle: DnnOracle, theta: np.ndarray, windows: np.ndarray) -> _Pair:
    """The same in CasADi expressions, as the solver has them."""
    d, m = oracle.d, oracle.m
    su, parameters = ca.MX.sym("su", d + remembered(oracle) + m), ca.MX.sym("theta", oracle.parameters)
    parts = oracle.split(parameters)
    (jacobian,) = oracle.jacobians(su, parts)
    function = ca.Function("h_hat", [su, parameters], [oracle.value(su, parts), jacobian])
    values, slopes = [], []
    for window in windows:
        x, u, past = window[-1, :d], window[-1, d:], window[:-1].ravel()
        h, J = (np.array(part) for part in function(np.concatenate([x, past, u]), theta))
        values.append(h.ravel())
        slopes.append(np.hstack([J[:, d : d + len(past)], J[:, :d], J[:, d + len(past) :]]))
    return np.array(values), np.array(slopes)
