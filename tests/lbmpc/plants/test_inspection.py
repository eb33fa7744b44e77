"""A plant that cannot be used is refused at its look-up with the fault, its place and the remedy."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import casadi as ca
import numpy as np
import pytest

from examples.quadrotor.quadrotor import QUADROTOR
from examples.tanks.tanks import TANKS
from lbmpc.model import ModelError, build_model
from lbmpc.plants import PLANTS, Plant, PlantDefinitionError, get_plant
from lbmpc.plants.equations import Domain
from lbmpc.plants.inspection import faults
from lbmpc.plants.moore_greitzer import MOORE_GREITZER
from tests.helpers.plants.integrator import INTEGRATOR
from tests.helpers.plants.pendulum import PENDULUM, inverted
from tests.helpers.plants.pendulum import equations as pendulum_of
from tests.helpers.plants.unstable import unstable

INF, NAN = float("inf"), float("nan")


def changed(**fields: object) -> Plant:
    if "rhs" in fields:
        fields = {"parameters": {}, "equations": None, **fields}
    return replace(PENDULUM, **fields)


def one_state() -> Plant:
    """A level that follows a flow, in a unit that is much too large for it."""
    return Plant(
        name="slow",
        states=("level",),
        inputs=("flow",),
        units={"level": "nm", "flow": "nm/s", "t": "s"},
        rhs=lambda x, u: [u[0] - x[0]],
        **{name: [0.0] for name in ("x_e", "u_e", "x0", "safe_input")},
        **{name: [-1e-9] for name in ("x_min", "u_min")},
        **{name: [1e-9] for name in ("x_max", "u_max", "W")},
        performance=(0,),
        kernel=("level",),
    )


FAULTY: dict[str, tuple[Plant, str]] = {
    "bounds of an input that cross": (changed(u_min=[4.0]), "u_min of torque is 4 and u_max is 3"),
    "bounds of a state that touch": (changed(x_min=[1.0, -2.0]), "x_min of angle is 1 and x_max is 1"),
    "NaN in a bound": (changed(x_max=[NAN, 2.0]), "x_max of angle is nan"),
    "NaN in W": (changed(W=[0.01, NAN]), "W of rate is nan: give a finite"),
    "infinite W": (changed(W=[INF, 0.1]), "W of angle is inf"),
    "negative W": (changed(W=[0.01, -0.1]), "W of rate is -0.1: a half-width is at least 0"),
    "x0 too short": (changed(x0=[0.5]), r"x0 is \[0.5\]: it needs 2 entries, one for each of angle, rate"),
    "x_e as a column": (changed(x_e=[[0.0], [0.0]]), "x_e is .* needs 2 entries"),
    "text instead of numbers": (changed(x0="here"), "x0 is 'here': give numbers"),
    "a transposed gain": (changed(safe_gain=[[1.0], [2.0]]), "safe_gain is .* a row for each input"),
    "rhs too short": (changed(rhs=lambda x, u: [x[1]]), "rhs returns 1 entries: it needs 2"),
    "rhs returns None": (changed(rhs=lambda x, u: None), "rhs returns None: it must return a list"),
    "rhs with text": (changed(rhs=lambda x, u: ["a", 0]), "CasADi cannot use the result of rhs"),
    "a foreign symbol": (changed(rhs=lambda x, u: [ca.SX.sym("q"), 0]), r"variables \[q\] are free"),
    "rhs that fails": (changed(rhs=lambda x, u: [x[1], 1 / 0]), r"rhs fails in line \d+: ZeroDivisionError"),
    "a condition on a state": (
        changed(rhs=lambda x, u: [x[1] if x[0] > 0 else 0, u[0]]),
        "ca.if_else, not if",
    ),
    "math.sin": (changed(rhs=lambda x, u: [x[1], math.sin(x[0]) + u[0]]), "ca.sin, not math.sin"),
    "no performance state": (changed(performance=()), "performance is .* at least one state"),
    "performance out of range": (
        changed(performance=(0, 2)),
        r"performance has 2: .* 0 \(angle\) to 1 \(rate\)",
    ),
    "performance counted backwards": (changed(performance=(-1,)), "performance has -1"),
    "performance with a name": (changed(performance=("angle",)), "performance has 'angle': a state's index"),
    "an unknown kernel variable": (
        changed(kernel=("angle", "rat")),
        "kernel has 'rat', .* choose from angle, rate",
    ),
    "no unit of time": (
        changed(units={"angle": "rad", "rate": "1/s", "torque": "1"}),
        "units has none for t",
    ),
    "an equilibrium outside X": (
        changed(x_e=[math.pi, 0.0]),
        "x_e of angle is 3.14159, but x_min of angle is -1 and x_max is 1: the equilibrium must lie",
    ),
    "an equilibrium outside U": (changed(u_e=[5.0]), "u_e of torque is 5, but u_min of torque is -3"),
    "not an equilibrium": (changed(x_e=[0.5, 0.0]), "not an equilibrium: drate/dt is 1.92"),
    "no equilibrium in small units": (
        replace(one_state(), x_e=[5e-10]),
        "not an equilibrium: dlevel/dt is -5e-10",
    ),
    "an equilibrium without a slope": (
        changed(rhs=lambda x, u: [x[1], ca.sqrt(x[0]) + u[0]]),
        "slopes of dx/dt are not finite",
    ),
    "a start outside the domain": (
        changed(rhs=lambda x, u: [x[1], ca.log(1 - 3 * x[0]) + u[0]]),
        "drate/dt is nan at x0",
    ),
    "a safe input outside U": (changed(safe_input=[-4.0]), "safe_input of torque is -4, outside u_min = -3"),
    "two states of one name": (changed(states=("angle", "angle")), "2 states or inputs are called 'angle'"),
    "a state named as an input": (changed(inputs=("rate",)), "2 states or inputs are called 'rate'"),
    "a state named as time": (changed(states=("angle", "t")), "called 't', the name of time"),
    "a forgotten comma": (changed(inputs="u"), r"inputs is the text 'u': write \('u',\), with the comma"),
    "no inputs": (changed(inputs=()), "inputs is empty"),
    "a domain of no state": (changed(positive=(Domain(2, "pressure", "bar"),)), "pressure names state 2"),
    "x0 outside its domain": (
        replace(MOORE_GREITZER, x0=[0.15, -1.0, 1.0, 0.0]),
        "x0 of y is -1: pressure y must be positive there",
    ),
    "poles that grow": (changed(poles=(-1.0, 2.0)), "a stable pole has a negative real part"),
    "one pole of a pair": (changed(poles=(-1.0 + 1j, -1.0)), "conjugate pairs"),
    "no scale without a bound": (
        replace(INTEGRATOR, scale={}),
        r"x_min of speed is -inf and x_max is inf: give both bounds, or scale=\{'speed': ...\}",
    ),
    "no scale on one side": (
        changed(u_max=[INF]),
        r"u_min of torque is -3 and u_max is inf: .*scale=\{'torque'",
    ),
    "a scale of an unknown name": (
        replace(INTEGRATOR, scale={"speed": 2.0, "spede": 2.0}),
        "scale has 'spede'",
    ),
    "a scale of 0": (
        replace(INTEGRATOR, scale={"speed": 0.0}),
        "scale of speed is 0.0: .* a positive number",
    ),
    "parameters without equations": (
        changed(equations=None),
        "parameters has stiffness, gain and equations is None: give the function",
    ),
    "a parameter as text": (changed(parameters={"gain": "high"}), "parameters is .*: give numbers by name"),
    "parameters that the equations do not have": (
        changed(parameters={"gain": 1.0}),
        "equations fails with symbols for gain: TypeError",
    ),
    "a condition on a parameter": (
        changed(equations=lambda stiffness, gain: pendulum_of(stiffness if stiffness > 0 else 0.0, gain)),
        "equations fails with symbols for stiffness, gain",
    ),
    "other parameters than in rhs": (
        changed(parameters={"stiffness": 5.0, "gain": 1.0}),
        r"rhs is not what equations makes of parameters: write rhs=equations\(\*\*parameters\)",
    ),
}


@pytest.mark.parametrize("case", FAULTY)
def test_a_faulty_plant_is_refused_with_its_fault(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plant, message = FAULTY[case]
    monkeypatch.setitem(PLANTS, "faulty", plant)
    with pytest.raises(PlantDefinitionError, match=message) as caught:
        get_plant("faulty")
    text = str(caught.value)
    assert text.startswith(f"the plant {plant.name!r} cannot be used")
    # Each fault gives one sentence, and no other fault is reported.
    assert len(faults(plant)) == 1
    assert f"{plant.rhs.__code__.co_filename}, line" in text


def test_all_faults_of_a_plant_are_named_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    bad = changed(u_min=[4.0], W=[-1.0, 0.1], performance=(5,), kernel=("x",), rhs=lambda x, u: [])
    monkeypatch.setitem(PLANTS, "bad", bad)
    with pytest.raises(PlantDefinitionError) as caught:
        get_plant("bad")
    lines = [line.strip(" -") for line in str(caught.value).splitlines()[1:]]
    assert [line.split()[0] for line in lines] == ["u_min", "W", "rhs", "performance", "kernel"]


def test_a_model_of_a_faulty_plant_is_refused_as_well() -> None:
    with pytest.raises(ModelError, match="u_min of torque is 4"):
        build_model(changed(u_min=[4.0]), 0.1)


SOUND = [
    *(MOORE_GREITZER, PENDULUM, INTEGRATOR, TANKS, QUADROTOR, one_state()),
    *(unstable(12.0), inverted(1.0), inverted(0.1)),
]


@pytest.mark.parametrize("plant", SOUND, ids=lambda p: p.name)
def test_a_sound_plant_has_no_faults(plant: Plant) -> None:
    assert faults(plant) == ()


def test_lists_are_accepted_for_arrays_and_tuples() -> None:
    fields = ("x_e", "u_e", "x_min", "x_max", "u_min", "u_max", "W", "x0", "safe_input", "safe_gain")
    names = ("states", "inputs", "performance", "kernel", "positive", "poles")
    lists = {name: getattr(MOORE_GREITZER, name).tolist() for name in fields}
    plant = replace(MOORE_GREITZER, **lists, **{name: list(getattr(MOORE_GREITZER, name)) for name in names})
    assert faults(plant) == ()
    for name in fields:
        np.testing.assert_array_equal(getattr(plant, name), getattr(MOORE_GREITZER, name), strict=True)
    assert all(getattr(plant, name) == getattr(MOORE_GREITZER, name) for name in names)


def test_by_default_all_states_are_reported_and_in_the_kernel() -> None:
    chosen = ("performance", "kernel")
    given = {one.name: getattr(PENDULUM, one.name) for one in fields(Plant) if one.name not in chosen}
    plant = Plant(**given)
    assert (plant.performance, plant.kernel) == ((0, 1), (*PENDULUM.states, *PENDULUM.inputs))
    assert faults(plant) == ()


def test_rounding_of_an_equilibrium_is_relative_to_the_half_widths() -> None:
    """A pressure in pascal: digits that are correct to a millionth leave a residual of 0.1 Pa/s."""
    in_pascal = replace(
        one_state(),
        rhs=lambda x, u: [2.0 * (u[0] - x[0])],
        x_e=[1e5 / 3],
        u_e=[33333.3],
        **{name: [0.0] for name in ("x_min", "u_min")},
        **{name: [1e5] for name in ("x_max", "u_max")},
    )
    assert faults(in_pascal) == ()


def test_half_widths_come_from_two_bounds_or_from_the_scale() -> None:
    np.testing.assert_array_equal(INTEGRATOR.x_scale, [1.0, 2.0])
    np.testing.assert_array_equal(INTEGRATOR.u_scale, [2.0])
    # A scale has no effect on a variable with bounds.
    np.testing.assert_array_equal(replace(INTEGRATOR, scale={"speed": 2.0, "push": 9.0}).u_scale, [2.0])
    half = replace(INTEGRATOR, x_min=[-1.0, -1.0])
    np.testing.assert_array_equal(half.x_scale, [1.0, 2.0])


def test_half_widths_of_the_compressor_are_unchanged() -> None:
    plant = MOORE_GREITZER
    np.testing.assert_array_equal(plant.x_scale, (plant.x_max - plant.x_min) / 2)
    np.testing.assert_array_equal(plant.u_scale, (plant.u_max - plant.u_min) / 2)
