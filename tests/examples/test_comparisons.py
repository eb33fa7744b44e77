"""Examples in lock-step, shorter than on their pages: what learning is worth on each."""

from __future__ import annotations

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


def test_tanks_learning_takes_the_offset_away() -> None:
    J, off = costs("tanks", 40, "linear", "constant 0.5", "dnn")
    assert off["linear"] > 0.4
    assert off["dnn"] < 0.05
    assert J["dnn"] < 0.98 * J["linear"]
    assert J["dnn"] < 1.02 * J["constant 0.5"]


def test_reactor_learning_keeps_what_is_unstable_and_sampled_seldom() -> None:
    J, off = costs("reactor", 60, "linear", "dnn")
    assert off["linear"] > 15.0
    assert off["dnn"] < 5.0
    assert J["dnn"] < 0.7 * J["linear"]


def test_quadrotor_learning_holds_its_place_in_the_wind() -> None:
    J, off = costs("quadrotor", 100, "linear", "dnn")
    assert off["linear"] > 0.08
    assert off["dnn"] < 0.03
    assert J["dnn"] < 0.99 * J["linear"]


def test_crane_of_mujoco_learning_is_worth_it() -> None:
    J, off = costs("mujoco_crane", 225, "linear", "constant 0.5", "dnn")
    assert off["linear"] > 0.2
    assert off["dnn"] < 0.08
    assert J["dnn"] < 0.95 * J["linear"]
    assert J["dnn"] < 1.02 * J["constant 0.5"]


def test_pendulum_of_gymnasium_learning_is_worth_it() -> None:
    J, off = costs("gymnasium_pendulum", 60, "linear", "constant 0.2", "dnn")
    assert off["linear"] > 0.025
    assert off["dnn"] < 0.015
    assert J["dnn"] < 0.98 * J["linear"]
    assert J["dnn"] < J["constant 0.2"]


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
