"""The fault suite itself: what its checks see, that it goes on where it stopped, and three faults on real processes."""

from __future__ import annotations

import ast
import itertools
import socket
import subprocess
import sys
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from benchmarks.document_block import DocumentError
from benchmarks.live import stalls
from lbmpc.plants import get_plant
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import override, to_json
from node_runtime.realtime import clock
from protocol import codec, topics
from protocol import messages as m
from tests.helpers.live import HANG_S, Process, live_config, matched, wait_for
from tests.helpers.paths import INSTALLED, ROOT
from verification.faults import evaluation as measured
from verification.faults import holds, suite, table
from verification.faults.catalogue import ALL, BY_NAME, Fault, Stage
from verification.faults.facts import Facts, Replayed
from verification.faults.processes import link
from verification.faults.processes.rig import Rig
from verification.faults.processes.traced_plant import Sampled
from verification.faults.suite import Outcome, Results

CALM = Facts(
    violations=0,
    deepest=0.0,
    J=24.0,
    samples=200,
    ticks=200,
    late=0,
    late_by_machine=0,
    tick_p99_ms=5.0,
    sources=["command"],
    plan_s=0.0,
    safe_s=0.0,
    ready_after=None,
    control_after=0.0,
    burst=2,
    foreign_commands=0,
    foreign_states=0,
    samples_made=199,
    samples_held=199,
    readable_gap=None,
    log_missing=0,
    replay=Replayed("exact"),
    forged_adopted=0,
    rolled_back=0,
    errors=[1e-3] * 20 + [1e-4] * 20,
    fault_tick=20,
    view_at_end="recorder running writing run.mcap",
    log_time_off=0.0,
    verdicts={},
    counted={},
    said=[],
    extra={},
)


def seen(**changes: Any) -> Facts:
    return msgspec.structs.replace(CALM, **changes)


@pytest.mark.parametrize(
    ("check", "bad"),
    [
        (holds.constraints, {"violations": 1}),
        (holds.control_back, {"control_after": 1.2}),
        (holds.control_back, {"control_after": None}),
        (holds.control_kept, {"plan_s": 0.1}),
        (holds.punctual, {"late": 3, "late_by_machine": 2}),
        (holds.no_burst, {"burst": 3}),
        (holds.plan_then_safe, {"sources": ["command", "safe", "command"]}),
        (holds.merged, {"samples_held": 198}),
        (holds.merged, {"samples_held": 200}),
        (holds.merged, {"samples_held": None}),
        (holds.readable, {"readable_gap": 0.7}),
        (holds.readable, {"readable_gap": 0.1, "replay": Replayed("DIFFERS", "DIFFERS: x")}),
        (holds.readable, {"readable_gap": 0.1, "log_missing": 1}),
        (holds.replays, {"replay": Replayed("no replay", "no replay: it is empty")}),
        (holds.whole, {"replay": Replayed("exact, with gaps", "exact, but 3 ticks are not in the log")}),
        (holds.none_obeyed, {"foreign_commands": 1}),
        (holds.none_obeyed, {"foreign_states": 1}),
        (
            holds.all_counted,
            {"extra": {"sent plant/state": 2}, "counted": {"controller bad plant/state: x": 1}},
        ),
        (holds.all_counted, {"counted": {"plant bad controller/command: foreign": 1}}),
        (
            holds.weights_refused,
            {
                "extra": {"sent trainer/hidden_weights": 3},
                "forged_adopted": 1,
                "errors": [1e-3] * 20 + [2e-4] * 20,
            },
        ),
        (holds.weights_refused, {}),
        (holds.refused_on_both_sides, {}),
        (holds.refused_on_both_sides, {"extra": {"tries": 2, "refused": 1, "said: no": 1}}),
        (holds.refused_on_both_sides, {"extra": {"tries": 2, "refused": 2}}),
        (holds.refused_on_both_sides, {"extra": {"tries": 2, "refused": 2, "said: no": 1}}),
        (holds.view_says, {}),
        (holds.view_said, {}),
        (holds.log_time, {"log_time_off": 3600.0}),
        (holds.as_fast, {"tick_p99_ms": 10.0}),
        (holds.as_good, {"J": 25.3}),
    ],
)
def test_every_check_can_fail(check: holds.Held, bad: dict[str, Any]) -> None:
    assert check(seen(**bad), CALM)


