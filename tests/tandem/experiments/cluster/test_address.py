"""The addresses of a scheduler that are accepted."""

from __future__ import annotations

import pytest

from node_runtime.config.strict import ConfigError
from tandem.experiments.cluster.address import checked


@pytest.mark.parametrize(
    ("address", "full"),
    [
        ("tcp://127.0.0.1:8786", "tcp://127.0.0.1:8786"),
        ("127.0.0.1:8786", "tcp://127.0.0.1:8786"),
        ("tcp://localhost:8786", "tcp://localhost:8786"),
        ("tcp://[::1]:8786", "tcp://[::1]:8786"),
        ("tls://198.51.100.7:8786", "tls://198.51.100.7:8786"),
        ("tls://head:8786", "tls://head:8786"),
    ],
)
def test_loopback_needs_no_certificates_and_tls_may_go_anywhere(address: str, full: str) -> None:
    assert checked(address) == full


@pytest.mark.parametrize("address", ["tcp://198.51.100.7:8786", "0.0.0.0:8786", "tcp://[2001:db8::1]:8786"])
def test_an_address_beyond_this_machine_without_tls_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match=r"leaves this machine without TLS.*write tls://"):
        checked(address)


@pytest.mark.parametrize(
    "address",
    ["", "head", "tcp://head", "http://127.0.0.1:8786", "tcp://127.0.0.1:8786/x", "::", "tcp://[::1"],
)
def test_an_invalid_address_is_refused_with_an_example(address: str) -> None:
    with pytest.raises(ConfigError, match=r"not the address of a Dask scheduler; for example tcp://127"):
        checked(address)


def test_a_host_that_is_not_known_is_named() -> None:
    with pytest.raises(ConfigError, match=r"no-such-host\.invalid is not known here"):
        checked("tcp://no-such-host.invalid:8786")
