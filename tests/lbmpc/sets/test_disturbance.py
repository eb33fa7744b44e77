"""Bounds of the disturbance are rigorous: nothing that h does is outside them, and they are not much too wide."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import casadi as ca
import mpmath
import numpy as np
import pytest

from lbmpc.model import Model, build_model
from lbmpc.plants.equations import Plant, Rhs
from lbmpc.plants.moore_greitzer import MOORE_GREITZER
from lbmpc.plants.truth import Truth
from lbmpc.sets.enclosures.disturbance import (
    DisturbanceBound,
    DisturbanceError,
    Region,
    bound_affine,
    bound_box,
    bound_hull,
    given_box,
)
from lbmpc.sets.enclosures.flow import Flow, FlowEnclosure
from lbmpc.sets.enclosures.interval import DomainError, Interval, matrix_product, up
from tests.helpers.plants.pendulum import PENDULUM

SAMPLES = 2000
# What the integrator of the truth may be off by, per unit of the state's size.
TRUTH = 1e-11


def numbers(generator: np.random.Generator, n: int) -> np.ndarray:
    """Floats of every kind: both signs, zeros, ordinary, huge, tiny, subnormal, and neighbours of integers."""
    exponents = generator.choice([0, 1, 30, 300, -30, -300, -320], n)
    values = generator.standard_normal(n) * 10.0**exponents
    values[generator.random(n) < 0.1] = 0.0
    whole = generator.random(n) < 0.2
    values[whole] = np.nextafter(np.round(generator.uniform(-9, 9, n)), generator.choice([-9.0, 9.0], n))[
        whole
    ]
    return values


def intervals(generator: np.random.Generator, n: int) -> Interval:
    a, b = numbers(generator, n), numbers(generator, n)
    b = np.where(generator.random(n) < 0.3, a, b)
    return Interval(np.minimum(a, b), np.maximum(a, b))


def holds(bound: Interval, i: int, exact: Fraction) -> bool:
    """Infinity is a bound of everything on its side."""
    low, high = float(bound.lower[i]), float(bound.upper[i])
    return (low == -np.inf or Fraction(low) <= exact) and (high == np.inf or exact <= Fraction(high))


@pytest.mark.parametrize("name", ["add", "sub", "mul", "div", "square", "cube", "product"])
def test_interval_operations_contain_the_exact_rationals(name):
    generator = np.random.default_rng(1)
    n = 1500
    a, b = intervals(generator, n), intervals(generator, n)
    if name == "div":
        away = (b.lower > 0) | (b.upper < 0)
        a, b = a[away], b[away]
    results = {
        "add": lambda: a + b,
        "sub": lambda: a - b,
        "mul": lambda: a * b,
        "div": lambda: a / b,
        "square": lambda: a.power(2),
        "cube": lambda: a.power(3),
        "product": lambda: matrix_product(
            Interval(np.stack([a.lower, b.lower], 1)[:, None], np.stack([a.upper, b.upper], 1)[:, None]),
            Interval(np.stack([b.lower, a.lower], 1)[..., None], np.stack([b.upper, a.upper], 1)[..., None]),
        )[:, 0, 0],
    }
    exact = {
        "add": lambda x, y: x + y,
        "sub": lambda x, y: x - y,
        "mul": lambda x, y: x * y,
        "div": lambda x, y: x / y,
        "square": lambda x, y: x * x,
        "cube": lambda x, y: x**3,
        "product": lambda x, y: x * y + y * x,
    }
    result = results[name]()
    for i in range(len(a.lower)):
        for x in (a.lower[i], a.upper[i]):
            for y in (b.lower[i], b.upper[i]):
                if np.isfinite([x, y]).all():
                    assert holds(result, i, exact[name](Fraction(float(x)), Fraction(float(y)))), (name, x, y)
    # And they are tight: where no end overflows, a point is widened by a few units in the last place only.
    if name in ("add", "mul", "div"):
        point = {
            "add": lambda: a.lower + b.lower,
            "mul": lambda: a.lower * b.lower,
            "div": lambda: a.lower / b.lower,
        }
        with np.errstate(all="ignore"):
            value = point[name]()
        thin = {"add": Interval.of(a.lower) + b.lower, "mul": Interval.of(a.lower) * b.lower}.get(name)
        thin = Interval.of(a.lower) / b.lower if thin is None else thin
        fine = np.isfinite(value) & (np.abs(value) < 1e307)
        assert (thin.upper[fine] <= up(value[fine])).all()


@pytest.mark.parametrize("name", ["sqrt", "exp", "log", "sin", "cos", "tanh"])
def test_interval_functions_contain_values_to_forty_digits(name):
    generator = np.random.default_rng(2)
    low = generator.standard_normal(400) * 10.0 ** generator.integers(-6, 2, 400)
    low = np.abs(low) + 1e-300 if name in ("sqrt", "log") else low
    high = low + generator.exponential(1.0, 400) * 10.0 ** generator.integers(-16, 2, 400)
    result = getattr(Interval(low, high), name)()
    with mpmath.workdps(40):
        function = getattr(mpmath, name)
        for i in range(400):
            for x in (low[i], high[i], generator.uniform(low[i], high[i])):
                assert mpmath.mpf(result.lower[i]) <= function(mpmath.mpf(x)) <= mpmath.mpf(result.upper[i])
    thin = getattr(Interval.of(low), name)()
    assert (thin.upper - thin.lower <= 1e-14 * np.abs(thin.upper) + 1e-300).all()


def test_interval_says_where_an_operation_is_not_defined():
    with pytest.raises(DomainError, match="sqrt") as caught:
        Interval(np.array([1.0, -1.0]), np.array([2.0, 2.0])).sqrt()
    assert caught.value.where.tolist() == [False, True]
    with pytest.raises(DomainError, match="division"):
        Interval.of(np.ones(1)) / Interval(np.zeros(1), np.ones(1))


def flow_of(rhs, d: int, m: int, period: float, steps: int = 1) -> Flow:
    x, u = ca.SX.sym("x", d), ca.SX.sym("u", m)
    return Flow(ca.Function("f", [x, u], [ca.vertcat(*rhs(x, u))]), period, steps)


def fly(flow: Flow, centre: np.ndarray, radii: np.ndarray) -> FlowEnclosure:
    """The flow of the boxes centre +- radii, both (n, d + m)."""
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


def a_plant(
    rhs, name: str = "textbook", low: float = -1.0, high: float = 1.0, x_e=(0.0, 0.0), u_e=0.0
) -> Plant:
    two = np.ones(2)
    return Plant(
        name=name,
        states=("a", "b"),
        inputs=("u",),
        units={"a": "1", "b": "1", "u": "1", "t": "s"},
        rhs=rhs,
        x_e=np.array(x_e),
        u_e=np.array([u_e]),
        x_min=low * two,
        x_max=high * two,
        u_min=np.array([low]),
        u_max=np.array([high]),
        W=two,
        x0=np.zeros(2),
        safe_input=np.zeros(1),
        performance=(0,),
        kernel=("a",),
    )


VAN_DER_POL = a_plant(lambda x, u: [x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]], "van_der_pol")


def whole(model: Model) -> Region:
    p = model.plant
    return Region(p.x_min - p.x_e, p.x_max - p.x_e, p.u_min - p.u_e, p.u_max - p.u_e)


def draw(region: Region, n: int, seed: int) -> np.ndarray:
    """Points of a region, (n, d + m): inside, on faces, in corners."""
    generator = np.random.default_rng(seed)
    edge = generator.random((n, region.lower.size))
    inside = generator.uniform(region.lower, region.upper, edge.shape)
    return np.where(edge < 0.3, region.lower, np.where(edge > 0.7, region.upper, inside))


def disturbance(model: Model, p: np.ndarray) -> np.ndarray:
    """h at points (n, d + m), (n, d), from the plant's own integrator."""
    truth, d = Truth(model.equations), model.d
    x, u = p[:, :d], p[:, d:]
    after = np.array(
        [
            truth._in_many(a + model.plant.x_e, b + model.plant.u_e, model.period)
            for a, b in zip(x, u, strict=True)
        ]
    )
    return after - model.plant.x_e - x @ model.A.T - u @ model.B.T


