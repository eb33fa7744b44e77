"""The configuration whose sets these tests compute, and the printed text about them."""

from __future__ import annotations

import json

import pytest

from node_runtime.config.loading import load
from node_runtime.config.sections import Config

START = [0.62, 0.0]
SETTINGS = [
    *("plant.model=pendulum", f"plant.x0={START}", "rate=10", "controller.oracle=linear"),
    *("controller.horizon=10", "controller.solver.compile=never"),
]
OPTIONS = [word for setting in SETTINGS for word in ("--set", setting)]


def told(capsys: pytest.CaptureFixture[str]) -> dict:
    return json.loads(capsys.readouterr().out)


def invariant(*more: str) -> Config:
    return load(None, [*SETTINGS, "controller.tightening=invariant", *more])
