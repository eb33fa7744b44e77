"""Configuration: what is wrong is said in one message with key, place and what would be right."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest

from node_runtime.config.sections import (
    Config,
    from_json,
    from_tree,
    load,
    override,
    to_json,
    to_toml,
    to_tree,
)
from node_runtime.config.strict import ConfigError
from tandem.checks import plant_of
from tests.helpers.paths import CONFIGS

SHIPPED = CONFIGS / "compressor.toml"


def message(*overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(None, list(overrides))
    return str(caught.value)


def test_shipped_file_is_the_defaults():
    assert load(SHIPPED) == Config()


def test_shipped_file_names_every_key():
    text = SHIPPED.read_text()

    def names(tree: dict) -> set[str]:
        below = [names(value) for value in tree.values() if isinstance(value, dict)]
        return set(tree).union(*below)

    missing = [
        name for name in names(to_tree(Config())) if not re.search(rf"(?m)^(# |\[|.*\.)?{name}\b", text)
    ]
    assert not missing


def test_commented_values_of_the_shipped_file_are_valid():
    text = re.sub(r"(?m)^# (\w+ = )", r"\1", SHIPPED.read_text())
    shown = from_tree(tomllib.loads(text))
    assert shown.plant.x0 is not None
    assert shown.controller.W is not None
    plant = plant_of(shown)
    assert shown.plant.x0 == plant.x0.tolist()
    assert pytest.approx(plant.W * shown.period) == shown.controller.W
    assert tuple(shown.l2nw.variables or ()) == plant.kernel


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (
            "controller.oracle=dn",
            "controller.oracle = 'dn' is not one of dnn, l2nw, linear, perfect; did you mean 'dnn'?",
        ),
        ("controller.oracle=7", "controller.oracle = 7 is not one of dnn, l2nw, linear"),
        ("trainer.batch=0", "trainer.batch = 0 is not an integer of at least 1"),
        ("trainer.batch=1.5", "trainer.batch = 1.5 is not an integer of at least 1"),
        ("realtime.priority=100", "realtime.priority = 100 is not an integer of at least 0 and at most 99"),
        ("adaptation.gamma=1.0", "adaptation.gamma = 1.0 is not a number above 0 and below 1"),
        ("controller.Q=[1, -1, 1, 1]", "controller.Q[1] = -1 is not a number of at least 0"),
        ("network.hidden=[32, 0]", "network.hidden[1] = 0 is not an integer of at least 1 and at most 4096"),
        ("network.hidden=32", "network.hidden = 32 is not a list, each entry an integer of at least 1"),
        ("trainer.enabled=1", "trainer.enabled = 1 is not true or false"),
        ("rate=nan", "rate = nan is not a number above 0"),
        ("rate=inf", "rate is not a finite number"),
        ("plant=3", "plant = 3 is a table: write [plant] and its keys below"),
        ("controler.oracle=dnn", "unknown key 'controler'; did you mean 'controller'?"),
        ("network.hiden=[3]", "unknown key 'network.hiden'; did you mean 'network.hidden'?"),
        (
            "bus.zzz=3",
            "unknown key 'bus.zzz'; known: endpoint, remote, insecure, tls, lease_ms, follow_silence",
        ),
        ("network.activation=relu", "network.activation = 'relu' is unbounded"),
        ("trainer.min_samples=5000", "trainer.min_samples = 5000 exceeds trainer.capacity = 2000"),
        ("name=a/b", "name = 'a/b' is not a string matching"),
        (f"seed={2**63}", "is not an integer of at least 0 and at most"),
    ],
)
def test_wrong_value_names_key_value_and_what_is_allowed(given: str, expected: str):
    said = message(given)
    assert expected in said
    assert said.startswith(f"--set {given}: ")


@pytest.mark.parametrize("given", ["rate", "=3", "rate.x=3"])
def test_override_that_is_none(given: str):
    with pytest.raises(ConfigError, match=f"^{re.escape(repr(given))}: "):
        override(Config(), [given])


def test_a_file_is_named_and_so_is_the_override_that_spoils_it(tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text("[trainer]\nbatch = 0\n")
    with pytest.raises(ConfigError, match=rf"^{re.escape(str(file))}: trainer\.batch = 0"):
        load(file)
    with pytest.raises(ConfigError, match=r"^--set trainer\.steps=-1: trainer\.steps = -1"):
        load(file, ["trainer.batch=3", "trainer.steps=-1"])
    assert load(file, ["trainer.batch=3"]).trainer.batch == 3


@pytest.mark.parametrize("content", [b"rate = ", b"\xff\xfe", b"rate = 20\nrate = 20"])
def test_a_file_that_is_not_toml(tmp_path: Path, content: bytes):
    file = tmp_path / "mine.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=r"mine\.toml: not valid TOML"):
        load(file)


def test_a_file_that_is_not_there(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: No such file"):
        load(tmp_path / "none.toml")


def test_toml_and_json_give_the_same_configuration_back(tmp_path: Path):
    changed = override(
        Config(), ["plant.x0=[0.2, 1.3, 1.1, 0.0]", "controller.solver.tolerance=1e-9", "network.hidden=[8]"]
    )
    file = tmp_path / "written.toml"
    file.write_text(to_toml(changed))
    assert load(file) == changed
    assert from_json(to_json(changed)) == changed
    assert changed != Config()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("plant.model=moore_greizer", "did you mean 'moore_greitzer'?"),
        ("plant.x0=[1.0, 2.0]", "plant.x0 has 2 entries; moore_greitzer has 4 states (z, y, r, rdot)"),
        ("controller.W=[0.1]", "controller.W has 1 entries"),
        ("controller.R=[1.0, 1.0]", "controller.R has 2 entries; moore_greitzer has 1 inputs (u)"),
        ('l2nw.variables=["z", "q"]', "l2nw.variables: 'q' is not one of moore_greitzer's z, y, r, rdot, u"),
        ("l2nw.variables=[]", "l2nw.variables is empty"),
    ],
)
def test_what_the_plant_does_not_have(given: str, expected: str):
    with pytest.raises(ConfigError, match=re.escape(expected)):
        plant_of(override(Config(), [given]))


def test_a_log_from_before_a_key_says_what_was_in_force_then():
    tree = to_tree(Config())
    del tree["controller"]["guard"], tree["controller"]["input_delay_ms"]
    old = from_json(json.dumps(tree))
    assert old.controller.guard == "steps"
    assert old.controller.input_delay_ms is None
    assert Config().controller.guard == "half"
    assert from_json(to_json(Config())) == Config()


def test_a_delay_of_more_than_half_a_period_is_refused():
    assert override(Config(), ["controller.input_delay_ms=25"]).controller.input_delay_ms == 25
    with pytest.raises(
        ConfigError, match=r"input_delay_ms = 5 is more than half a period, 0\.5 ms at rate = 1000 Hz"
    ):
        override(Config(), ["controller.input_delay_ms=5", "rate=1000"])
