"""Examples in lock-step, shorter than on their pages: what learning is worth on each."""

from __future__ import annotations

import pytest

from examples.compare import compare, picture
from tests.helpers.paths import ROOT

EXAMPLES = ROOT / "examples"
NOT_COMPILED = {"controller": {"solver": {"compile": "never"}}}


def costs(name: str, steps: int, *oracles: str) -> tuple[dict[str, float], dict[str, float]]:
    """J of each oracle, and how far the first performance state is off at the end."""
    folder = EXAMPLES / name
    (config,) = folder.glob("*.toml")
    rows = compare(config, steps, oracles, **NOT_COMPILED)
    assert all(row.violations == 0 for row in rows)
    first = rows[0].result.traces.plant.performance[0]
    return {row.oracle: row.J[0] for row in rows}, {row.oracle: abs(row.rest[first]) for row in rows}


@pytest.mark.parametrize(
    ("name", "steps", "constant", "linear_off", "dnn_off", "of_linear", "of_constant"),
    [
        ("tanks", 40, "constant 0.5", 0.4, 0.05, 0.985, 1.02),
        ("mujoco_crane", 225, "constant 0.5", 0.2, 0.08, 0.95, 1.02),
        ("gymnasium_pendulum", 60, "constant 0.2", 0.025, 0.015, 0.98, 1.0),
    ],
)
def test_learning_takes_the_offset_away_and_is_worth_it(
    name: str,
    steps: int,
    constant: str,
    linear_off: float,
    dnn_off: float,
    of_linear: float,
    of_constant: float,
) -> None:
    """linear_off, dnn_off: off by so much at the end. of_linear, of_constant: J of dnn is a smaller share of theirs."""
    J, off = costs(name, steps, "linear", constant, "dnn")
    assert off["linear"] > linear_off
    assert off["dnn"] < dnn_off
    assert J["dnn"] < of_linear * J["linear"]
    assert J["dnn"] < of_constant * J[constant]


def test_quadrotor_learning_holds_its_place_in_the_wind() -> None:
    J, off = costs("quadrotor", 100, "linear", "dnn")
    assert off["linear"] > 0.08
    assert off["dnn"] < 0.03
    assert J["dnn"] < 0.99 * J["linear"]


def test_a_picture_has_one_line_for_the_best_constant() -> None:
    oracles = ("linear", "constant 0.2", "constant 1")
    rows = compare(EXAMPLES / "tanks" / "tanks.toml", 5, oracles, episodes=2, **NOT_COMPILED)
    figure = picture(rows, rows[0].result.traces.plant)
    _, labels = figure.axes[0].get_legend_handles_labels()
    best = min(rows[1:], key=lambda row: row.J[-1])
    assert labels == [
        f"{rows[0].oracle}: J = {rows[0].J[1]:.4g}",
        f"{best.oracle}: J = {best.J[1]:.4g}",
        "x_e, u_e",
    ]
    assert [len(line.get_xdata()) for line in figure.axes[0].lines[:2]] == [6, 6]
