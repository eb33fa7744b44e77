"""The catalogue of faults: what each does to a run, and which checks must pass. Each fault is one row of the table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

from verification.faults import holds
from verification.faults.holds import Held
from verification.faults.processes import scenes
from verification.faults.processes.link import Shape
from verification.faults.processes.rig import Place, Rig
from verification.faults.processes.scenes import Scene
from verification.faults.strangers import stranger
from verification.faults.strangers.attacker import KINDS, WEIGHTS

ATTACK_RATE, WEIGHTS_RATE = 1000.0, 4.0
"""Messages a second."""
ATTACK_S, KNOCKS_S = 4.0, 2.0
RESTART_PATIENCE_S = 20.0
"""Seconds. A busy machine takes long to start a process; measurements begin after the start."""
Inflict = Callable[[Rig, int], dict[str, float] | None]
"""Injects the fault when it is called, with the run's seed. It may let the run continue meanwhile."""
LINK = "plant's link"
KILLABLE = ("trainer", "recorder", "router", "controller", LINK)


@dataclass(frozen=True)
class Stage:
    """The scene of a run. Runs with and without a fault are compared in the same scene."""

    name: str
    plant: Place = "veth"
    trainer: Place = "loopback"
    settings: tuple[str, ...] = ()
    seconds: float = 10.0
    """Length of a run, counted from the first command, in seconds."""
    set_points: tuple[tuple[float, float], ...] = ()
    """Set-points of y from the first command on: seconds, and plant units."""


USUAL = Stage("usual")
FAR = Stage("trainer behind a link", trainer="wire")
LED = Stage("moving reference", set_points=((0.0, 1.6875), (4.0, 1.75), (10.0, 1.65)))


@dataclass(frozen=True)
class Fault:
    """One row of the table."""

    name: str
    group: str
    """Row of the specification to which the fault belongs."""
    inflict: Inflict
    holds: tuple[Held, ...]
    stage: Stage = USUAL
    span: float = 0.0
    """Duration of the fault, in seconds."""
    after: float = 4.5
    """Duration of the run after the fault, in seconds."""
    scene: Scene = scenes.nothing
    """Environment of the run."""


def _kill(*names: str) -> Inflict:
    def inflict(rig: Rig, _seed: int) -> None:
        processes = [name for name in names if name in rig.processes]
        if processes:
            rig.kill(*processes)
        if len(processes) < len(names):
            # Longer than the lease: the router drops the plant's link, and both must connect again.
            rig.shape("plant", Shape(cut=True), 2.0)
        rig.await_restarted(RESTART_PATIENCE_S)

    return inflict


def _kill_row(*names: str) -> Fault:
    checks: list[Held] = [holds.constraints, holds.control_back, holds.punctual]
    if "recorder" in names:
        checks.append(holds.readable)
    else:
        checks.append(holds.replays)
    killed = " and ".join(name for name in names if name != LINK)
    words = [f"kill -9 of {killed}"] if killed else []
    words += ["plant's link cut for 2 s"] if LINK in names else []
    return Fault(", ".join(words), "kill", _kill(*names), tuple(checks), span=3.5, after=2.0)


def _led_row() -> Fault:
    """The controller is down while the reference moves; afterwards it continues along the reference."""
    row = _kill_row("controller")
    return replace(row, name=f"{row.name}, moving reference", holds=(*row.holds, holds.still_led), stage=LED)


def _freeze_row(seconds: float) -> Fault:
    def inflict(rig: Rig, _seed: int) -> None:
        rig.freeze("controller", seconds)

    return Fault(
        f"SIGSTOP of the controller, {seconds:g} s",
        "freeze",
        inflict,
        (
            holds.constraints,
            holds.control_back,
            holds.no_burst,
            holds.plan_then_safe,
            holds.punctual,
            holds.replays,
        ),
        span=seconds,
    )


def _link_row(what: str, shape: Shape, seconds: float) -> Fault:
    def inflict(rig: Rig, _seed: int) -> None:
        rig.shape("trainer", shape, seconds)

    return Fault(
        f"trainer's link: {what}",
        "trainer's link",
        inflict,
        (holds.constraints, holds.punctual, holds.merged, holds.replays),
        FAR,
        span=seconds,
    )


