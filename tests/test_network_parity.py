"""Torch and CasADi compute one and the same network, and the controller has no torch."""

from __future__ import annotations

import subprocess
import sys
from typing import get_args

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lbmpc.oracles.dnn import DnnOracle
from protocol.network import BOUNDED, Activation, NetworkDescription
from trainer_node.network import Network

ACTIVATIONS: tuple[Activation, ...] = get_args(Activation)


@st.composite
def descriptions(draw: st.DrawFn) -> NetworkDescription:
    layers = draw(st.integers(1, 4))
    states, inputs = draw(st.integers(1, 6)), draw(st.integers(1, 3))
    scale = st.floats(1e-3, 1e3)
    return NetworkDescription(
        states=states,
        inputs=inputs,
        hidden=draw(st.lists(st.integers(1, 40), min_size=layers, max_size=layers)),
        activations=[
            *draw(st.lists(st.sampled_from(ACTIVATIONS), min_size=layers - 1, max_size=layers - 1)),
            draw(st.sampled_from(BOUNDED)),
        ],
        input_scale=draw(st.lists(scale, min_size=states + inputs, max_size=states + inputs)),
        output_scale=draw(st.lists(scale, min_size=states, max_size=states)),
    )


@settings(max_examples=60, deadline=None)
@given(descriptions(), st.integers(0, 2**32 - 1), st.sampled_from([0.1, 1.0, 10.0]))
def test_torch_and_casadi_agree_to_1e_12_in_float64(
    description: NetworkDescription, seed: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    hidden = [size * rng.standard_normal(shape) / np.sqrt(shape[0]) for shape in description.layer_shapes]
    K = rng.standard_normal((description.features, description.states)) / description.features
    x = rng.standard_normal((5, description.states)) * description.input_scale[: description.states]
    u = rng.standard_normal((5, description.inputs)) * description.input_scale[description.states :]

    network = Network(description, torch.float64)
    network.load(hidden)
    with torch.no_grad():
        ours = network(network.tensor(x), network.tensor(u), network.tensor(K)).numpy()
    oracle = DnnOracle(description)
    function, theta = oracle.function(), oracle.pack(hidden, K)
    theirs = np.array([np.asarray(function(a, b, theta)[0]).ravel() for a, b in zip(x, u, strict=True)])
    # In units of the output scale, so that neither a large unit nor a small one decides.
    difference = np.abs(ours - theirs) / description.output_scale
    assert difference.max() < 1e-12

    phi = network.features(network.tensor(x), network.tensor(u))
    assert phi.shape == (5, description.features)
    assert bool((phi[:, 0] == 1.0).all())
    assert bool((phi.square().sum(dim=1) <= description.features).all())


def test_softplus_agrees_where_libraries_like_to_round_it_to_the_identity() -> None:
    description = NetworkDescription(
        states=1,
        inputs=1,
        hidden=[1, 1],
        activations=["softplus", "softsign"],
        input_scale=[1.0, 1.0],
        output_scale=[1.0],
    )
    hidden, K = [np.array([[0.0], [1.0], [0.0]]), np.array([[-21.0], [1.0]])], np.array([[0.0], [1.0]])
    network, oracle = Network(description, torch.float64), DnnOracle(description)
    network.load(hidden)
    function, theta = oracle.function(), oracle.pack(hidden, K)
    for x in (-60.0, -5.0, 0.0, 19.9, 20.1, 21.0, 30.0, 49.0, 51.0, 600.0):
        ours = network(network.tensor([[x]]), network.tensor([[0.0]]), network.tensor(K)).item()
        assert abs(ours - float(function([x], [0.0], theta)[0])) < 1e-12


def test_a_controller_and_a_plant_load_neither_torch_nor_the_trainer() -> None:
    code = (
        "import sys, controller_node.node, plant_sim.node\n"
        "found = [name for name in sys.modules if name.split('.')[0] in ('torch', 'trainer_node')]\n"
        "sys.stdout.write(' '.join(found))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


def test_a_trainer_loads_neither_casadi_nor_the_science() -> None:
    code = (
        "import sys, trainer_node.node\n"
        "found = [name for name in sys.modules if name.split('.')[0] in ('casadi', 'lbmpc')]\n"
        "sys.stdout.write(' '.join(found))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
