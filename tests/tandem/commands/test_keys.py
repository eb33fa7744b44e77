"""`tandem keys`: an authority, one certificate for each role, and the table of rights."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from node_runtime.config.strict import ConfigError
from node_runtime.tls import credentials
from protocol import rights, topics
from tandem.certificate_authority import found
from tandem.cli import main


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shared keys of jet1; tests must not change them."""
    folder = tmp_path_factory.mktemp("keys") / "jet1"
    assert (
        main(
            ["keys", "create", "--plant", "jet1", "--host", "10.0.0.5", "--host", "gw", "--out", str(folder)]
        )
        == 0
    )
    return folder


def test_each_role_has_a_certificate_that_only_its_owner_can_read(keys: Path):
    assert {path.name for path in keys.iterdir()} == {"authority", *rights.ROLES}
    for path in [keys, *keys.rglob("*")]:
        mode = stat.S_IMODE(path.stat().st_mode)
        assert mode == (0o700 if path.is_dir() else 0o600), f"{path}: {mode:o}"
    # The authority's key is only in its own folder.
    secret = (keys / "authority" / "key.pem").read_bytes()
    assert [path for path in keys.rglob("*.pem") if path.read_bytes() == secret] == [
        keys / "authority" / "key.pem"
    ]


def test_certificates_have_their_role_and_purpose(keys: Path):
    authority = credentials.load_certificate(keys / "authority" / "certificate.pem")
    constraints = authority.extensions.get_extension_for_class(x509.BasicConstraints)
    assert constraints.critical
    assert (constraints.value.ca, constraints.value.path_length) == (True, 0)
    for role in rights.ROLES:
        own = credentials.read(keys / role)
        assert own.name == f"{role}.jet1"
        assert 364 < own.days_left() < 366
        certificate = credentials.load_certificate(own.certificate)
        assert certificate.not_valid_after_utc < authority.not_valid_after_utc
        assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        usage = certificate.extensions.get_extension_for_class(x509.KeyUsage).value
        assert usage.digital_signature
        assert not usage.key_cert_sign
        uses = set(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        server = {ExtendedKeyUsageOID.SERVER_AUTH} if role == "router" else set()
        assert uses == {ExtendedKeyUsageOID.CLIENT_AUTH} | server
    router = next(one for one in found(keys) if one.role == "router")
    assert set(router.hosts) == {"localhost", "127.0.0.1", "router", "10.0.0.5", "gw"}


def test_nothing_is_overwritten(keys: Path, capsys: pytest.CaptureFixture[str]):
    before = {path: path.read_bytes() for path in keys.rglob("*.pem")}
    assert main(["keys", "create", "--plant", "jet1", "--out", str(keys)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in keys.rglob("*.pem")} == before


def test_renewing_one_role_leaves_the_others_and_keeps_the_hosts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "k"
    main(["keys", "create", "--plant", "jet2", "--host", "10.0.0.5", "--out", str(folder), "--days", "3"])
    before = {one.role: one.fingerprint for one in found(folder)}
    assert main(["keys", "renew", str(folder), "--role", "router", "--host", "gw"]) == 0
    after = {one.role: one for one in found(folder)}
    assert [role for role, one in after.items() if one.fingerprint != before[role]] == ["router"]
    assert set(after["router"].hosts) == {"localhost", "127.0.0.1", "router", "10.0.0.5", "gw"}
    credentials.of_process(str(folder / "router"), "router", "jet2")
    assert not list(folder.rglob("*.new"))
    # The authority may be in another folder.
    (folder / "authority").rename(tmp_path / "drawer")
    capsys.readouterr()
    assert main(["keys", "renew", str(folder), "--role", "trainer"]) == 2
    assert "--authority" in capsys.readouterr().err
    assert (
        main(["keys", "renew", str(folder), "--role", "trainer", "--authority", str(tmp_path / "drawer")])
        == 0
    )
    assert 364 < credentials.of_process(str(folder / "trainer"), "trainer", "jet2").days_left() < 366


def test_renew_adds_a_role_that_older_keys_do_not_have(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "k"
    main(["keys", "create", "--plant", "jet2", "--out", str(folder)])
    shutil.rmtree(folder / "viewer")
    assert main(["keys", "renew", str(folder), "--role", "viewer"]) == 0
    assert 364 < credentials.of_process(str(folder / "viewer"), "viewer", "jet2").days_left() < 366
    capsys.readouterr()
    elsewhere = tmp_path / "other"
    elsewhere.mkdir()
    authority = str(folder / "authority")
    assert main(["keys", "renew", str(elsewhere), "--role", "viewer", "--authority", authority]) == 2
    assert "contains a certificate.pem" in capsys.readouterr().err
    assert list(elsewhere.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["create", "--plant", "jet 1", "--out", "new"], "letters"),
        (["create", "--plant", "jet1", "--out", "new", "--host", "10.0.0.5:7448"], "omit port"),
        (["create", "--plant", "jet1", "--out", "new", "--days", "4000"], "--days 4000"),
        (["renew", "nowhere", "--role", "boss"], "one of router"),
        (["renew", "nowhere", "--role", "trainer"], "nowhere"),
        (["show", "nowhere"], "no such folder"),
    ],
)
def test_an_impossible_request_is_reported(
    arguments: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    assert main(["keys", *arguments]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_show_warns_before_the_end_and_ends_badly_after_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "k"
    main(["keys", "create", "--plant", "jet1", "--out", str(folder), "--days", "29"])
    capsys.readouterr()
    assert main(["keys", "show", str(folder), "--json"]) == 0
    said = capsys.readouterr()
    assert "renew --role trainer" in said.err
    shown = {one["role"]: one for one in json.loads(said.out)["certificates"]}
    assert shown["trainer"]["publishes"][0] == "tandem/jet1/trainer/hidden_weights"
    assert 28 < shown["trainer"]["days_left"] <= 29
    monkeypatch.setattr("tandem.certificate_authority.Issued.days_left", -1.0)
    assert main(["keys", "show", str(folder / "trainer")]) == 1


def test_show_prints_a_whole_fingerprint_prefix_whatever_it_spells(
    keys: Path, capsys: pytest.CaptureFixture[str]
):
    main(["keys", "show", str(keys)])
    assert (
        len(re.findall(r"(?:[0-9A-F]{2}:){7}[0-9A-F]{2}…", capsys.readouterr().out)) == len(rights.ROLES) + 1
    )


# -- faults of its own keys that a process reports before it connects --------------------------------------------


def _copy(keys: Path, role: str, to: Path) -> Path:
    to.mkdir()
    for path in (keys / role).iterdir():
        (to / path.name).write_bytes(path.read_bytes())
        (to / path.name).chmod(0o600)
    return to


def test_keys_that_do_not_fit_are_named(keys: Path, tmp_path: Path):
    mine = _copy(keys, "trainer", tmp_path / "mine")
    assert credentials.of_process(str(mine), "trainer", "jet1").name == "trainer.jet1"
    for role, plant in (("controller", "jet1"), ("trainer", "jet2")):
        with pytest.raises(
            ConfigError, match=rf"certificate of trainer\.jet1, but this process is {role}\.{plant}"
        ):
            credentials.of_process(str(mine), role, plant)
    with pytest.raises(ConfigError, match=r"bus\.tls\.keys is missing"):
        credentials.of_process(None, "trainer", "jet1")
    with pytest.raises(ConfigError, match="cannot be read: File name too long"):
        credentials.read(mine / ("x" * 300))
    (mine / "key.pem").chmod(0o640)
    with pytest.raises(ConfigError, match="others can read it"):
        credentials.read(mine)
    (mine / "key.pem").chmod(0o600)
    (mine / "key.pem").write_bytes((keys / "plant" / "key.pem").read_bytes())
    with pytest.raises(ConfigError, match=r"is not the key of certificate\.pem"):
        credentials.read(mine)
    os.truncate(mine / "key.pem", 20)
    with pytest.raises(ConfigError, match="not a private key"):
        credentials.read(mine)
    (mine / "authority.pem").unlink()
    with pytest.raises(ConfigError, match=r"authority\.pem: cannot be read"):
        credentials.read(mine)


# -- the table of rights -------------------------------------------------------------------------------------------


def test_every_topic_has_exactly_one_role_that_may_publish_it():
    for topic in topics.ALL:
        may = [role for role in rights.ROLES if topic in rights.rights_of(role).publishes]
        assert may == [topic.writer], topic.name


def test_only_a_controller_sends_commands_and_only_a_trainer_sends_weights():
    publishes = {role: set(rights.rights_of(role).publish_keys("jet1")) for role in rights.ROLES}
    assert [role for role in rights.ROLES if "tandem/jet1/controller/command" in publishes[role]] == [
        "controller"
    ]
    assert "tandem/jet1/@direct/controller/command" in publishes["controller"]
    assert publishes["trainer"] == {
        f"tandem/jet1/trainer/{name}" for name in ("hidden_weights", "run_info", "health")
    }
    assert publishes["viewer"] == set()
    assert publishes["commander"] == {f"tandem/jet1/operator/{name}" for name in ("reference", "override")}
    assert publishes["user"] == {"tandem/jet1/user/**"}
    assert rights.rights_of("user").read_keys("jet1") == []
    assert not any("/user/" in key for role in rights.ROLES if role != "user" for key in publishes[role])
    assert publishes["recorder"] == {"tandem/jet1/recorder/run_info", "tandem/jet1/recorder/health"}
    asked = [role for role in rights.ROLES if rights.rights_of(role).asks]
    answered = [role for role in rights.ROLES if rights.rights_of(role).answers]
    assert (asked, answered) == (["trainer"], ["controller"])
