"""The tables of noisy plants: requirements on the network, and the noise of a run."""

from __future__ import annotations

import io
from collections.abc import Callable
from math import inf, nan

import pytest
from rich.console import Console

from verification.noisy_plants import Case, Row, failures, job, show

NO_LATER = [nan, nan, nan]


def rows(dnn: list[float], outside: int = 0, lost: int = 0) -> dict[str, Row]:
    return {
        "linear": Row([1.0, 1.1, 1.2], NO_LATER, 2, 0),
        "constant 0.2": Row([1.2, 1.0, 1.3], NO_LATER, 90, 1),
        "perfect": Row([0.1, 0.1, 0.1], NO_LATER, 10, 0),
        "dnn": Row(dnn, NO_LATER, outside, lost),
    }


@pytest.mark.parametrize(
    ("found", "what"),
    [
        (rows([1.0, 1.1, 1.2]), None),
        (rows([0.9, 1.13, 1.3]), None),
        (rows([1.0, 1.14, 1.2]), "median J is 1.036"),
        # The best of that seed is the constant.
        (rows([0.9, 1.16, 1.0]), "one seed's J is 1.16"),
        (rows([1.0, 1.0, inf], lost=1), "1 lost"),
        (rows([1.0, 1.0, 1.0], outside=12), None),
        (rows([1.0, 1.0, 1.0], outside=13), "13 samples outside X, 10 at most otherwise"),
    ],
)
def test_requirements_on_the_network(found: dict[str, Row], what: str | None) -> None:
    assert (what is None) == (not failures(found))
    assert what is None or any(what in one for one in failures(found))


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda dnn: dnn._replace(J=[1.02] * 3), "the estimator alone makes J 1.020"),
        (lambda dnn: dnn._replace(later=[0.22] * 3), "later episodes: 1.100 of perfect's"),
        (lambda dnn: dnn, None),
    ],
)
def test_requirements_without_noise_and_on_later_episodes(
    change: Callable[[Row], Row], what: str | None
) -> None:
    of = rows([1.0] * 3)
    of["perfect"] = of["perfect"]._replace(later=[0.2] * 3)
    of["dnn"] = of["dnn"]._replace(later=[0.21] * 3)
    without, of["dnn"] = of["dnn"], change(of["dnn"])
    found = failures(of, without)
    assert found == [] if what is None else what in found[0]


def test_a_level_sets_the_noise_of_sensors_and_estimator() -> None:
    noisy, exact = (job(Case("tanks", level, "constant 0.5"), 3, 2, []) for level in ("0.01", "none"))
    assert noisy.config.plant.sensors.noise == noisy.config.estimator.noise == 0.01
    assert (noisy.config.estimator.kind, exact.config.estimator.kind) == ("kalman", "none")
    # Without noise nothing is random: all seeds are one run.
    assert (noisy.config.seed, exact.config.seed, noisy.episodes) == (3, 0, 2)
    assert noisy.config.constant.gain == 0.5


def test_the_table_has_unmet_requirements_and_the_remaining_gain() -> None:
    found = {
        Case("tanks", level, oracle): one
        for level in ("none", "0.01")
        for oracle, one in rows([0.7] * 3).items()
    }
    text = io.StringIO()
    console = Console(file=text, width=300)
    assert show(found, console)
    assert "tanks: of J_linear - J_dnn without noise stays none: 100%, 0.01: 100%" in text.getvalue()
    found[Case("tanks", "0.01", "dnn")] = Row([0.9, 0.9, 1.4], NO_LATER, 0, 1)
    assert not show(found, console)
    assert "1 lost" in text.getvalue()
    assert "0.01: 50%" in text.getvalue()