def test_every_check_can_hold() -> None:
    good = seen(
        late=2,
        late_by_machine=2,
        readable_gap=0.4,
        sources=["command", "plan", "safe", "command"],
        forged_adopted=1,
        errors=[9.0] * 20 + [1.2e-4] * 20,
        extra={
            "sent plant/state": 3,
            "sent trainer/hidden_weights": 2,
            "tries": 4,
            "refused": 4,
            "said: the router refused us": 4,
        },
        counted={
            "controller bad plant/state: malformed": 2,
            "controller overflow plant/state": 1,
            "controller bad trainer/hidden_weights: refused": 2,
            "router bad TLS link: refused, it has no certificate": 4,
        },
        said=["recorder: NOT LOGGED: full"],
    )
    checks = {held for fault in ALL for held in fault.holds} - {holds.view_says}
    assert [check(good, CALM) for check in checks] == [None] * len(checks)
    assert holds.view_says(seen(view_at_end="recorder silent"), CALM) is None


def sampled(source: str, t: float) -> Sampled:
    state = m.PlantState(
        run_id="plant-1",
        seq=0,
        t=t,
        x=[0.0],
        applied=[0.0],
        source=source,
        command_seq=0,  # type: ignore[arg-type]
    )
    return Sampled(t, state)


def test_control_is_back_with_the_first_fresh_command_that_is_followed_by_no_outage() -> None:
    sources = (
        ["command"] * 3
        + ["plan", "safe", "command", "plan", "command", "command"]
        + ["command"] * 20
        + ["plan"]
    )
    motion = [sampled(source, 0.1 * i) for i, source in enumerate(sources)]
    assert measured._control_at(motion, 0.25, 0.45) == pytest.approx(0.7)
    assert measured._control_at(motion[:3], 0.05, None) == 0.05
    assert measured._control_at(motion[:5], 0.25, None) is None
    late = [sampled("plan" if i == 20 else "command", 0.1 * i) for i in range(30)]
    assert measured._control_at(late, 0.25, None) == 0.25


def began(run_id: str, *times: float) -> list[m.Tick]:
    """Ticks that began then, each as late as it is after the first."""
    return [
        m.Tick(
            run_id=run_id,
            seq=seq,
            slot=seq,
            t=0.0,
            skipped=0,
            lateness=time,
            late=False,
            state_verdict="fresh",
            state=None,
            weights=None,
        )
        for seq, time in enumerate(times)
    ]


def test_a_burst_is_what_one_controller_begins_within_a_period() -> None:
    assert measured._burst(began("controller-1", 0.0, 0.05, 0.1, 0.101, 0.102, 0.15), 0.05) == 3
    one, other = began("controller-1", 0.0, 0.05, 0.075), began("controller-2", 0.0, 0.05, 0.1)
    assert measured._burst(one + other, 0.05) == 2
    assert measured._burst([], 0.05) == 0


def test_a_stall_excuses_what_it_overlaps(tmp_path: Path) -> None:
    path = tmp_path / "stalls.txt"
    path.write_text("10.0 0.02\n5.0 0.5\n11.")
    noted = stalls.read(path)
    assert noted == [(5.0, 0.5), (10.0, 0.02)]
    assert stalls.during(noted, 10.01, 10.5)
    assert not stalls.during(noted, 5.6, 9.9)


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


