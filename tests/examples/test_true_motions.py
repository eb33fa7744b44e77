"""External simulators as true plants: they keep no state between calls, and the parts of a period add up to it."""

from __future__ import annotations

import numpy as np
import pytest

from lbmpc.plants import Known, TrueMotion
from node_runtime.config.reference import load
from tests.helpers.paths import ROOT

CRANE = ("mujoco_crane/crane.py:CRANE", "mujoco_crane/known.py:CRANE")
PENDULUM = ("gymnasium_pendulum/pendulum.py:PENDULUM", "gymnasium_pendulum/known.py:PENDULUM")
BOTH = pytest.mark.parametrize("named", [CRANE, PENDULUM], ids=["mujoco", "gymnasium"])


def loaded(named: tuple[str, str]) -> tuple[TrueMotion, Known]:
    true, known = (load(str(ROOT / "examples" / name)) for name in named)
    return true, known


@BOTH
def test_the_same_numbers_in_give_the_same_numbers_out(named: tuple[str, str]) -> None:
    true, known = loaded(named)
    x, u = known.x0, known.u_e + 0.5
    once = true.step(x, u, 0.02)
    true.step(0.5 * known.x_max, known.u_min, 0.013)
    again = true.step(x, u, 0.02)
    assert once.tobytes() == again.tobytes()
    assert np.abs(once - x).max() > 1e-4
    # The returned state is not a view of the simulator's memory.
    assert not np.shares_memory(once, again)
    np.testing.assert_array_equal(true.step(x, u, 0.0), x)


@BOTH
def test_parts_of_a_period_make_the_whole(named: tuple[str, str]) -> None:
    true, known = loaded(named)
    x, u = known.x0, known.u_e + 0.5
    whole = true.step(x, u, 0.02)
    parts = true.step(true.step(x, u, 0.0063), u, 0.0137)
    np.testing.assert_allclose(parts, whole, atol=2e-3 * np.abs(whole - x).max())


SLIDING_BOX = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <joint type="hinge" axis="0 1 0"/>
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="x"/></actuator>
</mujoco>
"""


def test_mujocos_warm_start_is_reset() -> None:
    """MuJoCo's contact solver starts from its last solution, which would change results by rounding, so it is reset."""
    crane, _ = loaded(CRANE)
    model = type(crane.model).from_xml_string(SLIDING_BOX)
    box = type(crane)(model)
    rng, size = np.random.default_rng(0), np.array([1.0, 1e-3, 1e-2, 1.0, 1e-2, 1e-2])
    for x, other in size * rng.uniform(-1, 1, (20, 2, 6)):
        once = box.step(x, np.array([4.0]), 0.02)
        box.step(other, np.array([-20.0]), 0.02)
        assert box.step(x, np.array([4.0]), 0.02).tobytes() == once.tobytes()


def test_the_crane_without_wind_and_with_the_known_load_moves_by_the_matrices() -> None:
    """At the first instant, apart from the size of the load: the matrices are those of a point mass."""
    true, known = loaded(CRANE)
    model = type(true.model).from_xml_path(str(ROOT / "examples" / "mujoco_crane" / "crane.xml"))
    model.opt.wind[:] = 0.0
    load_of = model.body("load").id
    model.body_mass[load_of], model.body_inertia[load_of] = 2.0, 1e-6
    model.body_ipos[load_of] = [0.0, 0.0, -0.8]
    still = type(true)(model)
    for x, u in (
        ([0.0, 0.05, 0.0, 0.0], [0.0]),
        ([0.0, 0.0, 0.1, 0.0], [0.0]),
        ([0.0, 0.0, 0.0, 0.0], [2.0]),
    ):
        dx = (still.step(np.array(x), np.array(u), 1e-4) - x) / 1e-4
        np.testing.assert_allclose(dx, known.A @ x + known.B @ u, rtol=0.02, atol=2e-3)
