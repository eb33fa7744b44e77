"""Rights, plain endpoints and the router's messages about denials, without a router."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest

from node_runtime.bus.session import session_config
from node_runtime.config.strict import ConfigError
from node_runtime.rejected import RejectedMessages
from node_runtime.router import open_router, open_to_all
from node_runtime.tls import access_control
from node_runtime.tls.zenoh_log import MAX_NAMES, Refusals
from tests.helpers.live import live_config


def test_an_address_with_a_zone_is_refused_with_certificates() -> None:
    with pytest.raises(ConfigError, match="a certificate cannot contain an address with a zone"):
        session_config("client", "tls/[fe80::1%2]:7448", 1000)
    session_config("client", "tcp/[fe80::1%2]:7447", 1000)


def test_every_key_of_a_role_belongs_to_its_plant():
    control = access_control.access_control("jet1")
    of_plain, *of_roles = control["rules"]
    assert control["default_permission"] == "deny"
    assert of_plain["id"] == "plain"
    for rule in of_roles:
        assert all(key.startswith("tandem/jet1/") for key in rule["key_exprs"]), rule
        assert "delete" not in rule["messages"]
    assert {"id": "plain", "link_protocols": ["tcp"]} in control["subjects"]
    for subject in control["subjects"][1:]:
        assert subject["link_protocols"] == ["tls", "quic"]
        assert subject["cert_common_names"] == [f"{subject['id']}.jet1"]
    json.dumps(access_control.size_limits("jet1"))


def test_other_machines_need_certificates():
    for assignment, says in (
        ('bus.remote="tcp/0.0.0.0:7448"', "need certificates"),
        ('bus.remote="tls/0.0.0.0:7448"', r"bus\.tls\.keys is missing"),
    ):
        with ExitStack() as stack, pytest.raises(ConfigError, match=says):
            stack.enter_context(open_router(live_config(assignment)))


@pytest.mark.parametrize(
    ("endpoint", "is_open"),
    [
        ("tcp/127.0.0.1:7447", False),
        ("tcp/localhost:7447", False),
        ("tcp/[::1]:7447", False),
        ("tcp/0.0.0.0:7447", True),
        ("tcp/[::]:7447", True),
        ("tcp/10.0.0.5:7447", True),
        ("tcp/router:7447", True),
        ("tls/0.0.0.0:7447", False),
    ],
)
def test_which_plain_endpoints_other_machines_can_reach(endpoint: str, is_open: bool):
    assert open_to_all(endpoint) is is_open


def test_zenohs_internal_checks_are_not_denials():
    bad = RejectedMessages()
    refusals = Refusals(bad)
    head = "2026-11-23T01:14:25.0Z TRACE rx-0 ThreadId(08) zenoh::net::routing::interceptor::access_control: "
    who = "a6 on Interface(lo)+CertCommonName(trainer.jet1)+Transport(Tls)+a6 is unauthorized to "
    for text in (
        "ACL (ingress): caching permissions for `tandem/jet1/controller/samples` ...",
        who + "Put (ingress) on tandem/jet1/controller/samples",
        who + "Declare Liveliness Subscriber (ingress) on tandem/jet1/controller/samples",
        "Using cached result: a6 is authorized to Declare Subscriber (ingress) on tandem/jet1/controller/samples",
    ):
        assert refusals.read(head + text)
    assert bad.total == 0
    assert refusals.read(
        head + "Using cached result: a6 is unauthorized to Put (ingress) on tandem/jet1/controller/tick"
    )
    assert refusals.read(head + who + "Put (ingress) on tandem/jet1/" + "x" * 500)
    assert bad.counters() == {
        "bad_from_trainer_jet1_denied_put_controller_tick": 1,
        "bad_from_trainer_jet1_denied_put_elsewhere": 1,
    }
    assert not refusals.read("a line of another program")


def test_a_denied_sender_is_named_after_many_sessions():
    """Health checks alone open a session every few seconds."""
    bad = RejectedMessages()
    refusals = Refusals(bad)
    head = "2026-11-23T01:14:25.0Z TRACE rx-0 ThreadId(08) zenoh::net::routing::interceptor::access_control: "
    who = "+CertCommonName({})+Transport(Tls)+a6 is {}authorized to "
    for k in range(MAX_NAMES + 500):
        refusals.read(
            head
            + f"{k:x} on Interface(lo)"
            + who.format("viewer.jet1", "")
            + "Put (ingress) on tandem/jet1/x"
        )
    last = head + "abcdef on Interface(lo)" + who.format("trainer.jet1", "un")
    refusals.read(last + "Put (ingress) on tandem/jet1/controller/command")
    assert bad.counters() == {"bad_from_trainer_jet1_denied_put_controller_command": 1}
    assert len(refusals._names) == MAX_NAMES
