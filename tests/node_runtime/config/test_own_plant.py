"""What a configuration says of a plant of one's own: references written out, bounds, and the way there and back."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from node_runtime.config.loading import from_json, from_tree, load, override, to_json, to_toml
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Another folder than the configuration's."""
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


def test_a_reference_given_by_hand_is_relative_to_the_current_folder(tmp_path: Path, elsewhere: Path):
    file = tmp_path / "tanks.toml"
    file.write_text('plant.model = "tanks.py:TANKS"\n')
    assert load(file, ["plant.model=a.py:A"]).plant.model == f"{elsewhere}/a.py:A"
    assert load(file, ["plant.truth=a.py:A"]).plant.model == f"{tmp_path}/tanks.py:TANKS"
    assert load(None, ["plant.model=a.py:A"]).plant.model == f"{elsewhere}/a.py:A"


def test_names_and_packages_stay_as_they_are(elsewhere: Path):
    assert load(None, ["plant.model=moore_greitzer"]).plant.model == "moore_greitzer"
    assert load(None, ["plant.model=mypackage.module:PLANT"]).plant.model == "mypackage.module:PLANT"


def test_what_a_log_names_is_not_written_out(elsewhere: Path):
    logged = from_json('{"plant": {"model": "evil.py:PLANT", "truth": "evil.py:TRUE"}}')
    assert (logged.plant.model, logged.plant.truth) == ("evil.py:PLANT", "evil.py:TRUE")
    changed = override(logged, ["rate=10"])
    assert (changed.plant.model, changed.plant.truth) == ("evil.py:PLANT", "evil.py:TRUE")


def test_bounds_there_and_back(tmp_path: Path):
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
            "plant.model=~nobody-at-all/a.py:A",
            "--set plant.model=~nobody-at-all/a.py:A: plant.model = ~nobody-at-all/",
        ),
    ],
)
def test_mistakes(given: str, text: str):
    with pytest.raises(ConfigError, match=re.escape(text)):
        override(Config(), [given])
