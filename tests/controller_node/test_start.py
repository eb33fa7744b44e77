"""The start of a controller: it imports only what it needs, because imports delay a restart."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy.signal import place_poles

from lbmpc.pole_placement import place

SLOW = ("scipy.signal", "scipy.integrate", "scipy.optimize", "scipy.stats", "scipy.spatial", "rich.console")


def test_a_controller_imports_no_unnecessary_slow_modules() -> None:
    code = (
        "import sys, tandem.cli, tandem.terminal, controller_node.node\n"
        "from controller_node.core import ControllerCore\n"
        "from node_runtime.config.loading import override; from node_runtime.config.sections import Config\n"
        "ControllerCore(override(Config(), ['controller.solver.compile=\"never\"']), 'controller-x')\n"
        f"sys.stdout.write(' '.join(name for name in {SLOW} if name in sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize("complex_pairs", [0, 1, 2])
@pytest.mark.parametrize("d", [4, 5])
def test_K_equals_scipys_bit_for_bit(d: int, complex_pairs: int) -> None:
    rng = np.random.default_rng([d, complex_pairs])
    for _ in range(5):
        A, B = rng.standard_normal((d, d)), rng.standard_normal((d, 1))
        pairs = [complex(*rng.uniform(-0.6, 0.6, 2)) for _ in range(complex_pairs)]
        poles = [p for pole in pairs for p in (pole, pole.conjugate())]
        poles += list(rng.uniform(-0.9, 0.9, d - len(poles)))
        poles = [poles[i] for i in rng.permutation(d)]
        K = place(A, B, poles)
        assert K.tobytes() == (-place_poles(A, B, poles).gain_matrix).tobytes()
        assert np.abs(np.sort_complex(np.linalg.eigvals(A + B @ K)) - np.sort_complex(poles)).max() < 1e-6


def test_several_inputs_use_scipy() -> None:
    rng = np.random.default_rng(0)
    A, B, poles = rng.standard_normal((4, 4)), rng.standard_normal((4, 2)), [0.1, 0.2, 0.3, 0.4]
    assert np.abs(np.sort(np.linalg.eigvals(A + B @ place(A, B, poles)).real) - poles).max() < 1e-8


@pytest.mark.parametrize(
    ("poles", "says"),
    [
        ([0.1, 0.2], "3 are needed"),
        ([0.1, 0.2, 0.2], "must be different"),
        ([0.1, 0.2 + 0.1j, 0.3], "conjugates"),
    ],
)
def test_invalid_poles_are_reported(poles: list[complex], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        place(np.eye(3), np.ones((3, 1)), poles)


def test_poles_of_an_uncontrollable_plant_cannot_be_placed() -> None:
    with pytest.raises(ValueError, match="placed"):
        place(np.diag([0.5, 0.6, 0.7]), np.zeros((3, 1)), [0.1, 0.2, 0.3])
