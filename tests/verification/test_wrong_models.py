"""The tables of wrong models: requirements on the network, and the plant of a run."""

from __future__ import annotations

import pytest

from verification.wrong_models import Row, run_one, verdict


def row(oracle: str, first: float, later: float, violations: int = 0, lost: str | None = None) -> Row:
    nothing = {"iteration_limit": 0, "soft": 0, "fallback": 0, "chatter": 0.0}
    costs = [first, later, later]
    return Row(
        plant="tanks", horizon=1.0, oracle=oracle, J=costs, violations=violations, lost=lost, **nothing
    )


@pytest.mark.parametrize(
    ("dnn", "constant", "perfect", "expected"),
    [
        ((1.09, 1.01), (1.2, 1.2), (1.0, 1.0), True),
        ((1.11, 1.01), (1.2, 1.2), (1.0, 1.0), False),
        ((1.05, 1.03), (1.2, 1.2), (1.0, 1.0), False),
        # The constant is the better one here, and the requirement follows it.
        ((1.09, 1.01), (0.9, 1.2), (1.0, 1.0), False),
        ((1.09, 1.01), (1.2, 0.95), (1.0, 1.0), False),
    ],
)
def test_requirements_on_the_network(
    dnn: tuple[float, float], constant: tuple[float, float], perfect: tuple[float, float], expected: bool
) -> None:
    rows = [row("dnn", *dnn), row("constant 0.2", 9.0, 9.0), row("constant 1", *constant)]
    met, words = verdict([*rows, row("perfect", *perfect)])
    assert met is expected
    assert words.startswith("met" if expected else "NOT met")


def test_there_is_no_requirement_if_perfect_leaves_X() -> None:
    rows = [row("dnn", 9.0, 9.0), row("constant 1", 1.0, 1.0)]
    assert verdict([*rows, row("perfect", 1.0, 1.0, violations=1)])[0]
    assert verdict([*rows, row("perfect", 1.0, 1.0, lost="far out")])[0]
    assert not verdict([*rows, row("perfect", 1.0, 1.0)])[0]


def test_a_run_simulates_the_true_plant_in_episodes_from_the_same_state() -> None:
    more = ["controller.solver.compile=never"]
    costs = {oracle: run_one("tanks", 0.25, oracle, 2, more).J for oracle in ("linear", "perfect")}
    assert costs["linear"][0] == pytest.approx(costs["linear"][1], rel=1e-9)
    assert costs["perfect"][0] < 0.95 * costs["linear"][0]
