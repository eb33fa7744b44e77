"""The fault suite itself: moments, results, table and continuation; three faults on real processes."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from benchmarks.document_block import DocumentError
from lbmpc.plants import get_plant
from protocol import codec, topics
from protocol import messages as m
from tests.helpers.live import HANG_S, wait_for
from tests.helpers.paths import ROOT
from tests.verification.calm import CALM, seen
from verification.faults import holds, suite, table
from verification.faults.catalogue import ALL, BY_NAME, Fault, Stage
from verification.faults.facts import Facts
from verification.faults.processes import link
from verification.faults.processes.rig import Rig
from verification.faults.suite import Outcome, Results


def test_moments_follow_from_the_seed_and_differ() -> None:
    fault = ALL[0]
    moments = [suite.moment(fault, index, 3) for index in range(20)]
    assert moments == [suite.moment(fault, index, 3) for index in range(20)]
    assert len(set(moments)) == 20
    assert all(suite.EARLIEST_S <= at <= suite.SETTLED_S for at in moments)
    assert moments[0] != suite.moment(ALL[1], 0, 3)
    assert len(BY_NAME) == len(ALL)


def outcome(index: int, facts: Facts | None = CALM, **more: Any) -> Outcome:
    return Outcome(
        fault=ALL[0].name, stage="usual", index=index, seed=0, at=1.0, wall_s=1.0, facts=facts, **more
    )


def test_an_interrupted_suite_continues(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"

    def find() -> Outcome | None:
        return Results(path).find(ALL[0].name, "usual", 0, 0)

    assert find() is None
    for made in (outcome(0, None, error="the machine was too slow"), outcome(0, CALM)):
        Results(path).put(made)
        assert find() == made
    # A line that was unfinished when the suite was killed.
    path.write_bytes(path.read_bytes() + b'{"fault": "kil')
    assert find() == outcome(0, CALM)
    path.write_bytes(b'{"fault": "of another version"}\n')
    with pytest.raises(suite.ResultsError, match="--fresh"):
        Results(path)


@pytest.mark.live
@pytest.mark.skipif(not link.available(), reason="links to network namespaces need root")
def test_a_stopped_suite_removes_its_processes_and_mounts(tmp_path: Path) -> None:
    words = ["--runs", "1", "--only", "SIGSTOP of the controller", "--jobs", "2", "--out", str(tmp_path)]
    command = [sys.executable, "-m", "verification.faults", *words]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            # Two runs at a time, each with its processes and its link.
            wait_for(lambda: len(list(tmp_path.glob("*/plant.txt"))) == 2)
            assert len(of_runs_in(tmp_path)) >= 2
            process.terminate()
            said, _ = process.communicate(timeout=HANG_S)
        finally:
            process.kill()
    assert process.returncode == 130
    assert "continues from" in said
    assert "Traceback" not in said
    assert of_runs_in(tmp_path) == []


def of_runs_in(folder: Path) -> list[str]:
    """Return the command lines of the processes whose configuration is below this folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            words = process.read_bytes().decode(errors="replace").split("\0")
            if "verification.faults" not in words and any(word.startswith(str(folder)) for word in words):
                found.append(" ".join(words))
    return found


def test_the_table_names_the_failed_checks(tmp_path: Path) -> None:
    good = suite.judged(outcome(0), ALL[0], CALM)
    bad = suite.judged(outcome(1, seen(violations=2, deepest=0.03)), ALL[0], CALM)
    dead = suite.judged(outcome(2, None, error="no first command"), ALL[0], CALM)
    text = table.markdown({ALL[0].name: [table.Pair(one, CALM) for one in (good, bad, dead)]}, ALL, ["head"])
    row = next(line for line in text.splitlines() if line.startswith(f"| {ALL[0].name}"))
    assert row.split(" | ")[1:5] == ["3", "1", "2, 0", "3.0, 0.0"]
    assert "| 1 | 1.00 | 2 samples outside, 0 without the fault |" in text
    assert "| 2 | 1.00 | no first command |" in text
    document = tmp_path / "faults.md"
    document.write_text(f"before\n{table.MARKS.begin}\nold\n{table.MARKS.end}\nbehind\n")
    table.MARKS.put(document, text)
    assert document.read_text().startswith(f"before\n{table.MARKS.begin}\n\nhead\n")
    assert document.read_text().endswith(f"{table.MARKS.end}\nbehind\n")
    assert "\nold\n" not in document.read_text()
    document.write_text("no marks")
    with pytest.raises(DocumentError, match="lacks"):
        table.MARKS.put(document, text)


def newest(rig: Rig, topic: topics.Topic, since: float) -> m.Message | None:
    """Return the last message of a process of the run after `since`; strangers' messages are left out."""
    for heard in reversed(rig.heard):
        if heard.at <= since:
            return None
        if heard.topic == topic.name:
            try:
                message = codec.decode(topic, heard.payload)
            except codec.BadMessage:
                continue
            if message.run_id.startswith(f"{topic.writer}-"):
                return message
    return None


def ignored(rig: Rig, topic: str) -> int:
    """Return how many messages of a topic the controller reports as refused."""
    health = newest(rig, topics.HEALTH["controller"], 0.0)
    assert isinstance(health, m.Health)
    names = (m.counter_name("bad", topic), m.counter_name("overflow", topic))
    return sum(count for name, count in health.counters.items() if name.startswith(names))


def driven_since(rig: Rig, moment: float | None) -> bool:
    """Return whether the plant reports that a fresh command drives it, after `since`."""
    state = None if moment is None else newest(rig, topics.PLANT_STATE, moment)
    return isinstance(state, m.PlantState) and state.source == "command"


@pytest.mark.live
@pytest.mark.long
def test_three_faults_on_real_processes(tmp_path: Path) -> None:
    """A short version of `make faults`: a frozen controller, garbage, a killed controller."""

    def inflict(rig: Rig, seed: int) -> dict[str, float]:
        rig.freeze("controller", 0.5)
        sent = rig.attack("garbage", 500.0, 0.5, seed)
        # The counters of a killed process are lost.
        bad = sent["sent plant/state"]
        rig.wait(lambda: ignored(rig, "plant/state") >= bad, HANG_S, "the controller's count of bad states")
        rig.kill("controller")
        rig.await_restarted(HANG_S)
        rig.wait(lambda: driven_since(rig, rig.back_at("controller")), HANG_S, "control back")
        return sent

    # At rest the plant waits for a controller that takes half a minute to come back.
    at_rest = f"plant.x0={get_plant('moore_greitzer').x_e.tolist()}"
    settings = (at_rest, "network.hidden=[6]", "controller.horizon=20", "controller.solver.compile=never")
    stage = Stage("quick", plant="loopback", settings=settings, seconds=1.0)
    # `make faults` checks how soon control is back.
    checks = (holds.no_burst, holds.none_obeyed, holds.all_counted, holds.replays)
    fault = Fault("three in turn", "quick", inflict, checks, stage, after=0.5)
    ran = suite.run(stage, fault, 0, 1, tmp_path / "run", [])
    assert ran.facts is not None, ran.error
    assert suite.judged(ran, fault, ran.facts).not_held == []
    assert ran.facts.extra["sent plant/state"] > 5
    assert {"plan", "command"} <= set(ran.facts.sources)
    assert ran.facts.ready_after is not None
    assert ran.facts.control_after is not None
    assert ran.facts.ticks > 5
