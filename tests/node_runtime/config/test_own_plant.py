"""Configuration of a user's plant: absolute references, bounds, and writing and reading back."""

from __future__ import annotations

import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from lbmpc.plants import Known, PlantDefinitionError, get_plant
from node_runtime.config.loading import from_json, from_tree, load, override, to_json, to_toml
from node_runtime.config.plant import plant_of, spelt_out
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change into another folder than the configuration's."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def test_a_reference_in_a_file_is_relative_to_the_file(tmp_path: Path, elsewhere: Path):
    file = tmp_path / "tanks.toml"
    file.write_text('plant.model = "tanks.py:TANKS"\nplant.truth = "../true.py:TRUE"\n')
    for read in (load(file), load(Path("..") / "tanks.toml", ["rate=10"])):
        assert read.plant.model == f"{tmp_path}/tanks.py:TANKS"
        assert read.plant.truth == f"{tmp_path.parent}/true.py:TRUE"


def test_an_overriding_reference_is_relative_to_the_current_folder(tmp_path: Path, elsewhere: Path):
    file = tmp_path / "tanks.toml"
    file.write_text('plant.model = "tanks.py:TANKS"\n')
    assert load(file, ["plant.model=a.py:A"]).plant.model == f"{elsewhere}/a.py:A"
    assert load(file, ["plant.truth=a.py:A"]).plant.model == f"{tmp_path}/tanks.py:TANKS"
    assert load(None, ["plant.model=a.py:A"]).plant.model == f"{elsewhere}/a.py:A"


def test_names_and_packages_are_unchanged(elsewhere: Path):
    assert load(None, ["plant.model=moore_greitzer"]).plant.model == "moore_greitzer"
    assert load(None, ["plant.model=mypackage.module:PLANT"]).plant.model == "mypackage.module:PLANT"


def test_references_in_a_log_stay_unchanged(elsewhere: Path):
    logged = from_json('{"plant": {"model": "evil.py:PLANT", "truth": "evil.py:TRUE"}}')
    assert (logged.plant.model, logged.plant.truth) == ("evil.py:PLANT", "evil.py:TRUE")
    changed = override(logged, ["rate=10"])
    assert (changed.plant.model, changed.plant.truth) == ("evil.py:PLANT", "evil.py:TRUE")


def test_bounds_are_written_and_read_back(tmp_path: Path):
    config = load(
        None, ["plant.bounds.z=[0, 1]", "plant.bounds.y=[-inf, 2.0]", "plant.bounds={u=[0.5, inf]}"]
    )
    assert config.plant.bounds == {"u": [0.5, None]}
    config = override(
        config, ["plant.bounds.y=[-inf, 2.0]", "plant.x_e=[0.5, 1.7, 1.1, 0.0]", "plant.u_e=[1.1]"]
    )
    assert config.plant.bounds == {"u": [0.5, None], "y": [None, 2.0]}
    file = tmp_path / "written.toml"
    file.write_text(to_toml(config))
    assert load(file) == config
    assert from_json(to_json(config)) == config
    assert from_tree({"plant": {"bounds": {"u": (0.5, math.inf)}}}).plant.bounds == {"u": [0.5, None]}


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("plant.bounds.z=[inf, 1]", "plant.bounds.z.0 is not a finite number"),
        ("plant.bounds.z=[0, nan]", "plant.bounds.z.1 is not a finite number"),
        (
            "plant.bounds.z=[0]",
            'plant.bounds = {"z":[0]} is not a table, each entry a list of 2, each entry a number',
        ),
        ("plant.truth=1", "plant.truth = 1 is not a table, each entry a number or a string"),
        (
            "plant.truth.slope='a'",
            'plant.truth = {"slope":"a"} is not a table, each entry a number or a string',
        ),
        (
            "plant.model=~no-such-user/a.py:A",
            "--set plant.model=~no-such-user/a.py:A: plant.model = ~no-such-user/",
        ),
    ],
)
def test_mistakes(given: str, text: str):
    with pytest.raises(ConfigError, match=re.escape(text)):
        override(Config(), [given])


