"""Bad bytes for every reader of bytes: accepted, or refused as declared."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from controller_node.certified_sets import CertifiedSets, Found
from lbmpc.sets.certificate import CertificateError
from protocol import codec, topics
from protocol import messages as m
from protocol.codec import BadMessage
from verification.fuzz import __main__ as fuzz
from verification.fuzz import mutate
from verification.fuzz.certified import small_sets
from verification.fuzz.seeds import seeds
from verification.fuzz.targets import Target, targets
from verification.fuzz.work import Report, merge

WEIGHTS = topics.HIDDEN_WEIGHTS


@pytest.fixture(scope="module")
def payloads() -> dict[str, list[bytes]]:
    return seeds()


def test_twenty_thousand_bad_payloads(tmp_path: Path) -> None:
    (report,) = fuzz.measure(fuzz.Fuzz(payloads=20_000, jobs=1, seed=7, out=tmp_path), Console(quiet=True))
    assert report.findings == []
    assert report.ended
    assert report.payloads == 20_000
    found = merge([report])
    names = {topic.name for topic in topics.ALL}
    assert names <= found.keys()
    for name in names:
        kinds = found[name].kinds
        assert kinds["accepted"] > 0
        assert kinds["malformed"] > 10
    assert fuzz.growth(report) < fuzz.GROWTH_KB


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("certified sets, forged", 150),
        ("a control step with certified sets", 300),
        ("configuration of a log, its controller", 25),
        ("plant of a log, its model", 200),
    ],
)
def test_forged_input_is_refused_or_handled(readers: dict[str, Target], name: str, count: int) -> None:
    reader = readers[name]
    kinds = {reader.read(reader.make()) for _ in range(count)}
    assert len(kinds) > 1


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return {target.name: target for target in targets(11, tmp_path_factory.mktemp("fuzz"))}


@pytest.mark.parametrize(
    ("part", "value", "says"),
    [
        ("A", [[1.0], [1.0, 2.0]], "the model's A: its rows have different lengths"),
        ("B", [], r"the model's B has shape \(0,\)"),
        ("X", ([1.0], [2.0]), r"the model's X has shape \(2, 1\), not \(2, 4\)"),
        ("g", [1.0], "G has shape"),
        ("u_upper", [5.0], "not in order, or outside U"),
        ("u_upper", [-0.9], "not in order, or outside U"),
        ("u_lower", [-5.0], "not in order, or outside U"),
    ],
)
def test_forged_sets_are_refused_with_the_reason(part: str, value: Any, says: str) -> None:
    sets = small_sets()
    if part in sets.model.__struct_fields__:
        sets = msgspec.structs.replace(sets, model=msgspec.structs.replace(sets.model, **{part: value}))
    else:
        sets = msgspec.structs.replace(
            sets, pieces=[msgspec.structs.replace(sets.pieces[0], **{part: value})]
        )
    with pytest.raises(CertificateError, match=says):
        CertifiedSets.from_bytes(CertifiedSets.of(sets, Found(0.5, 0.1, True, 1.0)).to_bytes())


def test_an_undeclared_exception_of_a_reader_is_a_finding(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from verification.fuzz import work

    class BusListener:
        said = b""

        def send_bytes(self, payload: bytes) -> None:
            self.said = payload

        def close(self) -> None:
            pass

    def clumsy(payload: bytes) -> str:
        return "accepted" if payload[0] < 0xF0 else str(payload[10**6])

    make = mutate.Mutator([b"\x81\xa1a\x01"], [b"\x90"], mutate.BINARY, 0)
    monkeypatch.setattr(work, "targets", lambda seed, folder: [Target("clumsy", clumsy, make, 1.0)])
    ear: Any = BusListener()
    monkeypatch.setattr(work.logging, "disable", lambda: None)
    work.Work(2000, 0, str(tmp_path)).run(ear)
    report = msgspec.json.decode(ear.said, type=Report)
    assert report.findings
    assert report.findings[0].error.startswith("IndexError")
    assert report.found["clumsy"].crashed >= len(report.findings)


def test_the_same_seed_makes_the_same_payloads(payloads: dict[str, list[bytes]]) -> None:
    known = payloads[WEIGHTS.name]
    one, two = (mutate.Mutator(known, known, mutate.BINARY, 3) for _ in range(2))
    assert [one() for _ in range(300)] == [two() for _ in range(300)]


@pytest.mark.parametrize("array", mutate.ARRAYS)
def test_an_array_that_numpy_cannot_hold_is_malformed(payloads: dict[str, list[bytes]], array: dict) -> None:
    """The controller died of such hidden weights: their shape fits their data, but no such array exists."""
    tree = msgspec.msgpack.decode(payloads[WEIGHTS.name][0])
    tree["layers"][0] = array
    try:
        weights = codec.decode(WEIGHTS, msgspec.msgpack.encode(tree))
    except BadMessage:
        return
    assert isinstance(weights, m.HiddenWeights)
    assert weights.layers[0].numpy().size == len(array["data"]) // weights.layers[0].numpy().itemsize


@pytest.mark.parametrize("seq", [2**63, 2**64 - 1, -2])
def test_a_number_that_no_memory_holds_is_malformed(payloads: dict[str, list[bytes]], seq: int) -> None:
    """The controller died of it: its memory has 64 bits for a version, including the sign."""
    tree = msgspec.msgpack.decode(payloads[WEIGHTS.name][0])
    tree["seq"] = seq
    with pytest.raises(BadMessage, match="malformed"):
        codec.decode(WEIGHTS, msgspec.msgpack.encode(tree))


def test_a_certificate_file_with_invalid_utf_8_is_refused() -> None:
    with pytest.raises(CertificateError):
        CertifiedSets.from_bytes(b'{"sha256": "\x93"}')


SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8)
)
TREES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=8,
)


def _changes(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    found = [(*path, key) for key, _ in entries]
    return found + [below for key, value in entries for below in _changes(value, (*path, key))]


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_any_value_in_any_field_is_refused_or_handled(
    payloads: dict[str, list[bytes]], data: st.DataObject
) -> None:
    """Structured: a message of any topic with any other value in one field."""
    topic = data.draw(st.sampled_from(topics.ALL))
    tree = msgspec.msgpack.decode(payloads[topic.name][0])
    path = data.draw(st.sampled_from(_changes(tree)))
    node = tree
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = data.draw(TREES)
    try:
        message = codec.decode(topic, msgspec.msgpack.encode(tree))
        codec.check_dimensions(topic, message, 4, 1)
    except BadMessage:
        return
    assert codec.first_non_finite(message) is None
    assert codec.decode(topic, codec.encode(message)) == message


def test_control_messages_are_checked_for_finite_numbers_by_their_sum(
    payloads: dict[str, list[bytes]],
) -> None:
    """Unset fields do not need the slow check, which names the field; only arrays do."""
    for topic in (topics.PLANT_STATE, topics.COMMAND, topics.BACKUP, topics.TICK, topics.RESULT):
        for payload in payloads[topic.name]:
            message = codec.decode(topic, payload)
            if getattr(message, "weights", None) is None:
                assert codec._surely_finite(message), topic.name


@pytest.mark.parametrize("mutation", mutate.BINARY, ids=lambda one: one.__name__)
def test_mutations_accept_any_bytes(mutation: Callable[..., bytes]) -> None:
    rng = random.Random(1)
    for payload in (b"", b"\x00", b"\xcb", b"\xcb" * 9, rng.randbytes(50)):
        for _ in range(50):
            assert isinstance(mutation(payload, [b"", b"abc"], rng), bytes)
