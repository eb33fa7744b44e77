"""What the tests with Docker ask of the machine, without Docker."""

from __future__ import annotations

import json

import pytest

from tests.compose.project import bridge_address

V6 = {"family": "inet6", "local": "fe80::42:acff:fe11:1", "prefixlen": 64, "scope": "link"}
V4 = {"family": "inet", "local": "172.17.0.1", "prefixlen": 16, "scope": "global", "label": "docker0"}


def shown(*addresses: dict) -> str:
    return json.dumps([{"ifname": "docker0", "operstate": "DOWN", "addr_info": list(addresses)}])


@pytest.mark.parametrize("addresses", [(V4,), (V6, V4)])
def test_the_bridge_s_ipv4_address_is_found(addresses: tuple[dict, ...]) -> None:
    assert bridge_address(shown(*addresses)) == "172.17.0.1"


@pytest.mark.parametrize("text", [shown(V6), "[{}]", "[]"])
def test_a_bridge_without_an_address_is_reported(text: str) -> None:
    with pytest.raises(AssertionError, match="no IPv4 address on this machine"):
        bridge_address(text)
