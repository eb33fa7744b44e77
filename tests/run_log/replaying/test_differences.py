"""Replay finds every edit of a log, and reports possible causes of a difference."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from node_runtime.config.strict import ConfigError
from protocol import messages as m
from protocol import topics
from protocol.topics import Topic
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.replaying.comparison import first_difference
from run_log.replaying.replay import replay
from run_log.run import Entry, Run
from run_log.writing.save import save
from tests.run_log.replaying.edited import RUN, edited, flip, with_x


@pytest.mark.parametrize(("seq", "bit"), [(0, 0), (40, 0), (41, 30), (89, 1)])
def test_one_flipped_bit_in_a_tick_is_reported_with_its_tick(run: Run, seq: int, bit: int) -> None:
    changed = edited(
        run, topics.TICK, seq, lambda tick: with_x(tick, [flip(tick.state.x[0], bit), *tick.state.x[1:]])
    )
    found = replay(changed)
    assert not found.equal
    assert found.first_difference is not None
    assert found.first_difference.tick == seq
    assert found.first_difference.run_id == RUN
    assert found.first_difference.recorded != found.first_difference.replayed


@pytest.mark.parametrize("field", ["t", "lateness"])
def test_a_flipped_bit_that_the_step_does_not_use_is_reported_too(run: Run, field: str) -> None:
    changed = edited(
        run,
        topics.TICK,
        7,
        lambda tick: msgspec.structs.replace(tick, **{field: flip(getattr(tick, field), 0)}),
    )
    found = replay(changed)
    assert found.differing_ticks == 1
    assert found.first_difference is not None
    assert found.first_difference.tick == 7
    assert found.first_difference.field == "result.tick_crc32"


def test_one_flipped_bit_in_the_file_survives_a_rewrite_and_is_reported(run: Run, tmp_path: Path) -> None:
    """The edited log is a complete file with valid checksums. Only the replay finds the edit."""
    payload = bytearray(run.entries(topics.TICK)[33].payload)
    x = run.ticks[33].state
    assert x is not None
    place = payload.index(b"\xcb" + struct.pack(">d", x.x[1])) + 8
    payload[place] ^= 1
    entries = list(run.entries(topics.TICK))
    entries[33] = Entry(entries[33].log_time, bytes(payload), entries[33].message)
    run.streams[topics.TICK.name] = entries
    save(run, tmp_path / "edited.mcap")
    first = replay(read_run(tmp_path / "edited.mcap")).first_difference
    assert first is not None
    assert first.tick == 33


def test_no_more_ticks_differ_than_there_are(run: Run) -> None:
    found = replay(run, overrides=["controller.horizon=7"])
    assert found.first_difference is not None
    assert found.first_difference.tick == -1  # the memory before the first tick
    assert 0 < found.differing_ticks <= found.ticks


def test_a_changed_tolerance_is_reported_with_its_tick(run: Run) -> None:
    found = replay(run, overrides=["controller.solver.tolerance=0.1"])
    assert not found.equal
    assert found.first_difference is not None
    assert found.first_difference.field.startswith("command.u")
    assert found.differing_ticks > 5
    assert found.largest_difference is not None
    assert 0.0 < found.largest_difference < 0.1
    assert any("changed: controller.solver.tolerance=0.1" in note for note in found.notes)


def test_other_changes(run: Run) -> None:
    assert replay(run, overrides=["controller.phase_ms=2"]).equal  # no part of the control law
    seed = replay(run, overrides=["seed=1"]).first_difference
    assert seed is not None
    assert (seed.tick, seed.field[:9]) == (-1, "keyframe.")
    horizon = replay(run, overrides=["controller.horizon=16"])
    assert not horizon.equal
    assert horizon.largest_difference is None
    with pytest.raises(LogError, match="does not fit this configuration"):
        replay(run, 40, overrides=["controller.horizon=16"])
    with pytest.raises(ConfigError, match="tolerence"):
        replay(run, overrides=["controller.solver.tolerence=1"])


@pytest.mark.parametrize(
    ("topic", "seq", "field", "change"),
    [
        (topics.COMMAND, 20, "command.plan[3][0]", lambda c: msgspec.structs.replace(
            c, plan=[*c.plan[:3], [flip(c.plan[3][0], 0)], *c.plan[4:]])),
        (topics.RESULT, 21, "result.weights_verdict", lambda r: msgspec.structs.replace(
            r, weights_verdict="adopted!")),
        (topics.OUTPUT_WEIGHTS, 22, "output_weights.K[", lambda w: msgspec.structs.replace(
            w, K=m.Array.of(np.nextafter(w.K.numpy(), 1)))),
        (topics.KEYFRAME, 49, "keyframe.arrays.", lambda k: msgspec.structs.replace(
            k, arrays={**k.arrays, "pending.x": m.Array.of(k.arrays["pending.x"].numpy() + 1e-16)})),
    ],
)  # fmt: skip
def test_an_edited_output_is_found(
    run: Run, topic: Topic, seq: int, field: str, change: Callable[[Any], m.Message]
) -> None:
    first = replay(edited(run, topic, seq, change)).first_difference
    assert first is not None
    assert first.tick == seq
    assert first.field.startswith(field)


def test_bytes_count_even_where_fields_agree(run: Run) -> None:
    """A command with another encoding has the same content and other bytes."""
    entries = list(run.entries(topics.COMMAND))
    tree = msgspec.msgpack.decode(entries[5].payload)
    other = msgspec.msgpack.encode(dict(reversed(tree.items())))
    entries[5] = Entry(0, other, entries[5].message)
    run.streams[topics.COMMAND.name] = entries
    first = replay(run).first_difference
    assert first is not None
    assert (first.tick, first.field) == (5, "command (byte 1)")


def test_a_result_of_a_version_before_a_field_replays_where_the_field_is_at_its_default(run: Run) -> None:
    entries = list(run.entries(topics.RESULT))
    for i, entry in enumerate(entries):
        tree = msgspec.msgpack.decode(entry.payload)
        del tree["target_distance"]
        entries[i] = Entry(entry.log_time, msgspec.msgpack.encode(tree), entry.message)
    run.streams[topics.RESULT.name] = entries
    assert replay(run).first_difference is None


def test_difference_sees_signs_of_zero_and_types() -> None:
    assert first_difference([0.0], [0.0], "x") is None
    assert first_difference([0.0], [-0.0], "x") == ("x[0]", 0.0, -0.0)
    assert first_difference([1], [1.0], "x") == ("x[0]", 1, 1.0)
    assert first_difference({"a": None}, {"a": 2}, "x") == ("x.a", None, 2)


def said(run: Run, **facts: str | None) -> Run:
    """Return a copy whose controller reports other facts about its machine; None removes a fact."""

    def change(info: m.RunInfo) -> m.RunInfo:
        versions = {name: then for name, then in {**info.versions, **facts}.items() if then is not None}
        return msgspec.structs.replace(info, versions=versions)

    return edited(run, topics.RUN_INFO["controller"], 0, change)


def rounded(run: Run, by: float) -> Run:
    """Return a copy in which one input of a plan differs by this amount, in units of u."""

    def change(command: m.Command) -> m.Command:
        plan = [*command.plan[:-1], [command.plan[-1][0] + by]]
        return msgspec.structs.replace(command, plan=plan)

    return edited(run, topics.COMMAND, 7, change)


def test_a_log_has_the_facts_on_which_its_arithmetic_depends(run: Run) -> None:
    (info,) = run.run_infos
    assert info.versions.keys() >= {"machine", "processor", "kernels", "blas", "numpy", "casadi"}
    assert info.versions["blas"] != "unknown"
    found = replay(run)
    assert (found.equal, found.rounding, found.elsewhere, found.notes) == (True, False, False, [])


@pytest.mark.parametrize(
    ("facts", "by", "rounding", "elsewhere", "note"),
    [
        (
            {"blas": "openblas 0.3 Prescott"},
            1e-12,
            True,
            True,
            "recorded with blas openblas 0.3 Prescott (here ",
        ),
        (
            {"kernels": "not compiled: no C compiler"},
            9e-8,
            True,
            True,
            "kernels not compiled: no C compiler (here ",
        ),
        ({"processor": "another"}, 2e-7, False, True, "equal to about 1e-07 at best, not to the byte"),
        (
            {"blas": None, "processor": None},
            1e-12,
            True,
            None,
            "the log does not contain its processor, blas, so ",
        ),
        ({}, 1e-12, True, False, ""),
    ],
    ids=["other kernel", "no compiler", "too far", "says nothing of it", "this machine"],
)
def test_a_difference_by_rounding_is_named_and_explained(
    run: Run, facts: dict[str, str | None], by: float, rounding: bool, elsewhere: bool | None, note: str
) -> None:
    found = replay(rounded(said(run, **facts), by))
    assert not found.equal
    assert (found.rounding, found.elsewhere) == (rounding, elsewhere)
    assert note in " ".join(found.notes)


def test_an_equal_replay_of_a_log_from_another_machine_says_so(run: Run) -> None:
    found = replay(said(run, processor="another"))
    assert found.equal
    assert any("(here " in note and note.endswith("still equal") for note in found.notes)


def test_other_versions_are_mentioned(run: Run) -> None:
    topic = topics.RUN_INFO["controller"]
    changed = edited(
        run,
        topic,
        0,
        lambda info: msgspec.structs.replace(info, versions={**info.versions, "casadi": "0.0.1"}),
    )
    assert any("casadi 0.0.1 (here" in note for note in replay(changed).notes)