def _full_disk_row() -> Fault:
    def inflict(rig: Rig, _seed: int) -> None:
        scenes.fill(rig.folder)
        rig.note("the disk is full", "disk")

    checks = (holds.constraints, holds.control_kept, holds.punctual, holds.readable, holds.view_says)
    return Fault("disk full", "disk", inflict, checks, scene=scenes.memory_disk)


def _room_again_row() -> Fault:
    def inflict(rig: Rig, _seed: int) -> None:
        scenes.fill(rig.folder)
        rig.note("the disk is full", "disk")
        rig.run_for(2.0)
        scenes.empty(rig.folder)
        rig.note("that is over", whole_again=True)

    checks = (holds.constraints, holds.control_kept, holds.punctual, holds.whole, holds.view_said)
    return Fault("disk full for 2 s", "disk", inflict, checks, scene=scenes.memory_disk, span=2.0)


def _read_only_row() -> Fault:
    def inflict(rig: Rig, _seed: int) -> None:
        scenes.write_protect(rig.folder)
        rig.note("the disk is read-only", "disk")

    checks = (holds.constraints, holds.control_kept, holds.punctual, holds.readable, holds.view_says)
    return Fault("disk read-only", "disk", inflict, checks, scene=scenes.real_disk)


def _attack_row(kind: str) -> Fault:
    def inflict(rig: Rig, seed: int) -> dict[str, float]:
        return rig.attack(kind, ATTACK_RATE, ATTACK_S, seed)

    checks = (
        holds.constraints,
        holds.none_obeyed,
        holds.all_counted,
        holds.as_fast,
        holds.control_kept,
        holds.as_good,
        holds.replays,
    )
    return Fault(
        f"{ATTACK_RATE:g} messages/s: {kind}", "messages", inflict, checks, span=ATTACK_S + 1.5, after=2.0
    )


def _weights_row(kind: str) -> Fault:
    def inflict(rig: Rig, seed: int) -> dict[str, float]:
        return rig.attack(f"weights: {kind}", WEIGHTS_RATE, ATTACK_S, seed)

    checks = (holds.constraints, holds.weights_refused, holds.as_good, holds.punctual, holds.replays)
    return Fault(f"weights: {kind}", "weights", inflict, checks, span=ATTACK_S + 1.5, after=2.0)


def _clock_row(hours: float) -> Fault:
    def inflict(rig: Rig, _seed: int) -> None:
        scenes.step_clock(rig.folder, hours * 3600.0)
        rig.note("the wall clock was stepped")

    checks = (
        holds.constraints,
        holds.control_kept,
        holds.punctual,
        holds.whole,
        holds.as_good,
        holds.log_time,
    )
    return Fault(f"wall clock stepped by {hours:+g} h", "clock", inflict, checks, scene=scenes.own_wall_clock)


def _door_row(kind: str) -> Fault:
    def inflict(rig: Rig, _seed: int) -> dict[str, float]:
        return rig.knock(kind, rig.folder / scenes.KEYS, KNOCKS_S)

    checks = (
        holds.constraints,
        holds.refused_on_both_sides,
        holds.none_obeyed,
        holds.control_kept,
        holds.replays,
    )
    return Fault(f"certificate: {kind}", "certificates", inflict, checks, scene=scenes.door_with_certificates)


ALL: tuple[Fault, ...] = (
    *(_kill_row(name) for name in KILLABLE),
    *(_kill_row(*pair) for pair in combinations(KILLABLE, 2)),
    _led_row(),
    *(_freeze_row(seconds) for seconds in (0.2, 1.0, 3.0)),
    *(_link_row(f"cut for {seconds:g} s", Shape(cut=True), seconds) for seconds in (1.0, 10.0, 60.0)),
    _link_row("5 % loss", Shape(loss=0.05), 6.0),
    _link_row("20 % loss", Shape(loss=0.2), 6.0),
    _link_row("300 ms delay each way", Shape(delay=0.3), 6.0),
    _link_row("1 Mbit/s", Shape(rate=1e6), 6.0),
    _full_disk_row(),
    _room_again_row(),
    _read_only_row(),
    *(_attack_row(kind) for kind in KINDS),
    *(_weights_row(kind) for kind in WEIGHTS),
    *(_door_row(kind) for kind in stranger.KINDS),
    *(_clock_row(hours) for hours in (1.0, -1.0)),
)
BY_NAME = {fault.name: fault for fault in ALL}