def excess(bound: DisturbanceBound, p: np.ndarray, h: np.ndarray) -> float:
    """How far the samples stick out of the bound, in units of the samples' own range; not above zero when they are in.

    Measured in random directions and along the axes; what the integrator may be off by is forgiven.
    """
    d = h.shape[1]
    left = h - p[:, :d] @ bound.slope_x.T - p[:, d:] @ bound.slope_u.T
    generator = np.random.default_rng(5)
    directions = np.vstack(
        [np.eye(d), -np.eye(d), generator.standard_normal((60, d)) / (np.ptp(h, axis=0) + 1e-9)]
    )
    seen = (left @ directions.T).max(axis=0)
    range_ = np.ptp(h @ directions.T, axis=0)
    forgiven = TRUTH * 20 * np.abs(directions).sum(axis=1)
    return float(((seen - bound.support(directions) - forgiven) / (range_ + 1e-9)).max())


@pytest.fixture(scope="module", params=["compressor", "van_der_pol"])
def case(request) -> tuple[Model, np.ndarray, np.ndarray]:
    if request.param == "compressor":
        model = build_model(MOORE_GREITZER, 0.05)
    else:
        model = build_model(VAN_DER_POL, 0.1)
    p = draw(whole(model), SAMPLES, 4)
    return model, p, disturbance(model, p)


