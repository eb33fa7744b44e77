"""Intervals are rigorous: they contain every value of an operation or a function."""

from __future__ import annotations

from fractions import Fraction

import mpmath
import numpy as np
import pytest

from lbmpc.sets.enclosures.interval import DomainError, Interval, matrix_product, up
from tests.lbmpc.sets.enclosures.samples import holds


def numbers(generator: np.random.Generator, n: int) -> np.ndarray:
    """Return floats of every kind: both signs, zeros, ordinary, huge, tiny, subnormal, and neighbours of integers."""
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
    # They are also tight: without overflow a point is widened by a few units in the last place only.
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


def test_interval_reports_where_an_operation_is_not_defined():
    with pytest.raises(DomainError, match="sqrt") as caught:
        Interval(np.array([1.0, -1.0]), np.array([2.0, 2.0])).sqrt()
    assert caught.value.where.tolist() == [False, True]
    with pytest.raises(DomainError, match="division"):
        Interval.of(np.ones(1)) / Interval(np.zeros(1), np.ones(1))
