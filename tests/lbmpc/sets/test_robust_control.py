"""Invariant sets compared with closed forms and published results, and the operations behind them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import linprog

from lbmpc.sets.geometry.operations import (
    BadlyScaledError,
    Body,
    FlatSetError,
    UnboundedSetError,
    body,
    body_of,
    eliminate,
)
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope
from lbmpc.sets.invariance.robust_control import UncertainSystem, predecessor, predecessor_iteration


def cube(half: list[float]) -> Polytope:
    return Polytope.box(-np.array(half), np.array(half), tuple(f"x{i}" for i in range(len(half))))


class Corners:
    """W as the hull of a box's corners."""

    def __init__(self, half: list[float]):
        self._points = np.array(list(itertools.product(*[(-h, h) for h in half])))

    def support(self, directions: np.ndarray) -> np.ndarray:
        return np.asarray((directions @ self._points.T).max(axis=1))


def maximal(X: Polytope, plant: UncertainSystem, slack: float = 1e-5) -> Body:
    *_, last = predecessor_iteration(body_of(X), plant, slack, patience=400)
    assert last.invariant
    return last.set


# -- operations ---------------------------------------------------------------------------------------------


def test_volume_and_vertices_of_a_simplex_and_a_cross_polytope() -> None:
    for d in (2, 3, 4):
        simplex = body(np.vstack([-np.eye(d), np.ones((1, d))]), np.append(np.zeros(d), 1.0))
        assert simplex.volume == pytest.approx(1 / np.prod(np.arange(1, d + 1)), rel=1e-9)
        assert len(simplex.vertices) == d + 1
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=d)))
        cross = body(signs, np.ones(len(signs)))
        assert len(cross.vertices) == 2 * d
        assert cross.volume == pytest.approx(2**d / np.prod(np.arange(1, d + 1)), rel=1e-9)


def test_the_chebyshev_centre_of_a_triangle_is_its_incentre() -> None:
    triangle = body(
        np.array([[-1.0, 0], [0, -1.0], [3.0, 4.0]]), np.array([0.0, 0.0, 12.0]), scale=np.ones(2)
    )
    assert triangle.centre == pytest.approx([1.0, 1.0])
    assert triangle.radius == pytest.approx(1.0)


def test_very_different_units_are_handled() -> None:
    units = np.array([1e-5, 1.0, 1e4])
    rows = np.vstack([np.eye(3), -np.eye(3), np.ones((1, 3))]) / units
    one = body(rows * units, np.array([1, 1, 1, 1, 1, 1, 1.5]))
    other = body(rows, np.array([1, 1, 1, 1, 1, 1, 1.5]))
    assert other.volume == pytest.approx(one.volume * units.prod(), rel=1e-9)
    assert len(other.reduced().g) == len(one.reduced().g) == 7


def test_redundant_rows_are_removed_without_changing_the_set() -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    many = body(
        np.vstack([directions, np.eye(3), -np.eye(3)]), np.append(rng.uniform(0.5, 9, 200), np.ones(6))
    )
    few = many.reduced()
    assert len(few.g) < 60
    for row, bound in zip(few.G, few.g, strict=True):
        # Each remaining row cuts something off.
        others = ~(row == few.G).all(axis=1)
        reach = linprog(-row, few.G[others], few.g[others], bounds=(None, None), method="highs")
        assert reach.status == 3 or -reach.fun > bound
    points = rng.uniform(-1, 1, (3000, 3))
    assert (few.contains(points) == many.contains(points)).all()


def test_elimination_equals_projection() -> None:
    rng = np.random.default_rng(1)
    G, g = (
        np.vstack([rng.normal(size=(30, 4)), np.eye(4), -np.eye(4)]),
        np.append(rng.uniform(0.2, 1, 30), np.ones(8)),
    )
    projected = body(*eliminate(G, g, 2))
    for x in rng.uniform(-1, 1, (200, 2)):
        found = linprog(np.zeros(2), G[:, 2:], g - G[:, :2] @ x, bounds=(None, None), method="highs")
        assert bool(projected.contains(x)) == (found.status == 0)