def test_box_holds_all_samples_and_is_tight(case):
    model, p, h = case
    told: list[float] = []
    bound = bound_box(model, whole(model), tolerance=0.01, progress=told.append)
    assert excess(bound, p, h) <= 0.0
    low, high = bound.vertices.min(axis=0), bound.vertices.max(axis=0)
    live = np.ptp(h, axis=0) > 1e-9
    slack = np.maximum(h.min(axis=0) - low, high - h.max(axis=0))[live] / np.ptp(h, axis=0)[live]
    assert slack.max() < 0.03
    assert (np.maximum(np.abs(low), np.abs(high))[~live] < 1e-9).all()
    assert told == sorted(told)
    assert told[-1] == 1.0
    # The same check refuses a bound that is too small by two parts in a hundred.
    small = DisturbanceBound(bound.region, bound.slope_x, bound.slope_u, 0.96 * bound.vertices)
    assert excess(small, p, h) > 0.0


def test_hull_holds_all_samples_and_lies_in_the_box(case):
    model, p, h = case
    box, hull = bound_box(model, whole(model)), bound_hull(model, whole(model))
    assert excess(hull, p, h) <= 0.0
    axes = np.vstack([np.eye(model.d), -np.eye(model.d)])
    width = box.support(axes) + box.support(-axes)
    assert (hull.support(axes) <= box.support(axes) + 1e-5 * width + 1e-12).all()
    if np.count_nonzero(np.ptp(h, axis=0) > 1e-9) > 1:
        live = np.flatnonzero(np.ptp(h, axis=0) > 1e-9)
        diagonal = np.zeros((4, model.d))
        diagonal[:, live[:2]] = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) / width[live[:2]]
        assert (hull.support(diagonal) < 0.95 * box.support(diagonal)).any()


def test_affine_bounds_hold_the_samples_of_their_regions(case):
    model, _, _ = case
    generator = np.random.default_rng(6)
    low, high = whole(model).lower, whole(model).upper
    regions = []
    for _ in range(6):
        c = generator.uniform(low + 0.1 * (high - low), high - 0.1 * (high - low))
        r = 0.1 * (high - low)
        regions.append(Region((c - r)[: model.d], (c + r)[: model.d], (c - r)[model.d :], (c + r)[model.d :]))
    for bound, plain in zip(bound_affine(model, regions), regions, strict=True):
        p = draw(plain, 150, 7)
        h = disturbance(model, p)
        assert excess(bound, p, h) <= 0.0
        left = h - p[:, : model.d] @ bound.slope_x.T - p[:, model.d :] @ bound.slope_u.T
        live = np.ptp(h, axis=0) > 1e-9
        assert (np.ptp(bound.vertices, axis=0)[live] < 4 * np.ptp(left, axis=0)[live]).all()
        assert (np.ptp(bound.vertices, axis=0)[~live] < 1e-9).all()