def test_input_rates_are_written_and_read_back(tmp_path: Path):
    config = load(None, ["plant.input_rate_max={u=5.0}", "controller.S=[0.5]"])
    found = plant_of(config, get_plant)
    assert found.input_rates.tolist() == [5.0]
    file = tmp_path / "rates.toml"
    file.write_text(to_toml(config))
    assert load(file) == config
    # In a log: the known plant, and a configuration with all of its properties.
    known = found.known()
    assert Known.from_builtins(msgspec.json.decode(msgspec.json.encode(known.to_builtins()))).u_rate_max == [
        5.0
    ]
    assert spelt_out(load(None), found).plant.input_rate_max == {"u": 5.0}
    assert "u_rate_max" not in get_plant("moore_greitzer").known().to_builtins()
    # Some of the inputs may have a rate limit.
    two = Known.from_matrices(
        np.zeros((1, 1)) - 1.0, np.ones((1, 2)), W=[0.0], scale={"x1": 1.0, "u1": 1.0, "u2": 1.0}
    )
    assert two.changed({}, input_rate_max={"u2": 3.0}).input_rates.tolist() == [np.inf, 3.0]


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("plant.input_rate_max.v=5.0", "has no input 'v'"),
        ("plant.input_rate_max.u=0.0", "plant.input_rate_max"),
        ("controller.S=[1.0, 1.0]", "controller.S has 2 entries"),
        ("controller.S=[-1.0]", "controller.S"),
    ],
)
def test_an_invalid_rate_is_refused(setting: str, said: str):
    with pytest.raises(ConfigError, match=said):
        plant_of(load(None, [setting]), get_plant)


def test_a_plant_with_an_invalid_rate_is_refused():
    for rates in ([1.0, 2.0], [0.0], [float("nan")], "fast"):
        with pytest.raises(PlantDefinitionError, match="u_rate_max"):
            Known.from_matrices([[-1.0]], [[1.0]], W=[0.0], u_rate_max=rates, scale={"x1": 1.0, "u1": 1.0})


SURGE = "plant.rows.surge={z=1.0,y=-0.5,max=0.3,priority=1}"


def test_rows_are_written_and_read_back(tmp_path: Path):
    config = load(None, [SURGE])
    found = plant_of(config, get_plant)
    row = {"z": 1.0, "y": -0.5, "max": 0.3, "priority": 1}
    assert found.rows == {"surge": row}
    file = tmp_path / "rows.toml"
    file.write_text(to_toml(config))
    assert load(file) == config
    known = found.known()
    again = Known.from_builtins(msgspec.json.decode(msgspec.json.encode(known.to_builtins())))
    assert again.rows == {"surge": row}
    assert again.to_builtins() == known.to_builtins()
    assert spelt_out(load(None), found).plant.rows == {"surge": row}
    assert "rows" not in get_plant("moore_greitzer").known().to_builtins()
    # Other rows stay, and a row of the same name is replaced.
    more = found.changed({}, rows={"slow": {"r": 1.0, "max": 1.5}, "surge": {"z": 1.0, "max": 0.5}})
    assert [more.state_rows.names, more.state_rows.upper.tolist()] == [("surge", "slow"), [0.5, 1.5]]


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("{zz=1.0,max=0.3}", "row few has 'zz', which is no state or input"),
        ("{z=0.0,max=0.3}", "no coefficient but 0"),
        ("{max=0.3}", "no coefficient but 0"),
        ("{z=1.0,u=1.0,max=3.0}", "states and inputs"),
        ("{z=1.0}", "no bound"),
        ("{z=1.0,min=0.5,max=0.3}", "min must be below max"),
        ("{z=1.0,max=0.3,priority=0.5}", "whole number"),
        ("{u=1.0,max=2.0,priority=1}", "inputs never leave U"),
        ("{z=1.0,y=-1.0,max=-3.0}", "at x_e"),
        ("{u=1.0,max=1.0}", "at u_e"),
        ("{z=1.0,max=inf}", "plant.rows.few.max is not a finite number"),
    ],
)
def test_an_invalid_row_is_refused(row: str, said: str):
    with pytest.raises(ConfigError, match=re.escape(said)):
        plant_of(load(None, [f"plant.rows.few={row}"]), get_plant)


def test_a_plant_with_invalid_rows_is_refused():
    for rows in (3, {"x1": {"x1": 1.0, "max": 1.0}}, {"r": [1.0]}, {"r": {"x1": "a", "max": 1.0}}):
        with pytest.raises(PlantDefinitionError, match="row"):
            Known.from_matrices([[-1.0]], [[1.0]], W=[0.0], rows=rows, scale={"x1": 1.0, "u1": 1.0})
    with pytest.raises(PlantDefinitionError, match="a keyword of rows"):
        Known.from_matrices(
            [[-1.0]],
            [[1.0]],
            W=[0.0],
            states=["max"],
            rows={"r": {"u1": 1.0, "max": 1.0}},
            scale={"max": 1.0},
        )
