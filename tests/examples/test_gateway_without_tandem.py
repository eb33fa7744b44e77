"""The gateway without Tandem's code follows the rules of Tandem's gateway, and drives the compressor live."""

from __future__ import annotations

import ast
import math
import runpy
import sys
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from lbmpc.plants import Plant, Truth, get_plant
from node_runtime.bus.inbox import Follower
from node_runtime.config.sections import Config
from plant_sim.simulator import PlantSim
from protocol import codec, topics
from protocol import messages as m
from tests.helpers.paths import ROOT

FILE = ROOT / "examples" / "gateway_without_tandem.py"
EXAMPLE = runpy.run_path(str(FILE))
COMPRESSOR = get_plant("moore_greitzer")
TAME = replace(
    COMPRESSOR,
    rhs=lambda x, u: [u[0] - x[0], x[0] - x[1], x[1] - x[2], x[2] - x[3]],
    positive=(),
    safe_gain=None,
)
"""A plant of the compressor's size that stays bounded for any input."""
CONFIG = Config()
PERIOD, PATIENCE, SILENCE = CONFIG.period, CONFIG.plant.plan_patience, CONFIG.bus.follow_silence
RUN = "plant-a"


class Machine:
    """The machine interface of the example, moved by Tandem's simulation."""

    def __init__(self, plant: Plant) -> None:
        self.truth, self.x, self.u, self.t = Truth(plant), plant.x0, None, 0.0

    def read(self, t: float) -> list[float]:
        if self.u is not None and t > self.t:
            self.x = self.truth.step(self.x, np.array(self.u), t - self.t)
        self.t = t
        return self.x.tolist()

    def write(self, u: list[float], t: float) -> None:
        self.read(t)
        self.u = u

    def safe(self, t: float) -> list[float]:
        return TAME.safe_input.tolist()


class Foreign:
    """Run the example's gateway in virtual time."""

    def __init__(self, machine: Any) -> None:
        self.gateway = EXAMPLE["Gateway"](machine, RUN, 0.0)

    def command(self, payload: bytes, t: float) -> str:
        self._until(t)
        before = self.gateway.refused.copy()
        self.gateway.receive(payload, t, t)
        (refused,) = (self.gateway.refused - before) or ("bad_controller_command_ok",)
        return refused.removeprefix("bad_controller_command_").replace("_", " ")

    def sample(self, t: float) -> m.PlantState:
        self._until(t)
        assert self.gateway.due() == pytest.approx(t)
        payload = msgspec.msgpack.encode(self.gateway.sample())
        state = codec.decode(topics.PLANT_STATE, payload)
        assert isinstance(state, m.PlantState)
        codec.check_dimensions(topics.PLANT_STATE, state, TAME.d, TAME.m)
        return state

    def miss(self) -> None:
        self.gateway.seq += 1

    def _until(self, t: float) -> None:
        while self.gateway.switch < t - 1e-9:
            self.gateway.act(self.gateway.switch)


class Own:
    """Run Tandem's gateway in virtual time, with the checks of its inbox before it."""

    def __init__(self) -> None:
        self.sim = PlantSim(TAME, Truth(TAME), PERIOD, TAME.x0, PATIENCE, RUN)
        self.follower = Follower(SILENCE)

    def command(self, payload: bytes, t: float) -> str:
        try:
            command = codec.decode(topics.COMMAND, payload)
            codec.check_dimensions(topics.COMMAND, command, TAME.d, TAME.m)
        except codec.BadMessage as error:
            return error.reason
        assert isinstance(command, m.Command)
        verdict = self.follower.accept(command.run_id, command.seq, t)
        return verdict if verdict != "ok" else self.sim.command(command, t)

    def sample(self, t: float) -> m.PlantState:
        return self.sim.sample(t)


def some_command(rng: np.random.Generator, seq: int, state_seq: int) -> bytes:
    """Return a command: mostly a valid one, sometimes one that must be refused."""
    plan = [[float(u)] for u in TAME.u_e + rng.uniform(-0.3, 0.3, rng.integers(1, 5))]
    fields: dict[str, Any] = {
        "run_id": "controller-a",
        "seq": seq,
        "state_run_id": RUN,
        "state_seq": state_seq,
        "period": PERIOD,
        "mode": "solver",
        "u": plan[0],
        "plan": plan,
    }
    wrong: dict[str, Any] = [
        {"run_id": "controller-b"},
        {"seq": seq - 3},
        {"state_run_id": "plant-b"},
        {"state_seq": state_seq + 9},
        {"state_seq": max(0, state_seq - 4)},
        {"state_seq": -1},
        {"period": 2 * PERIOD},
        {"plan": [[1.0], [1.0, 1.0]]},
        {"plan": [[1.0], [math.nan]]},
        {"plan": []},
        {"plan": [[1.0], [math.inf]]},
        {"plan": "a plan"},
        {"u": [99.0], "plan": [[99.0], [-99.0]]},
    ][rng.integers(13)]
    if rng.random() < 0.3:
        fields |= wrong
    payload = msgspec.msgpack.encode(fields)
    return payload[:-3] if rng.random() < 0.05 else payload


