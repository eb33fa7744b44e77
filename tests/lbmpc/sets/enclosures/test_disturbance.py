"""Bounds of the disturbance are rigorous and tight."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from lbmpc.model import Model, build_model
from lbmpc.plants.equations import Rhs
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
from tests.helpers.plants.pendulum import PENDULUM
from tests.lbmpc.sets.enclosures.samples import TRUTH, a_plant

SAMPLES = 2000
VAN_DER_POL = a_plant(lambda x, u: [x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]], "van_der_pol")


def whole(model: Model) -> Region:
    p = model.plant
    return Region(p.x_min - p.x_e, p.x_max - p.x_e, p.u_min - p.u_e, p.u_max - p.u_e)


def draw(region: Region, n: int, seed: int) -> np.ndarray:
    """Return points of a region, (n, d + m): inside, on faces, in corners."""
    generator = np.random.default_rng(seed)
    edge = generator.random((n, region.lower.size))
    inside = generator.uniform(region.lower, region.upper, edge.shape)
    return np.where(edge < 0.3, region.lower, np.where(edge > 0.7, region.upper, inside))


def disturbance(model: Model, p: np.ndarray) -> np.ndarray:
    """Return h at points (n, d + m), (n, d), from the plant's own integrator."""
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
    """Return how far samples exceed the bound, in units of the samples' range; not above zero if they are inside.

    It is measured in random directions and along the axes, with an allowance for the error of the integrator.
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
    # The same check rejects a bound that is too small by two percent.
    small = DisturbanceBound(bound.region, bound.slope_x, bound.slope_u, 0.96 * bound.vertices)
    assert excess(small, p, h) > 0.0


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.long
def test_stopped_early_the_bound_is_wider_and_still_holds():
    model = build_model(MOORE_GREITZER, 0.05)
    p = draw(whole(model), 300, 8)
    h = disturbance(model, p)
    early = bound_box(model, whole(model), budget=1)
    assert excess(early, p, h) <= 0.0
    full = bound_box(model, whole(model))
    assert (np.ptp(early.vertices, axis=0)[:2] > 1.05 * np.ptp(full.vertices, axis=0)[:2]).all()


def test_given_box_is_used_as_given():
    model = build_model(VAN_DER_POL, 0.1)
    bound = given_box(model, np.array([0.1, 0.2]), whole(model))
    np.testing.assert_allclose(bound.support(np.array([[1.0, 0.0], [1.0, -2.0]])), [0.1, 0.5], rtol=1e-15)
    assert (bound.support(np.array([[1.0, 0.0], [1.0, -2.0]])) >= [0.1, 0.5]).all()


@pytest.mark.parametrize("half", [[0.1], [0.1, -0.2], [0.1, np.nan]])
def test_given_box_refuses(half):
    model = build_model(VAN_DER_POL, 0.1)
    with pytest.raises(DisturbanceError, match="give 2 half-widths"):
        given_box(model, np.array(half), whole(model))


@pytest.mark.long
def test_a_region_outside_the_domain_is_reported():
    model = build_model(MOORE_GREITZER, 0.05)
    region = whole(model)
    low = region.x_lower.copy()
    low[1] = -2.0
    with pytest.raises(DisturbanceError, match=r"y in \[.*sqrt.*smaller region"):
        bound_box(model, Region(low, region.x_upper, region.u_lower, region.u_upper))


def test_an_operation_without_series_is_reported():
    plant = a_plant(lambda x, u: [x[1], ca.fabs(x[0]) - x[0] - x[1] + u[0]], "kink", x_e=(0.5, 0.0))
    model = build_model(plant, 0.1)
    with pytest.raises(DisturbanceError, match=r"kink.*fabs"):
        bound_box(model, whole(model))


def test_an_invalid_region_is_reported():
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
            r"a division of an expression in angle .*must not reach 0",
        ),
        (lambda x, u: [x[1], u[0] - x[1] * ca.fabs(x[1])], r"`fabs`.*--kind given.*in rate"),
    ],
)
def test_an_unbounded_operation_is_reported_with_state_and_remedy(rhs: Rhs, says: str) -> None:
    model = build_model(replace(PENDULUM, rhs=rhs, parameters={}, equations=None), 0.1)
    with pytest.raises(DisturbanceError, match=says):
        bound_box(model, Region(*(np.array(b) for b in ([-1.0, -2.0], [1.0, 2.0], [-3.0], [3.0]))))
