"""Compute the figures of a run from three sources: the plant's own trace, the messages on the bus, and the log."""

from __future__ import annotations

import io
import math
import re
from collections import Counter
from itertools import pairwise

import numpy as np
from rich.console import Console

from benchmarks.live import stalls
from lbmpc.plants import Description, get_plant
from node_runtime.bus.mailbox import Delivery
from node_runtime.config.strict import ConfigError
from protocol import messages as m
from protocol import topics
from run_log.errors import LogError
from run_log.reading.reader import Run, read_run
from run_log.replaying.replay import replay
from run_log.reporting.motion import motion
from run_log.reporting.performance import outside, performance
from tandem.live.monitor import Monitor
from tandem.live.view import render
from verification.faults.facts import Facts, Replayed
from verification.faults.processes.rig import RESTARTED, Rig, RigError
from verification.faults.processes.traced_plant import Commanded, Sampled, read
from verification.faults.processes.witness import Witness
from verification.faults.strangers.attacker import MARK

OTHERWISE = ("plan", "safe")
COMMANDING = ("router", "controller")
APART_S = 0.5
SETTLE_S = 0.25
"""Seconds. After control is back, the process that was hurt may still be late for this long."""


def evaluate(rig: Rig, seconds: float, extra: dict[str, float]) -> Facts:
    """Return the figures of a run that has ended; its first `seconds` count for J."""
    config, plant, witness = rig.config, get_plant(rig.config.plant.model), Witness(rig)
    traced = read(rig.trace)
    sampled = [one for one in traced if isinstance(one, Sampled) and one.state.t < rig.ended_at]
    moving = sampled[next((i for i, one in enumerate(sampled) if one.state.source != "hold"), len(sampled)) :]
    if not moving:
        raise RigError("the plant never moved")
    fault_at = rig.events[0].at if rig.events else math.inf
    after = [one for one in moving if one.state.t > fault_at]
    # The fault did not cause a late command that came before it.
    judged = after or moving
    known = motion([[one.state for one in judged]], plant, config.period)
    every = motion([[one.state for one in moving]], plant, config.period)
    counted = every.part(0, min(round(seconds * config.rate), len(every.step) - 1))

    back_at = _back_at(rig, fault_at)
    control_at = _control_at(moving, fault_at, back_at)
    late, by_machine = _late(rig, witness, sampled, fault_at, control_at)
    results = witness.messages(topics.RESULT)
    controllers = {result.run_id for result in results}
    commands = [one for one in traced if isinstance(one, Commanded) and one.at > moving[0].state.t]
    made, held = _samples(witness)
    log, replayed = _log(rig)
    return Facts(
        violations=int(outside(known, plant).sum()),
        deepest=_deepest(known.x, known.applied, plant),
        J=performance(counted, plant, config, truth=plant).J,
        samples=len(counted.step) - 1,
        ticks=len(results),
        late=late,
        late_by_machine=by_machine,
        tick_p99_ms=_tick_p99(rig, witness),
        sources=_runs_of([one.state.source for one in after]),
        plan_s=sum(one.state.source == "plan" for one in after) * config.period,
        safe_s=sum(one.state.source == "safe" for one in after) * config.period,
        ready_after=None if back_at is None else back_at - fault_at,
        control_after=None if control_at is None else max(0.0, control_at - (back_at or fault_at)),
        burst=_burst(witness.messages(topics.TICK), config.period),
        foreign_commands=sum(one.verdict == "ok" and one.run_id not in controllers for one in commands),
        foreign_states=_foreign_states(witness, {one.state.run_id for one in sampled}),
        samples_made=made,
        samples_held=held,
        readable_gap=_readable_gap(rig, witness, log),
        log_missing=_missing(rig, witness, log),
        replay=replayed,
        forged_adopted=_forged_adopted(witness),
        rolled_back=sum(bool(r.weights_rolled_back) for r in results),
        errors=[r.prediction_error or 0.0 for r in results if r.run_id == results[0].run_id],
        fault_tick=sum(at < fault_at for at, _ in witness.of(topics.RESULT)),
        view_at_end=_view(rig),
        log_time_off=_log_time_off(log),
        verdicts=dict(Counter(_short(r.weights_verdict) for r in results if r.weights_outcome != "none")),
        counted=_counted(witness),
        said=_said(rig, witness),
        extra=extra,
        not_led=_not_led(results),
    )


def _not_led(results: list[m.TickResult]) -> int:
    led = [bool(result.reference) for result in results]
    return led[led.index(True) :].count(False) if True in led else 0


def _deepest(x: np.ndarray, applied: np.ndarray, plant: Description) -> float:
    state = plant.beyond_x(x)
    given = np.maximum(plant.u_min - applied, applied - plant.u_max) / plant.u_scale
    return max(0.0, float(state.max()), float(np.nanmax(given, initial=0.0)))