@pytest.mark.parametrize("seed", range(4))
def test_it_refuses_and_applies_what_tandems_own_gateway_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    own, foreign = Own(), Foreign(Machine(TAME))
    verdicts, sources = set(), set()
    seq, newest, silent_until = 0, 0, 0
    for k in range(400):
        t = k * PERIOD
        if k and rng.random() < 0.03:
            foreign.miss()
        else:
            ours, theirs = own.sample(t), foreign.sample(t)
            newest = ours.seq
            sources.add(ours.source)
            assert (theirs.run_id, theirs.seq, theirs.source) == (ours.run_id, ours.seq, ours.source)
            assert (theirs.t, theirs.command_seq) == (pytest.approx(ours.t), ours.command_seq)
            assert theirs.x == pytest.approx(ours.x, abs=1e-8)
            assert theirs.applied == (ours.applied and pytest.approx(ours.applied, abs=1e-9))
            pieces = ours.pieces
            if not pieces and ours.applied is not None:
                pieces = [m.Piece(PERIOD, ours.applied)]
            assert acted(theirs.pieces) == pytest.approx(acted(pieces), abs=1e-9)
        if k < silent_until:
            continue
        if rng.random() < 0.03:
            silent_until = k + int(rng.integers(1, 30))
        for at in sorted(rng.uniform(0.01, 0.99, rng.integers(0, 3))):
            seq += 1
            payload, arrived = some_command(rng, seq, newest), t + float(at) * PERIOD
            verdict = own.command(payload, arrived)
            assert foreign.command(payload, arrived) == verdict
            verdicts.add(verdict)
    assert sources == {"hold", "command", "plan", "safe"}
    refusals = {"malformed", "not finite", "wrong size", "foreign", "out of order", "wrong period"}
    assert verdicts == refusals | {"ok", "answers no sample", "stale"}


ODD: list[Any] = [None, True, -1, 2**63, 1e308, math.nan, "x", b"x", [], [[]], ["x"], [[b"x"]], [[[1.0]]]]
ODD += [{}, {"x": 1.0}, {b"x": 1.0}, [{1: 1.0}], [1.0], [[1e308], [-1e308]], "x" * 10_000]


@pytest.mark.parametrize("odd", ODD, ids=lambda odd: repr(odd)[:20])
def test_no_message_stops_the_monitor(odd: Any) -> None:
    good = msgspec.msgpack.decode(some_command(np.random.default_rng(2), 0, 0))
    payloads = [msgspec.msgpack.encode(odd), msgspec.msgpack.encode(odd) * 2]
    for key in good:
        payloads.append(msgspec.msgpack.encode(good | {key: odd}))
        payloads.append(msgspec.msgpack.encode({name: good[name] for name in good if name != key}))
    whole = msgspec.msgpack.encode(good)
    payloads += [whole[:length] + msgspec.msgpack.encode(odd) for length in range(len(whole))]
    for payload in payloads:
        foreign = Foreign(EXAMPLE["Compressor"]())
        foreign.sample(0.0)
        foreign.command(payload, 0.2 * PERIOD)
        for k in range(1, 5):
            assert all(math.isfinite(value) for value in foreign.sample(k * PERIOD).x)


def acted(pieces: list[m.Piece]) -> list[float]:
    """Return duration and value of each interval with a constant input."""
    merged: list[list[float]] = []
    for piece in pieces:
        if merged and piece.u == merged[-1][1:]:
            merged[-1][0] += piece.seconds
        else:
            merged.append([piece.seconds, *piece.u])
    return [number for one in merged for number in one]


def test_it_uses_no_code_of_tandem() -> None:
    tree = ast.parse(FILE.read_text(encoding="utf-8"))
    names = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    names |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert names - sys.stdlib_module_names == {"msgpack", "zenoh"}


def test_its_equations_are_the_compressors() -> None:
    ours, theirs = Machine(COMPRESSOR), EXAMPLE["Compressor"]()
    for machine in (ours, theirs):
        machine.write([1.0], 0.0)
    assert theirs.read(1.0) == pytest.approx(ours.read(1.0), abs=2e-3)
