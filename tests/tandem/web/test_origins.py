"""The web pages that may read the socket."""

from __future__ import annotations

import pytest

from tandem.web.origins import is_own_name, may_connect


@pytest.mark.parametrize(
    "origin",
    [
        None,
        "http://localhost:8765",
        "http://127.0.0.1:9000",
        "http://[::1]:8765",
        "https://localhost",
        "file://",
        "https://app.foxglove.dev",
    ],
)
def test_programs_pages_of_this_machine_and_known_viewers_may_connect(origin: str | None):
    assert may_connect(origin)


@pytest.mark.parametrize(
    "origin",
    [
        "",
        "null",
        "https://example.com",
        "http://localhost.example.com",
        "http://example.com:8765",
        "https://app.foxglove.dev.example.com",
        "http://app.foxglove.dev",
        "http://127.0.0.1.example.com:8765",
        "http://localhost@example.com",
        "ftp://localhost",
        "http://[::1",
        "file://example.com",
        "localhost",
    ],
)
def test_all_other_pages_may_not(origin: str):
    assert not may_connect(origin)


@pytest.mark.parametrize(
    "host", ["localhost:8765", "127.0.0.1:8765", "[::1]:8765", "localhost", "LOCALHOST:1"]
)
def test_the_server_knows_its_own_names(host: str):
    assert is_own_name(host)


@pytest.mark.parametrize(
    "host", [None, "", "example.com:8765", "localhost.example.com", "[::1", "a@example.com"]
)
def test_a_name_that_was_made_to_lead_here_is_not_its_own(host: str | None):
    assert not is_own_name(host)
