"""What several tests of the science share: small problems, random networks."""

from __future__ import annotations

import numpy as np

from lbmpc.model import Model, build_model
from lbmpc.oracles import DnnOracle, L2nwOracle, LinearOracle, Oracle
from lbmpc.plants import get_plant
from network_model.description import NetworkDescription
from network_model.registry import get_architecture


def compressor(period: float = 0.05) -> Model:
    return build_model(get_plant("moore_greitzer"), period)


def describe(
    model: Model,
    hidden: list[int],
    activation: str = "tanh",
    scale: float = 0.01,
    architecture: str = "mlp",
    window: int | None = None,
) -> NetworkDescription:
    plant, kind = model.plant, get_architecture(architecture)
    half = np.concatenate([plant.x_scale, plant.u_scale])
    return NetworkDescription(
        states=model.d,
        inputs=model.m,
        hidden=hidden,
        activations=[activation] * len(hidden),
        input_scale=half.tolist(),
        output_scale=[scale] * model.d,
        architecture=architecture,
        window=window or kind.window,
        options=kind.options,
    )


def oracle_named(name: str, model: Model, hidden: list[int] | None = None) -> Oracle:
    if name == "linear":
        return LinearOracle(model.d, model.m)
    if name == "l2nw":
        return L2nwOracle(model.d, model.m, (0, 1, 4), 30, 0.5, 1e-3)
    return DnnOracle(describe(model, hidden or [8, 8]))


def trained_theta(
    oracle: Oracle, rng: np.random.Generator, samples: int = 20, size: float = 0.01
) -> np.ndarray:
    """Parameters after a few random samples with labels of that size."""
    state = oracle.initial_state(rng)
    for _ in range(samples):
        x = rng.uniform(-1, 1, oracle.d) * [0.4, 0.4, 0.5, 5.0]
        state = oracle.learn(state, x, rng.uniform(-0.5, 0.5, oracle.m), rng.normal(size=oracle.d) * size)
    return oracle.theta(state)
