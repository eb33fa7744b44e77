"""Comparisons of oracles on the examples in lock-step, shorter than on their pages."""

from __future__ import annotations

import pytest

from examples.compare import compare, picture
from tests.helpers.paths import ROOT

EXAMPLES = ROOT / "examples"
NOT_COMPILED = {"controller": {"solver": {"compile": "never"}}}


def costs(name: str, steps: int, *oracles: str) -> tuple[dict[str, float], dict[str, float]]:
    """Return J of each oracle, and the error of the first performance state at the end."""
    folder = EXAMPLES / name
    (config,) = (path for path in folder.glob("*.toml") if path.stem in name)
    rows = compare(config, steps, oracles, **NOT_COMPILED)
    assert all(row.violations == 0 for row in rows)
    first = rows[0].result.traces.plant.performance[0]
    return {row.oracle: row.J[0] for row in rows}, {row.oracle: abs(row.rest[first]) for row in rows}


@pytest.mark.parametrize(
    ("name", "steps", "linear_off", "dnn_off", "shares"),
    [
        ("tanks", 40, 0.4, 0.05, {"linear": 0.98, "constant 0.5": 1.02}),
        ("reactor", 60, 15.0, 5.0, {"linear": 0.7}),
        ("quadrotor", 100, 0.08, 0.03, {"linear": 0.99}),
        ("mujoco_crane", 225, 0.2, 0.08, {"linear": 0.95, "constant 0.5": 1.02}),
        ("gymnasium_pendulum", 60, 0.025, 0.015, {"linear": 0.98, "constant 0.2": 1.0}),
    ],
)
def test_learning_removes_the_offset_and_lowers_J(
    name: str, steps: int, linear_off: float, dnn_off: float, shares: dict[str, float]
) -> None:
    """linear_off, dnn_off: error at the end. shares: J of the network is less than this share of theirs."""
    J, off = costs(name, steps, *shares, "dnn")
    assert off["linear"] > linear_off
    assert off["dnn"] < dnn_off
    for oracle, share in shares.items():
        assert J["dnn"] < share * J[oracle]


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
