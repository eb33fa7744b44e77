"""`tandem model`: a start that runs as it is, and a look that names all that is wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lbmpc.model import build_model
from lbmpc.plants import PLANTS, Plant
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from run_log.reporting.summary import summarise
from tandem.cli import main
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.plants.integrator import INTEGRATOR
from tests.helpers.plants.pendulum import PENDULUM
from tests.helpers.plants.two_tanks import SETTINGS as TANKS_SETTINGS
from tests.helpers.plants.two_tanks import TWO_TANKS

Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def eighty_columns(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)


def check(capsys: Capture, *words: str) -> tuple[int, dict]:
    code = main(["model", "check", *words, "--json"])
    return code, json.loads(capsys.readouterr().out)


def text(capsys: Capture, *words: str) -> tuple[int, str]:
    code = main(["model", "check", *words])
    said = capsys.readouterr()
    # As one line: a table breaks its sentences.
    return code, " ".join((said.out + said.err).split())


def named(monkeypatch: pytest.MonkeyPatch, plant: Plant) -> str:
    monkeypatch.setitem(PLANTS, "mine", plant)
    return "mine"
