"""The wrapping of raw bytes is exact, valid protobuf, and strict when it is decoded."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from run_log.raw_message import NotRaw, schema, unwrap, wrap


@given(st.binary(max_size=400) | st.sampled_from([0, 127, 128, 16383, 16384, 3_000_000]).map(bytes))
def test_every_payload_comes_back(payload: bytes) -> None:
    assert unwrap(wrap(payload)) == payload


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x0a",
        b"\x0a\x05abc",
        b"\x0a\x03abcd",
        b"\x12\x03abc",
        b"\x0a" + b"\xff" * 8,
        wrap(b"abc") + b"\x0a\x00",
    ],
)
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(NotRaw):
        unwrap(data)


def test_the_schema_is_what_the_protobuf_compiler_makes() -> None:
    """google.protobuf parsed it and serialised it to the same bytes; protobufjs reads it too."""
    assert schema().hex() == (
        "0a4b0a1474616e64656d5f6c6f672f7261772e70726f746f120a74616e64656d5f6c6f67221f0a0352617712180a077061796c6f6164"
        "18012001280c52077061796c6f6164620670726f746f33"
    )