@pytest.mark.parametrize(
    ("G", "g", "error", "says"),
    [
        ([[1.0], [-1.0]], [1.0, -2.0], EmptySetError, "empty"),
        ([[1.0, 0], [-1.0, 0], [0, 1.0]], [1.0, 1.0, 1.0], UnboundedSetError, "unbounded in variable 1"),
        (
            [[1.0, 0], [-1.0, 0], [0, 1.0], [0, -1.0]],
            [1.0, 1.0, 3.0, -3.0],
            FlatSetError,
            "variable 1 is fixed at 3",
        ),
        (
            [[1.0, 0], [-1.0, 0], [0, 1.0], [0, -1.0]],
            [1.0, 1.0, 1e14, 1e14],
            BadlyScaledError,
            "use other units",
        ),
        ([[0.0], [1.0], [-1.0]], [-1.0, 1.0, 1.0], EmptySetError, "requires 0 <= -1"),
    ],
)
def test_sets_without_interior_are_reported(G: list, g: list, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        body(np.array(G), np.array(g))


# -- invariant sets -----------------------------------------------------------------------------------------


def test_one_unstable_state_in_closed_form() -> None:
    # x+ = a x + u + w: [-c, c] is kept if a c - u_max + w_max <= c, so c = (u_max - w_max) / (a - 1).
    plant = UncertainSystem(np.array([[1.5]]), np.array([[1.0]]), Corners([0.1]), cube([0.3]))
    found = maximal(cube([1.0]), plant)
    assert found.vertices.ravel() == pytest.approx([-0.4, 0.4], abs=1e-3)
    everything = UncertainSystem(np.array([[1.5]]), np.array([[1.0]]), Corners([0.1]), cube([0.7]))
    assert maximal(cube([1.0]), everything).vertices.ravel() == pytest.approx([-1.0, 1.0])
    hopeless = UncertainSystem(np.array([[1.5]]), np.array([[1.0]]), Corners([0.4]), cube([0.3]))
    with pytest.raises(EmptySetError, match=r"kept in X for \d+ steps.* may help"):
        maximal(cube([1.0]), hopeless)


def test_the_textbook_example_of_two_states() -> None:
    # Borrelli, Bemporad and Morari (2017), Example 10.6: the maximal control invariant set of this system is
    # {|x_2| <= 4, |0.55 x_1 - 0.83 x_2| <= 2.22}.
    plant = UncertainSystem(
        np.array([[1.5, 0.0], [1.0, -1.5]]), np.array([[1.0], [0.0]]), Corners([0, 0]), cube([5.0])
    )
    found = maximal(cube([10.0, 10.0]), plant, 1e-6)
    published = body(np.array([[0, 1.0], [0, -1.0], [1, -1.5], [-1, 1.5]]), np.full(4, 4.0))
    assert found.volume == pytest.approx(published.volume, rel=1e-3)
    assert published.includes(found, 1e-3)
    assert found.includes(published, 1e-3)


def test_three_decoupled_states_and_inputs_are_a_product_of_intervals() -> None:
    a, u, w = np.array([1.2, 1.6, 0.5]), [0.3, 0.5, 0.2], [0.1, 0.05, 0.1]
    plant = UncertainSystem(np.diag(a), np.eye(3), Corners(w), cube(u))
    found = maximal(cube([1.0, 1.0, 1.0]), plant, 1e-4)
    expected = [1.0, 0.45 / 0.6, 1.0]
    assert found.vertices.max(axis=0) == pytest.approx(expected, abs=2e-3)
    assert found.volume == pytest.approx(8 * np.prod(expected), rel=5e-3)


def test_a_slow_iteration_ends_with_a_smaller_certified_set() -> None:
    plant = UncertainSystem(np.array([[1.01]]), np.array([[1.0]]), Corners([0.001]), cube([0.005]))
    *_, last = predecessor_iteration(body_of(cube([1.0])), plant, 1e-6, patience=5)
    assert last.invariant
    assert last.step == 6
    assert 0.3 < last.set.vertices.max() <= 0.4


def test_an_interrupted_iteration_gives_the_same_set() -> None:
    plant = UncertainSystem(
        np.array([[1.0, 0.1], [0.0, 1.2]]), np.array([[0.0], [1.0]]), Corners([0.01, 0.01]), cube([0.2])
    )
    X = body_of(cube([1.0, 1.0]))
    stages = list(predecessor_iteration(X, plant, 1e-4))
    assert len(stages) > 4
    *_, again = predecessor_iteration(X, plant, 1e-4, start=stages[2])
    assert np.array_equal(again.set.G, stages[-1].set.G)
    assert np.array_equal(again.set.g, stages[-1].set.g)


def test_the_predecessor_matches_its_definition() -> None:
    rng = np.random.default_rng(3)
    A, B = rng.normal(size=(2, 2)), rng.normal(size=(2, 1))
    W, U, target = Corners([0.1, 0.2]), cube([0.7]), body_of(cube([1.0, 1.5]))
    rows = body(*predecessor(target, UncertainSystem(A, B, W, U)))
    for x in rng.uniform(-3, 3, (300, 2)):
        room = target.g - W.support(target.G) - target.G @ A @ x
        exists = linprog([0.0], target.G @ B, room, bounds=[(-0.7, 0.7)], method="highs").status == 0
        assert bool(rows.contains(x)) == exists