# -- control ------------------------------------------------------------


def _back_at(rig: Rig, fault_at: float) -> float | None:
    """When the last hurt part was back: a new process's first message, a link, a continued process.

    Commands do not wait for a trainer, so it does not count beside other processes.
    """
    killed = [name for name in RESTARTED if rig.processes[name].killed]
    moments = [rig.back_at(name) for name in killed if name in COMMANDING or len(killed) == 1]
    moments += [event.at for event in rig.events if event.whole_again]
    known = [at for at in moments if at is not None and at > fault_at]
    return max(known) if known and len(known) == len(moments) else None


def _control_at(moving: list[Sampled], fault_at: float, back_at: float | None) -> float | None:
    """When fresh commands drove the plant again; the moment of the fault if they never ceased."""
    ceased = [one.state.t for one in moving if one.state.t > fault_at and one.state.source in OTHERWISE]
    if not ceased or ceased[0] - fault_at > APART_S:
        # A gap that begins long after the fault is a late tick and counts as one.
        return fault_at
    end = ceased[0]
    for before, after in pairwise(ceased):
        # A single sample without a fresh command, long after the fault, is a late tick and counts as one.
        if after - before > APART_S and (back_at is None or after > back_at):
            break
        end = after
    fresh = [one.state.t for one in moving if one.state.t > end and one.state.source == "command"]
    return fresh[0] if fresh else None


def _burst(ticks: list[m.Tick], period: float) -> int:
    most = 0
    for run_id in {tick.run_id for tick in ticks}:
        # Runs are aligned at their own beginning.
        times = np.sort([tick.t + tick.lateness for tick in ticks if tick.run_id == run_id])
        within = np.searchsorted(times, times + 0.9 * period) - np.arange(len(times))
        most = max(most, int(within.max()))
    return most


def _runs_of(values: list[str]) -> list[str]:
    return [value for i, value in enumerate(values) if i == 0 or values[i - 1] != value]


def _foreign_states(witness: Witness, plants: set[str]) -> int:
    states = (tick.state for tick in witness.messages(topics.TICK) if tick.state is not None)
    return sum(state.run_id not in plants for state in states)


# -- punctuality ----------------------------------------------------------


def _late(
    rig: Rig, witness: Witness, sampled: list[Sampled], fault_at: float, control_at: float | None
) -> tuple[int, int]:
    """Count late or skipped ticks, and how many of them occurred while the machine itself stalled."""
    period, share = rig.config.period, rig.config.controller.late_fraction
    noted = stalls.read(rig.folder / "stalls.txt")
    hurt = any("controller" in event.concerns for event in rig.events)
    until = math.inf if control_at is None else control_at + SETTLE_S
    intervals = [(one.state.t, one.at) for one in sampled if one.at - one.state.t > share * period]
    for before, after in pairwise(sampled):
        intervals += [(before.state.t + period, after.at)] * (after.state.seq - before.state.seq - 1)
    timing = {(t.run_id, t.seq): t for t in witness.messages(topics.TIMING)}
    for tick in witness.messages(topics.TICK):
        cost = timing.get((tick.run_id, tick.seq))
        overrun = cost is not None and cost.lateness_ms + cost.tick_ms > period * 1e3
        if tick.state is None or not (tick.late or tick.skipped or overrun):
            continue
        begin = tick.state.t - tick.skipped * period
        end = tick.state.t + tick.lateness + (cost.tick_ms * 1e-3 if overrun and cost else 0.0) + 0.002
        if not (hurt and begin < until and end > fault_at):
            intervals += [(begin, end)] * max(1, tick.skipped)
    excused = sum(stalls.during(noted, begin, end) for begin, end in intervals)
    return len(intervals), excused


def _tick_p99(rig: Rig, witness: Witness) -> float | None:
    noted = stalls.read(rig.folder / "stalls.txt")
    timing = {(t.run_id, t.seq): t for t in witness.messages(topics.TIMING)}
    found = []
    for tick in witness.messages(topics.TICK):
        cost = timing.get((tick.run_id, tick.seq))
        if cost is None or tick.state is None:
            continue
        begin = tick.state.t
        if not stalls.during(noted, begin, begin + tick.lateness + cost.tick_ms * 1e-3 + 0.002):
            found.append(cost.tick_ms)
    return float(np.percentile(found, 99)) if found else None


# -- learning -------------------------------------------------------------


def _samples(witness: Witness) -> tuple[int, int | None]:
    """Count the samples that the last controller made, and those that its trainer held in the end."""
    results = witness.messages(topics.RESULT)
    made = sum(r.h is not None for r in results if r.run_id == results[-1].run_id)
    held = [health.counters.get("buffer") for _, health in witness.health("trainer")]
    return made, held[-1] if held else None