def test_a_suite_goes_on_where_it_stopped(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"

    def find() -> Outcome | None:
        return Results(path).find(ALL[0].name, "usual", 0, 0)

    assert find() is None
    for made in (outcome(0, None, error="the machine was too slow"), outcome(0, CALM)):
        Results(path).put(made)
        assert find() == made
    # A line that was being written when the suite was killed.
    path.write_bytes(path.read_bytes() + b'{"fault": "kil')
    assert find() == outcome(0, CALM)
    path.write_bytes(b'{"fault": "of another version"}\n')
    with pytest.raises(suite.ResultsError, match="--fresh"):
        Results(path)


@pytest.mark.live
@pytest.mark.skipif(not link.available(), reason="links to network namespaces need root")
def test_a_suite_that_is_told_to_stop_leaves_nothing_behind(tmp_path: Path) -> None:
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
    assert "goes on from" in said
    assert "Traceback" not in said
    assert of_runs_in(tmp_path) == []


def of_runs_in(folder: Path) -> list[str]:
    """The command lines of the processes whose configuration lies below this folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            words = process.read_bytes().decode(errors="replace").split("\0")
            if "verification.faults" not in words and any(word.startswith(str(folder)) for word in words):
                found.append(" ".join(words))
    return found


def test_the_table_names_what_did_not_hold(tmp_path: Path) -> None:
    good = suite.judged(outcome(0), ALL[0], CALM)
    bad = suite.judged(outcome(1, seen(violations=2, deepest=0.03)), ALL[0], CALM)
    dead = suite.judged(outcome(2, None, error="no first command"), ALL[0], CALM)
    text = table.markdown({ALL[0].name: [table.Pair(one, CALM) for one in (good, bad, dead)]}, ALL, ["head"])
    row = next(line for line in text.splitlines() if line.startswith(f"| {ALL[0].name}"))
    assert row.split(" | ")[1:5] == ["3", "1", "2, 0", "3.0, 0.0"]
    assert "run 1 at 1.00 s: 2 samples outside, 0 without the fault" in text
    assert "run 2 at 1.00 s: no first command" in text
    document = tmp_path / "faults.md"
    document.write_text(f"before\n{table.MARKS.begin}\nold\n{table.MARKS.end}\nbehind\n")
    table.MARKS.put(document, text)
    assert document.read_text().startswith(f"before\n{table.MARKS.begin}\n\nhead\n")
    assert document.read_text().endswith(f"{table.MARKS.end}\nbehind\n")
    assert "\nold\n" not in document.read_text()
    document.write_text("no marks")
    with pytest.raises(DocumentError, match="lacks"):
        table.MARKS.put(document, text)


ECHO = """
import socket, sys
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as echo:
    echo.bind(("0.0.0.0", 9999))
    print("ready", flush=True)
    while True:
        data, whence = echo.recvfrom(100)
        echo.sendto(data, whence)
"""


@pytest.mark.live
@pytest.mark.skipif(not link.available(), reason="links to network namespaces need root")
def test_a_wire_delays_drops_and_cuts() -> None:
    with link.link("wire", 50) as wire, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
        words = [*wire.prefix, sys.executable, "-c", ECHO]
        with subprocess.Popen(words, stdout=subprocess.PIPE) as echo:
            try:
                assert echo.stdout is not None
                assert echo.stdout.readline()
                there = (wire.here.rpartition(".")[0] + f".{int(wire.here.rpartition('.')[2]) + 1}", 9999)

                turns = itertools.count()

                def answered(count: int, wait: float) -> list[float]:
                    """After how long each answer came; what comes late from an earlier turn is none."""
                    turn, begin, times = next(turns), clock.now(), []
                    sent = {b"%d %d" % (turn, number) for number in range(count)}
                    for word in sorted(sent):
                        here.sendto(word, there)
                    here.settimeout(wait)
                    try:
                        while len(times) < count:
                            if here.recv(100) in sent:
                                times.append(clock.now() - begin)
                    except TimeoutError:
                        pass
                    return times

                wait_for(lambda: len(answered(5, 1.0)) == 5)
                wire.shape(link.Shape(delay=0.1))
                # The new shape is known to the wire's process when it says so by what it does.
                wait_for(lambda: min(answered(3, 1.0), default=0.0) >= 0.2)
                wire.shape(link.Shape(loss=0.5))
                wait_for(lambda: 20 < len(answered(200, 0.5)) < 100)
                wire.shape(link.Shape(cut=True))
                wait_for(lambda: answered(3, 0.3) == [])
                wire.shape(link.Shape())
                wait_for(lambda: len(answered(5, 1.0)) == 5)
            finally:
                echo.kill()


LINGER_S = 10.0
FAR = """
import sys, threading
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import from_json
from protocol import topics
with Bus(from_json(sys.argv[1]), "plant", "plant-far") as bus:
    kept = [bus.queue(topics.OUTPUT_WEIGHTS), bus.queue(topics.COMMAND)]
    print("ready", flush=True)
    threading.Event().wait()
"""


@pytest.mark.live
@pytest.mark.skipif(not link.available(), reason="links to network namespaces need root")
def test_a_client_that_vanishes_does_not_stop_the_router() -> None:
    """Zenoh closed its two links in its only two receiving threads, which waited up to 10 s in that."""
    local = live_config("bus.lease_ms=400")
    port = local.bus.endpoint.rpartition(":")[2]
    listening = override(local, [f'bus.endpoint="tcp/0.0.0.0:{port}"', "bus.insecure=true"])
    with (
        link.link("wire", 51) as wire,
        Process("node_runtime.router", listening),
        Bus(local, "controller", "controller-1") as controller,
        Bus(local, "plant", "plant-1") as plant,
    ):
        heard = controller.queue(topics.PLANT_STATE)
        far = to_json(override(local, [f'bus.endpoint="tcp/{wire.here}:{port}"']))
        with subprocess.Popen(
            [*wire.prefix, sys.executable, "-c", FAR, far], stdout=subprocess.PIPE
        ) as client:
            try:
                assert client.stdout is not None
                assert client.stdout.readline()
                wait_for(
                    lambda: matched(controller, topics.OUTPUT_WEIGHTS) and matched(plant, topics.PLANT_STATE)
                )
                wire.shape(link.Shape(cut=True))
                K = m.Array.of(np.zeros((65, 4)))
                sent: list[float] = []
                for seq in range(60):
                    weights = m.OutputWeights(
                        run_id="controller-1", seq=seq, hidden_version=0, hidden_sha256="", K=K
                    )
                    controller.publish(topics.OUTPUT_WEIGHTS, weights)
                    sent.append(clock.now())
                    plant.publish(topics.PLANT_STATE, sampled("hold", 0.05 * seq).state)
                    clock.sleep_until(clock.now() + 0.05)
                wait_for(lambda: len(heard) == len(sent))
                # A router that waits does so for 10 s from a lease after the cut.
                under_way = [d.received_ns * 1e-9 - at for d, at in zip(heard.drain(), sent, strict=True)]
                assert max(under_way) < LINGER_S / 2
            finally:
                client.kill()


WALL_CLOCK = {"time", "time_ns", "localtime", "gmtime", "ctime", "now", "today", "utcnow"}
MAY_READ_IT = {
    "node_runtime/provenance.py run_info": "for people: when this process began",
    "controller_node/node.py _live": "the same",
    "run_log/writing/recorder.py main": "the log's beginning",
    "run_log/writing/recorder.py _record": "once, the offset of all times in the log",
    "node_runtime/tls/credentials.py *": "certificates end at a date",
    "tandem/certificate_authority.py *": "the same",
    "tandem/commands/keys.py *": "the same",
}


def test_nothing_but_these_reads_the_wall_clock() -> None:
    """So a step of it can change nothing else; `make faults` steps it, and this says why that holds."""
    found = set()
    for package in INSTALLED:
        for path in sorted((ROOT / package).rglob("*.py")):
            for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not isinstance(function, ast.FunctionDef):
                    continue
                for node in ast.walk(function):
                    if (
                        isinstance(node, ast.Attribute)
                        and node.attr in WALL_CLOCK
                        and isinstance(node.value, ast.Name)
                        and node.value.id in ("time", "datetime", "date")
                    ):
                        found.add(f"{path.relative_to(ROOT)} {function.name}")
    assert "run_log/writing/recorder.py _record" in found
    assert [place for place in found if not any(fnmatch(place, known) for known in MAY_READ_IT)] == []


def newest(rig: Rig, topic: topics.Topic, since: float) -> m.Message | None:
    """The last message of a process of the run heard after `since`; strangers' are left out."""
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
    """How many messages of a topic the controller says that it did not obey."""
    health = newest(rig, topics.HEALTH["controller"], 0.0)
    assert isinstance(health, m.Health)
    names = (f"bad {topic}:", f"overflow {topic}")
    return sum(count for name, count in health.counters.items() if name.startswith(names))


def driven_since(rig: Rig, moment: float | None) -> bool:
    """Whether the plant says that a fresh command drives it, and has said so since then."""
    state = None if moment is None else newest(rig, topics.PLANT_STATE, moment)
    return isinstance(state, m.PlantState) and state.source == "command"


@pytest.mark.live
def test_three_faults_on_real_processes(tmp_path: Path) -> None:
    """A quick run of what `make faults` does at length: a frozen controller, garbage, a killed controller."""

    def inflict(rig: Rig, seed: int) -> dict[str, float]:
        rig.freeze("controller", 0.5)
        sent = rig.attack("garbage", 500.0, 0.5, seed)
        # A killed process tells no more of what it has counted.
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
    # How soon control is back is for `make faults`.
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
