"""Configuration: each error is one message with the key, its place and the allowed values."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path

import pytest
from msgspec import inspect

from lbmpc.plants import get_plant, get_truth
from node_runtime.config.loading import from_json, from_tree, load, override, to_json, to_toml, to_tree
from node_runtime.config.plant import plant_of, true_plant_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from tests.helpers.paths import CONFIGS

SHIPPED = CONFIGS / "compressor.toml"


def message(*overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(None, list(overrides))
    return str(caught.value)


def test_shipped_file_equals_the_defaults():
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
    # The file contains one of the two keys for the horizon as a comment.
    text = re.sub(r"(?m)^horizon = .*", "", text)
    shown = from_tree(tomllib.loads(text))
    assert shown.plant.x0 is not None
    assert shown.controller.W is not None
    plant = plant_of(shown, get_plant)
    assert shown.plant.x0 == plant.x0.tolist()
    assert (shown.plant.x_e, shown.plant.u_e) == (plant.x_e.tolist(), plant.u_e.tolist())
    assert shown.controller.horizon == Config().controller.horizon
    assert plant.W.tolist() == shown.controller.W
    assert tuple(shown.l2nw.variables or ()) == plant.kernel


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (
            "controller.oracle=dn",
            "controller.oracle = 'dn' is not one of constant, dnn, l2nw, linear, perfect; did you mean 'dnn'?",
        ),
        ("controller.oracle=7", "controller.oracle = 7 is not one of constant, dnn, l2nw, linear"),
        ("trainer.batch=0", "trainer.batch = 0 is not an integer of at least 1"),
        ("trainer.batch=1.5", "trainer.batch = 1.5 is not an integer of at least 1"),
        ("realtime.priority=100", "realtime.priority = 100 is not an integer of at least 0 and at most 99"),
        ("adaptation.gamma=1.0", "adaptation.gamma = 1.0 is not a number above 0 and below 1"),
        ("controller.Q=[1, -1, 1, 1]", "controller.Q[1] = -1 is not a number of at least 0"),
        ("network.hidden=[32, 0]", "network.hidden[1] = 0 is not an integer of at least 1 and at most 4096"),
        ("network.hidden=32", "network.hidden = 32 is not a list, each entry an integer of at least 1"),
        ("trainer.enabled=1", "trainer.enabled = 1 is not true or false"),
        ("rate=nan", "rate = nan is not a number above 0"),
        ("rate=inf", "rate = inf is not a number above 0 and at most 100000"),
        ("rate=1e-300", "rate = 1e-300: a period of 1e+300 s; at most 1e+06 s"),
        ("controller.solver.penalty=inf", "controller.solver.penalty is not a finite number"),
        (
            "controller.horizon=2000000000",
            "controller.horizon = 2000000000 is not an integer of at least 1 and at most 1000",
        ),
        ("l2nw.window=1000000", "l2nw.window = 1000000 is not an integer of at least 1 and at most 10000"),
        ("log.chunk_bytes=1000000000000", "is not an integer of at least 1 and at most 67108864"),
        ("realtime.cores=[0, 1000000000]", "realtime.cores[1]: Expected `int` <= 8191"),
        ("plant=3", "plant = 3 is a table: write [plant] and its keys below"),
        ("controler.oracle=dnn", "unknown key 'controler'; did you mean 'controller'?"),
        ("network.hiden=[3]", "unknown key 'network.hiden'; did you mean 'network.hidden'?"),
        (
            "bus.zzz=3",
            "unknown key 'bus.zzz'; known: endpoint, remote, insecure, tls, lease_ms, follow_silence",
        ),
        ("network.activation=relu", "network.activation = 'relu' is not bounded"),
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
def test_an_invalid_override_is_refused(given: str):
    with pytest.raises(ConfigError, match=f"^{re.escape(repr(given))}: "):
        override(Config(), [given])


def test_errors_name_the_file_or_the_override(tmp_path: Path):
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


def test_a_byte_order_mark_is_ignored(tmp_path: Path):
    path = tmp_path / "mine.toml"
    path.write_bytes(b"\xef\xbb\xbfrate = 50.0\n")
    assert load(path).rate == 50.0


def test_a_file_in_another_encoding_is_reported(tmp_path: Path):
    path = tmp_path / "mine.toml"
    path.write_bytes("rate = 50.0\n".encode("utf-16"))
    with pytest.raises(ConfigError, match=r"mine\.toml: .*save it as UTF-8"):
        load(path)


def test_a_missing_file(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: No such file"):
        load(tmp_path / "none.toml")


def test_toml_and_json_are_read_back_equal(tmp_path: Path):
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
        (
            "plant.truth.slop=1.4",
            "plant.truth: moore_greitzer has no parameter 'slop'; did you mean 'slope'?",
        ),
        (
            'reference.outputs=["q"]',
            "reference.outputs: moore_greitzer has no state 'q'; it has z, y, r, rdot",
        ),
        ('reference.outputs=["u"]', "reference.outputs: moore_greitzer has no state 'u'"),
        ('reference.outputs=["y", "y"]', "reference.outputs: 'y' is used twice"),
        ("reference.values=[1.0]", "reference.values has 1 entries; no reference.outputs"),
        (
            'reference={outputs=["y"], values=[1.7, 1]}',
            "reference.values has 2 entries; reference.outputs has 1",
        ),
        (
            'reference={outputs=["y"], values=[2.2]}',
            "reference.values: y = 2.2 is outside X, 1.1875 to 2.1875",
        ),
        ("plant.truth.mass=1.4", "no parameter 'mass'; it has beta, z_c, slope"),
        ("plant.truth.beta=0", "plant.truth: moore_greitzer with beta = 0: dx/dt is not finite"),
    ],
)
def test_unknown_names_of_the_plant_are_refused(given: str, expected: str):
    with pytest.raises(ConfigError, match=re.escape(expected)):
        plant_of(override(Config(), [given]), get_plant)


def test_a_wrong_model_has_a_separate_true_plant():
    config = override(Config(), ["plant.truth.slope=1.4"])
    model, truth = plant_of(config, get_plant), true_plant_of(config, get_plant, get_truth)
    assert model is get_plant("moore_greitzer")
    assert truth.parameters == {**model.parameters, "slope": 1.4}
    assert (truth.x_e == model.x_e).all()
    assert true_plant_of(Config(), get_plant, get_truth) is model


def test_a_tilde_is_replaced_by_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    keys = ("log.path", "controller.checkpoint", "controller.sets", "bus.tls.keys")
    file = tmp_path / "config.toml"
    file.write_text("\n".join(f'{key} = "~/below/{key}"' for key in keys))
    for found in (load(file), load(None, [f"{key}=~/below/{key}" for key in keys])):
        paths = (found.log.path, found.controller.checkpoint, found.controller.sets, found.bus.tls.keys)
        assert paths == tuple(f"{tmp_path}/below/{key}" for key in keys)
    place = '{name = "jet2", endpoint = "tls/jet2:7448", keys = "~/keys"}'
    assert load(None, [f"trainer.fleet=[{place}]"]).trainer.fleet[0].keys == f"{tmp_path}/keys"


def test_a_tilde_in_a_name_or_a_log_is_kept():
    assert load(None, ["log.path=~backup.mcap"]).log.path == "~backup.mcap"
    assert load(None, ["log.path=a/~/b.mcap"]).log.path == "a/~/b.mcap"
    # The configuration in a log belongs to another machine, so this machine's folders are not inserted.
    assert from_json('{"log": {"path": "~no-such-user/x.mcap"}}').log.path == "~no-such-user/x.mcap"


def test_the_home_of_an_unknown_user_is_refused():
    said = message("bus.tls.keys=~no-such-user/keys")
    assert "no home folder of ~no-such-user is known" in said
    assert said.startswith("--set bus.tls.keys")


def test_text_must_be_utf_8_except_the_path_of_the_log():
    odd = os.fsdecode(b"caf\xe9")
    for key in ("controller.sets", "bus.tls.keys", "controller.checkpoint"):
        assert f"{key} = 'caf\\udce9' is not UTF-8" in message(f"{key}={odd}")
    assert "not UTF-8" in message(f'l2nw.variables=["z", "{odd}"]')
    config = load(None, [f"log.path={odd}.mcap"])
    assert os.fsencode(config.log.path) == b"caf\xe9.mcap"
    for text in (to_json(config), to_toml(config)):
        assert "udce9.mcap" in text.encode().decode()


def test_every_number_in_the_configuration_has_an_upper_limit_or_a_reason() -> None:
    """Numbers without a limit are those that only scale or are compared, and determine neither memory nor time."""
    harmless = {
        "tolerance",
        "penalty",
        "W",
        "Q",
        "R",
        "S",
        "input_rate_max",
        "x0",
        "x_e",
        "u_e",
        "bounds",
        "rows",
        "values",
        "truth",
        "options",
        "output_scale",
        "max_layer_norm",
        "ridge",
        "margin",
        "floor",
        "floor_after",
        "column_bound",
        "initial_scale",
        "bandwidth",
        "regularisation",
        "learning_rate",
    }
    unlimited: set[str] = set()

    def look(kind: inspect.Type, name: str) -> None:
        match kind:
            case inspect.StructType(fields=fields):
                for field in fields:
                    look(field.type, field.name)
            case inspect.UnionType(types=types):
                for one in types:
                    look(one, name)
            case inspect.ListType(item_type=item) | inspect.DictType(value_type=item):
                look(item, name)
            case inspect.IntType() | inspect.FloatType() if kind.le is None and kind.lt is None:
                unlimited.add(name)

    look(inspect.type_info(Config), "")
    assert unlimited <= harmless


def test_the_limits_apply_to_a_log() -> None:
    with pytest.raises(
        ConfigError, match=r"the log's configuration: controller\.horizon = 2000000000 is not"
    ):
        from_json('{"controller": {"horizon": 2000000000}}')


def test_the_horizon_in_seconds_is_converted_to_steps() -> None:
    for rate, seconds, steps in ((20.0, 3.0, 60), (100.0, 1.0, 100), (30.0, 0.05, 2), (1.0, 0.1, 1)):
        config = load(None, [f"rate={rate}", f"controller.horizon_seconds={seconds}"])
        assert config.controller.horizon == steps
        assert config.controller.horizon_seconds is None
        assert tomllib.loads(to_toml(config))["controller"]["horizon"] == steps
        assert from_json(to_json(config)) == config


def test_the_horizon_may_be_given_once(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[controller]\nhorizon = 20\nhorizon_seconds = 2.0\n")
    with pytest.raises(
        ConfigError, match=r"c\.toml: controller\.horizon and .*horizon_seconds are both given"
    ):
        load(file)
    both = ["controller.horizon=20", "controller.horizon_seconds=2"]
    with pytest.raises(ConfigError, match=r"--set controller\.horizon_seconds=2: .* both given"):
        load(None, both)
    # An override changes either of the two keys of the file.
    for text in ("horizon = 20", "horizon_seconds = 2.0"):
        file.write_text(f"[controller]\n{text}\n")
        assert [load(file, [one]).controller.horizon for one in both] == [20, 40]
    settled = load(file)
    assert override(settled, [both[1], "rate=50"]).controller.horizon == 100
    with pytest.raises(
        ConfigError, match=r"horizon_seconds = 2 is 2000 steps at rate = 1000 Hz; at most 1000"
    ):
        override(settled, [both[1], "rate=1000"])


def test_a_delay_of_more_than_half_a_period_is_refused():
    assert override(Config(), ["controller.input_delay_ms=25"]).controller.input_delay_ms == 25
    with pytest.raises(
        ConfigError, match=r"input_delay_ms = 5 is more than half a period, 0\.5 ms at rate = 1000 Hz"
    ):
        override(Config(), ["controller.input_delay_ms=5", "rate=1000"])


def test_shipped_configurations_are_found_by_name_after_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for file in sorted(CONFIGS.glob("*.toml")):
        assert load(file.stem) == load(file)
    assert load("published").rate == 100.0
    (tmp_path / "published").mkdir()
    assert load("published").rate == 100.0
    (tmp_path / "compressor").write_text("rate = 33.0")
    assert load("compressor").rate == 33.0
    with pytest.raises(
        ConfigError, match=r"compresor: no such file, and no shipped .* did you mean 'compressor'"
    ):
        load("compresor")
    with pytest.raises(ConfigError, match=r"published\.toml: cannot be read"):
        load("published.toml")


@pytest.mark.parametrize("name", ["compressor-cheap", "published"])
def test_a_derived_configuration_contains_only_changes(name: str) -> None:
    """Every key differs from the default. A repeated default would become outdated there."""

    def leaves(tree: dict, path: str = "") -> dict[str, object]:
        found: dict[str, object] = {}
        for key, value in tree.items():
            found |= leaves(value, f"{path}{key}.") if isinstance(value, dict) else {path + key: value}
        return found

    given = tomllib.loads((CONFIGS / f"{name}.toml").read_text())
    default = leaves(to_tree(Config()))
    assert [key for key, value in leaves(given).items() if default[key] == value] == []
    plant_of(load(name), get_plant)
