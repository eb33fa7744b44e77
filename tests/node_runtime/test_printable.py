"""Foreign text on a terminal."""

from __future__ import annotations

import logging

import pytest

from node_runtime.printable import printable
from node_runtime.rejected import RejectedMessages

NASTY = "run\x1b[2J\x9b31m\x07\rover\u202egnp\ufeff"


def test_control_characters_are_shown_as_numbers() -> None:
    assert printable(NASTY) == r"run\u001b[2J\u009b31m\u0007\u000dover\u202egnp\ufeff"


def test_words_lines_and_tabs_are_unchanged() -> None:
    assert printable("Prüfstand 3\n\tĥ − h, 試験 ✓") == "Prüfstand 3\n\tĥ − h, 試験 ✓"


def test_bytes_that_are_not_utf8_are_shown() -> None:
    assert printable(b"caf\xe9".decode(errors="surrogateescape")) == r"caf\udce9"


def test_the_log_line_of_a_rejected_message_has_no_escapes(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        RejectedMessages().count("plant/state", "foreign", NASTY)
    assert "\x1b" not in caplog.text
    assert r"run\u001b[2J" in caplog.text
