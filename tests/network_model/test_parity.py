"""Torch and CasADi compute the same network, and a controller does not import torch."""

from __future__ import annotations

from typing import get_args

import numpy as np
import torch
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from lbmpc.oracles.dnn.oracle import DnnOracle
from network_model.description import NetworkDescription
from network_model.operations import BOUNDED, Activation
from network_model.registry import architecture_names, get_architecture
from tandem.parity import parity
from tests.helpers.interpreter import imported
from tests.helpers.science import function
from tests.helpers.torch_network import h_hat_of
from trainer_node.network import Network

ACTIVATIONS: tuple[Activation, ...] = get_args(Activation)


@st.composite
def descriptions(draw: st.DrawFn) -> NetworkDescription:
    layers = draw(st.integers(1, 4))
    states, inputs = draw(st.integers(1, 6)), draw(st.integers(1, 3))
    scale = st.floats(1e-3, 1e3)
    architecture, window = draw(st.sampled_from(architecture_names())), draw(st.integers(1, 5))
    defaults = get_architecture(architecture).options
    options = {name: draw(st.integers(1, max(default, window))) for name, default in defaults.items()}
    fields = {
        "states": states,
        "inputs": inputs,
        "hidden": draw(st.lists(st.integers(1, 40), min_size=layers, max_size=layers)),
        "activations": [
            *draw(st.lists(st.sampled_from(ACTIVATIONS), min_size=layers - 1, max_size=layers - 1)),
            draw(st.sampled_from(BOUNDED)),
        ],
        "input_scale": draw(st.lists(scale, min_size=states + inputs, max_size=states + inputs)),
        "output_scale": draw(st.lists(scale, min_size=states, max_size=states)),
        "architecture": architecture,
        "window": window,
        "options": options,
    }
    try:
        return NetworkDescription(**fields)
    except ValueError:
        reject()  # the architecture refuses these sizes


def test_the_three_shipped_architectures_are_known() -> None:
    assert set(architecture_names()) >= {"mlp", "rnn", "cnn"}
    assert get_architecture("cnn").options == {"kernel": 3}


@settings(max_examples=80, deadline=None)
@given(descriptions(), st.integers(0, 2**32 - 1), st.sampled_from([0.1, 1.0, 10.0]))
def test_torch_casadi_and_numpy_agree_to_1e_12_in_float64(
    description: NetworkDescription, seed: int, size: float
) -> None:
    check_parity(description, seed, size)


def check_parity(description: NetworkDescription, seed: int, size: float = 1.0) -> None:
    """Compare the value, its CasADi and torch slopes along every entry of the window, and the bound of phi."""
    found = parity(description, seed, size)
    assert found.holds, found


def test_softplus_agrees_for_large_arguments() -> None:
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
    expressions, theta = function(oracle), oracle.pack(hidden, K)
    for x in (-60.0, -5.0, 0.0, 19.9, 20.1, 21.0, 30.0, 49.0, 51.0, 600.0):
        ours = h_hat_of(network, network.tensor([[x, 0.0]]), network.tensor(K)).item()
        assert abs(ours - float(expressions([x], [0.0], theta)[0])) < 1e-12


def test_a_controller_and_a_plant_load_neither_torch_nor_the_trainer() -> None:
    loaded = imported("import controller_node.node, plant_sim.node")
    assert not loaded & {"torch", "trainer_node"}


def test_a_trainer_loads_neither_casadi_nor_the_science() -> None:
    assert not imported("import trainer_node.node") & {"casadi", "lbmpc"}