def _forged_adopted(witness: Witness) -> int:
    results = witness.messages(topics.RESULT)
    adopted = {(r.run_id, r.seq) for r in results if r.weights_outcome == "adopted"}
    ticks = witness.messages(topics.TICK)
    forged = [t for t in ticks if t.weights is not None and t.weights.samples == MARK]
    return sum((t.run_id, t.seq) in adopted for t in forged)


def _short(verdict: str) -> str:
    """Remove the figures from a note, so that equal notes can be counted."""
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", verdict)


# -- the log ----------------------------------------------------------------


def _log(rig: Rig) -> tuple[Run | None, Replayed]:
    try:
        run = read_run(rig.log)
    except (LogError, FileNotFoundError) as error:
        return None, Replayed("no replay", f"no replay: {error}".replace(str(rig.folder), ""))
    if not run.ticks:
        return run, Replayed("nothing in it", "nothing in it")
    try:
        found = replay(run)
    except (LogError, ConfigError) as error:
        return run, Replayed("no replay", f"no replay: {error}".replace(str(rig.folder), ""))
    if not found.equal:
        return run, Replayed("DIFFERS", f"DIFFERS: {found.first_difference}")
    if found.lost_ticks:
        return run, Replayed("exact, with gaps", f"exact, but {found.lost_ticks} ticks are not in the log")
    return run, Replayed("exact")


def _recorder_hurt(rig: Rig) -> float:
    """Return when its process or its disk was hurt; infinity if never."""
    moments = [event.at for event in rig.events if "disk" in event.concerns]
    return min([*moments, *rig.processes["recorder"].killed], default=math.inf)


def _log_time_off(log: Run | None) -> float | None:
    """Check that a stepped wall clock does not show in the log."""
    if log is None or not log.ticks:
        return None
    entries = log.entries(topics.TICK)
    same = [entry for entry in entries if entry.message.run_id == entries[0].message.run_id]
    logged = 1e-9 * (same[-1].log_time - same[0].log_time)
    return float(logged - (same[-1].message.t - same[0].message.t))


def _readable_gap(rig: Rig, witness: Witness, log: Run | None) -> float | None:
    """Time from the last state in the log to the last one that the suite heard before the recorder was hurt."""
    hurt = _recorder_hurt(rig)
    if not math.isfinite(hurt) or log is None:
        return None
    written = {state.seq for state in log.plant_states}
    before = [(at, state.seq) for at, state in witness.of(topics.PLANT_STATE) if at < hurt]
    logged = [at for at, seq in before if seq in written]
    return before[-1][0] - (logged[-1] if logged else before[0][0]) if before else None


def _missing(rig: Rig, witness: Witness, log: Run | None) -> int:
    """Count the ticks that the suite heard before the recorder was hurt and that the log lacks."""
    if log is None:
        return 0
    until = min(_recorder_hurt(rig), rig.ended_at) - 1.0
    heard = {(tick.run_id, tick.seq) for at, tick in witness.of(topics.TICK) if at < until}
    return len(heard - {(tick.run_id, tick.seq) for tick in log.ticks})


# -- what the processes said --------------------------------------------------


def _counted(witness: Witness) -> dict[str, int]:
    """Return the last counters of each process: refused messages and overflows."""
    last: dict[str, m.Health] = {}
    for process in topics.PROCESSES:
        for _, health in witness.health(process):
            if health.run_id not in last or health.seq > last[health.run_id].seq:
                last[health.run_id] = health
    found: Counter[str] = Counter()
    for health in last.values():
        for name, count in health.counters.items():
            if name.startswith(("bad_", "overflow_", "not_sent_", "bulk_overflow")):
                found[f"{health.process} {name}"] += count
    return dict(found)


def _view(rig: Rig) -> str:
    """Return what `tandem run` would have shown of the recorder when the run ended."""
    monitor = Monitor(rig.config, get_plant(rig.config.plant.model), 1.0)
    prefix = topics.everything(rig.config.name).removesuffix("**")
    for heard in rig.heard:
        if heard.at < rig.ended_at and heard.topic == topics.HEALTH["recorder"].name:
            monitor.feed(Delivery(prefix + heard.topic, heard.payload, int(heard.at * 1e9)))
    console = Console(width=160, file=io.StringIO(), record=True)
    console.print(render(monitor.snapshot(rig.ended_at), 160, 60))
    lines = (line.strip(" │") for line in console.export_text().splitlines())
    found = next((line for line in lines if line.startswith("recorder")), "")
    return " ".join(found.replace(str(rig.folder), "").split())


def _said(rig: Rig, witness: Witness) -> list[str]:
    notes = {
        f"{p}: {health.note}" for p in topics.PROCESSES for _, health in witness.health(p) if health.note
    }
    return sorted(note.replace(str(rig.folder), "") for note in notes)[:20]
