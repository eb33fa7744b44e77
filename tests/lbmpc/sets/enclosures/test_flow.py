"""Enclosures of the flow over a period, and of its derivative, are rigorous and tight."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import mpmath
import numpy as np
import pytest

from lbmpc.plants.truth import Truth
from lbmpc.sets.enclosures.flow import Flow, FlowEnclosure
from lbmpc.sets.enclosures.interval import Interval, up
from tests.lbmpc.sets.enclosures.samples import TRUTH, a_plant, holds


def flow_of(rhs, d: int, m: int, period: float, steps: int = 1) -> Flow:
    x, u = ca.SX.sym("x", d), ca.SX.sym("u", m)
    return Flow(ca.Function("f", [x, u], [ca.vertcat(*rhs(x, u))]), period, steps)


def fly(flow: Flow, centre: np.ndarray, radii: np.ndarray) -> FlowEnclosure:
    """Return the flow of the boxes centre +- radii, both (n, d + m)."""
    low, high = centre - radii, centre + radii
    reach = up(np.maximum(high - centre, centre - low))
    box, c, d = Interval(low, high), Interval.of(centre), flow.d
    flight = flow.enclose(box[:, :d], box[:, d:], c[:, :d], c[:, d:], reach)
    assert flight.proved.all(), flight.trouble
    return flight


def test_flow_of_a_linear_system_is_its_matrix_exponential():
    flow = flow_of(lambda x, u: [x[1], -4 * x[0] - 0.5 * x[1] + u[0]], 2, 1, 0.3, 2)
    block = np.array([[0.0, 1.0, 0.0], [-4.0, -0.5, 1.0], [0.0, 0.0, 0.0]])
    with mpmath.workdps(40):
        exact = mpmath.expm(mpmath.matrix(block.tolist()) * mpmath.mpf(0.3))
        flight = fly(flow, np.array([[1.0, -2.0, 0.5]]), np.array([[1.0, 2.0, 3.0]]))
        for i in range(2):
            for j in range(3):
                low, high = flight.derivative.lower[0, i, j], flight.derivative.upper[0, i, j]
                assert low <= exact[i, j] <= high
                assert high - low < 1e-13
            value = exact[i, 0] - 2 * exact[i, 1] + exact[i, 2] / 2
            assert flight.centre.lower[0, i] <= value <= flight.centre.upper[0, i]
            assert flight.centre.upper[0, i] - flight.centre.lower[0, i] < 1e-12


@pytest.mark.parametrize("radius", [0.0, 0.01, 0.4])
def test_flow_of_a_closed_form(radius):
    """x' = -x^2: x(t) = x / (1 + x t), dx(t)/dx = 1 / (1 + x t)^2."""
    flow = flow_of(lambda x, u: [-(x[0] ** 2)], 1, 1, 0.5, 2)
    flight = fly(flow, np.array([[1.0, 0.0], [-0.5, 0.0]]), np.array([[radius, 0.0], [radius, 0.0]]))
    t = Fraction(1, 2)
    for i, centre in enumerate((1.0, -0.5)):
        for x in (centre - radius, centre, centre + radius):
            x = Fraction(x)
            assert holds(flight.end[:, 0], i, x / (1 + x * t))
            assert holds(flight.derivative[:, 0, 0], i, 1 / (1 + x * t) ** 2)
        true = 2 * radius / (1 + (centre - radius) * 0.5) / (1 + (centre + radius) * 0.5)
        assert flight.end.upper[i, 0] - flight.end.lower[i, 0] <= true * (1 + 10 * radius) + 1e-11


def every_operation(x, u):
    return [
        ca.sin(x[0]) * ca.tanh(x[1]) + ca.log(3 + x[0] * x[1]) - x[0] ** 3 / (2 + ca.cos(x[1])),
        ca.exp(-(x[0] ** 2)) * u[0] - ca.sqrt(4 + x[1]) + 1 / (x[0] + 5) ** 2 - (x[1] + 3) ** 1.5 + 2 * x[0],
    ]


@pytest.mark.parametrize(
    "rhs",
    [lambda x, u: [x[1], -ca.sin(x[0]) - 0.1 * x[1] + u[0]], every_operation],
    ids=["pendulum", "every"],
)
@pytest.mark.parametrize("radius", [0.0, 0.02, 0.2])
@pytest.mark.long
def test_flow_against_a_numerical_integration(rhs, radius):
    generator = np.random.default_rng(3)
    flow = flow_of(rhs, 2, 1, 0.2, 2)
    n = 12
    centre = generator.uniform(-0.8, 0.8, (n, 3))
    flight = fly(flow, centre, np.full((n, 3), radius))
    plant = a_plant(rhs)
    truth = Truth(plant)
    for i in range(n):
        middle = truth.step(centre[i, :2], centre[i, 2:], 0.2)
        assert (flight.centre.lower[i] - TRUTH <= middle).all()
        assert (middle <= flight.centre.upper[i] + TRUTH).all()
        for corner in generator.choice([-1.0, 0.3, 1.0], (6, 3)):
            p = centre[i] + radius * corner
            end = truth.step(p[:2], p[2:], 0.2)
            assert (flight.end.lower[i] - TRUTH <= end).all()
            assert (end <= flight.end.upper[i] + TRUTH).all()
            for j, step in enumerate(1e-4 * np.eye(3)):
                ahead, behind = (truth.step((p + s)[:2], (p + s)[2:], 0.2) for s in (step, -step))
                slope = (ahead - behind) / 2e-4
                assert (flight.derivative.lower[i, :, j] - 1e-6 <= slope).all()
                assert (slope <= flight.derivative.upper[i, :, j] + 1e-6).all()
    if radius == 0.0:
        assert (flight.centre.upper - flight.centre.lower).max() < 1e-10
        assert (flight.derivative.upper - flight.derivative.lower).max() < 1e-8