def test_affine_remainder_is_of_second_order():
    model = build_model(MOORE_GREITZER, 0.05)
    middle, half = (
        0.5 * (whole(model).lower + whole(model).upper),
        0.1 * np.ptp([whole(model).lower, whole(model).upper], axis=0),
    )
    regions = [
        Region(
            (middle - s * half)[:4], (middle + s * half)[:4], (middle - s * half)[4:], (middle + s * half)[4:]
        )
        for s in (1.0, 0.5)
    ]
    wide, narrow = (np.ptp(bound.vertices, axis=0)[:2] for bound in bound_affine(model, regions))
    np.testing.assert_allclose(wide / narrow, 4.0, rtol=0.15)


def test_stopped_early_the_bound_is_wider_and_still_holds():
    model = build_model(MOORE_GREITZER, 0.05)
    p = draw(whole(model), 300, 8)
    h = disturbance(model, p)
    early = bound_box(model, whole(model), budget=1)
    assert excess(early, p, h) <= 0.0
    full = bound_box(model, whole(model))
    assert (np.ptp(early.vertices, axis=0)[:2] > 1.05 * np.ptp(full.vertices, axis=0)[:2]).all()


def test_given_box_is_what_was_given():
    model = build_model(VAN_DER_POL, 0.1)
    bound = given_box(model, np.array([0.1, 0.2]), whole(model))
    np.testing.assert_allclose(bound.support(np.array([[1.0, 0.0], [1.0, -2.0]])), [0.1, 0.5], rtol=1e-15)
    assert (bound.support(np.array([[1.0, 0.0], [1.0, -2.0]])) >= [0.1, 0.5]).all()


@pytest.mark.parametrize("half", [[0.1], [0.1, -0.2], [0.1, np.nan]])
def test_given_box_refuses(half):
    model = build_model(VAN_DER_POL, 0.1)
    with pytest.raises(DisturbanceError, match="give 2 half-widths"):
        given_box(model, np.array(half), whole(model))


def test_a_region_where_the_equations_do_not_hold_is_named():
    model = build_model(MOORE_GREITZER, 0.05)
    region = whole(model)
    low = region.x_lower.copy()
    low[1] = -2.0
    with pytest.raises(DisturbanceError, match=r"y in \[.*sqrt.*smaller region"):
        bound_box(model, Region(low, region.x_upper, region.u_lower, region.u_upper))


def test_an_operation_without_series_is_named():
    plant = a_plant(lambda x, u: [x[1], ca.fabs(x[0]) - x[0] - x[1] + u[0]], "kink", x_e=(0.5, 0.0))
    model = build_model(plant, 0.1)
    with pytest.raises(DisturbanceError, match=r"kink.*fabs"):
        bound_box(model, whole(model))


def test_a_region_that_is_none_is_named():
    model = build_model(VAN_DER_POL, 0.1)
    r = whole(model)
    with pytest.raises(DisturbanceError, match=r"b in \[1, -1\]"):
        bound_box(model, Region(np.array([-1.0, 1.0]), np.array([1.0, -1.0]), r.u_lower, r.u_upper))
    with pytest.raises(DisturbanceError, match="2 states and 1 inputs"):
        bound_box(model, Region(r.x_lower[:1], r.x_upper[:1], r.u_lower, r.u_upper))


@pytest.mark.parametrize(
    ("rhs", "says"),
    [
        (
            lambda x, u: [x[1], u[0] - ca.sqrt(x[0] + 0.5) + ca.sqrt(0.5)],
            r"sqrt of an expression in angle .*above 0.*--kind given",
        ),
        (
            lambda x, u: [x[1], ca.log(1.0 + x[1] + u[0])],
            r"log of an expression in rate and torque .*above 0",
        ),
        (
            lambda x, u: [x[1], u[0] / (1.0 + x[0])],
            r"a division of an expression in angle .*must not come to 0",
        ),
        (lambda x, u: [x[1], u[0] - x[1] * ca.fabs(x[1])], r"`fabs`.*--kind given.*in rate"),
    ],
)
def test_what_has_no_bound_is_named_with_its_state_and_a_remedy(rhs: Rhs, says: str) -> None:
    model = build_model(replace(PENDULUM, rhs=rhs, parameters={}, equations=None), 0.1)
    with pytest.raises(DisturbanceError, match=says):
        bound_box(model, Region(*(np.array(b) for b in ([-1.0, -2.0], [1.0, 2.0], [-3.0], [3.0]))))
