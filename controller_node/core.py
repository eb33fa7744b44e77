"""The controller between messages: a Tick in, its Command and everything else that it implies out.

Deterministic: the outputs are a function of the configuration, the keyframe and the ticks, and of nothing else. The
live node, the lock-step simulation and the replay all call `step` and differ only in where the ticks come from.
"""

from __future__ import annotations

import hashlib
import math
import platform
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import msgspec
import numpy as np

from controller_node.build import build_backup, build_controller, model_for
from controller_node.certified_sets import CertifiedSets, find_sets
from controller_node.codegen.compiler import Compiler
from lbmpc.controller.backup_policy import BackupPlanner
from lbmpc.controller.step import ControllerState, HiddenSet, Observation, Solves, StepResult
from lbmpc.oracles import DnnOracle
from lbmpc.oracles.dnn.oracle import IN_USE, NEWEST
from lbmpc.solver.rows import Box
from lbmpc.solver.solution import Solution
from network_model.description import hash_layers
from node_runtime import provenance
from node_runtime.config.sections import Config
from protocol import messages as m
from protocol.codec import encode

WIRE: dict[str, Literal["<i8", "<f8", "<f4"]] = {"int64": "<i8", "float64": "<f8", "float32": "<f4"}


class _Timed:
    """A solver, and how long its last solve took: for the log, never for a decision."""

    def __init__(self, solver: Solves):
        self._solver = solver
        self.seconds = 0.0

    def solve(
        self,
        x: np.ndarray,
        oracle_parameters: np.ndarray,
        warm_start: np.ndarray,
        *,
        first: Box | None = None,
    ) -> Solution:
        before = time.perf_counter()
        solution = self._solver.solve(x, oracle_parameters, warm_start, first=first)
        self.seconds = time.perf_counter() - before
        return solution

    def prepare(self, x: np.ndarray, oracle_parameters: np.ndarray, warm_start: np.ndarray) -> None:
        self._solver.prepare(x, oracle_parameters, warm_start)

    def feedback(self, x: np.ndarray, first: Box | None = None) -> Solution:
        before = time.perf_counter()
        solution = self._solver.feedback(x, first)
        self.seconds = time.perf_counter() - before
        return solution


@dataclass(frozen=True)
class Outputs:
    """Everything one tick produces; `sample` and `output_weights` are None where there is none."""

    command: m.Command
    result: m.TickResult
    sample: m.Sample | None
    _weights: Callable[[], m.OutputWeights] | None

    @cached_property
    def output_weights(self) -> m.OutputWeights | None:
        """Made when they are asked for: a fast loop sends them at few of its ticks."""
        return None if self._weights is None else self._weights()


class ControllerCore:
    """A controller with its memory.

    Args:
        config: the resolved configuration.
        run_id: stamped on every message; a replay gives the recorded one.
        sets: the certified sets of the tightening `invariant`; None: found by the configuration.

    Raises:
        ConfigError: the configuration admits no controller, and why.
    """

    def __init__(self, config: Config, run_id: str, sets: CertifiedSets | None = None):
        self.config, self.run_id = config, run_id
        self.sets = None
        if config.controller.tightening == "invariant":
            self.sets = find_sets(config, model_for(config)) if sets is None else sets
        compiler = Compiler() if config.controller.solver.compile == "auto" else None
        self.controller = build_controller(config, compiler, self.sets.certificate if self.sets else None)
        self._realise = compiler
        self._backup: BackupPlanner | None = None
        self.kernels = compiler.note if compiler else "virtual machine, as configured"
        self._timed = self.controller.solver = _Timed(self.controller.solver)
        self.plant = self.controller.model.plant
        self.state: ControllerState = self.controller.initial_state(config.seed)
        oracle = self.controller.oracle
        self._dnn = oracle if isinstance(oracle, DnnOracle) else None
        self.description = self._dnn.description if self._dnn else None
        self._hidden_hash = self._hash_hidden()
        self._resumed = ""

    def step(self, tick: m.Tick) -> Outputs:
        """One control step. Never raises for what a tick may hold."""
        self._timed.seconds = 0.0
        seen = self._observe(tick)
        self.state, result = self.controller.step(self.state, seen)
        if result.verdict == "adopted" or result.rolled_back:
            self._hidden_hash = self._hash_hidden()
        command = self._command(tick, result)
        return Outputs(
            command, self._result(tick, command, result), self._sample(tick, result), self._weights(tick)
        )

    def prepare(self) -> None:
        """Use the time until the next tick; see `Controller.prepare`."""
        self.controller.prepare(self.state)

    def backup(self, command: m.Command) -> m.Backup | None:
        """What the plant may follow if no command comes after this one, the last step's; None where there is nothing.

        Nothing else depends on it: who needs it asks.
        """
        policy = self.controller.backup(self._planner(), self.state)
        if policy is None:
            return None
        # From deviations to plant units.
        inputs = policy.inputs + self.plant.u_e - policy.gain @ self.plant.x_e
        return m.Backup(
            run_id=self.run_id,
            seq=command.seq,
            period=self.config.period,
            gain=policy.gain.tolist(),
            inputs=inputs.tolist(),
        )

    def ready_backup(self) -> None:
        """Build now what `backup` would build when it is first called."""
        state = self.controller.initial_state(self.config.seed)
        theta = self.controller.oracle.theta(state.oracle)
        self._planner().policy(state.predicted, theta, state.plan.v)

    def _planner(self) -> BackupPlanner:
        if self._backup is None:
            self._backup = build_backup(self.config, self.controller.problem, self._realise)
        return self._backup

    @property
    def solve_seconds(self) -> float:
        """What the last step's solve took on this machine; 0 where there was none."""
        return self._timed.seconds

    def keyframe(self, seq: int) -> m.Keyframe:
        """The whole memory after tick `seq`, -1 before the first."""
        arrays = {
            name: m.Array.of(array, WIRE[array.dtype.name]) for name, array in self.state.to_arrays().items()
        }
        return m.Keyframe(
            run_id=self.run_id, seq=seq, arrays=arrays, resumed=self._resumed if seq == -1 else ""
        )

    def restore(self, keyframe: m.Keyframe) -> None:
        """Take over a keyframe's memory.

        Raises:
            ValueError: the keyframe does not fit this configuration; the text names the array.
        """
        arrays = {name: array.numpy() for name, array in keyframe.arrays.items()}
        expected = self.state.to_arrays()
        for name in sorted(expected.keys() | arrays.keys()):
            if name not in arrays or name not in expected or arrays[name].shape != expected[name].shape:
                raise ValueError(
                    f"the keyframe of tick {keyframe.seq} does not fit this configuration: array {name}"
                )
        self.state = ControllerState.from_arrays(arrays)
        self._hidden_hash = self._hash_hidden()
        self._resumed = keyframe.resumed

    def lasting(self) -> dict[str, m.Array]:
        """What of the memory outlives this process: all that was learned, nothing that was planned."""
        arrays = self.keyframe(0).arrays
        return {name: array for name, array in arrays.items() if _lasts(name)}

    def go_on(self, lasting: dict[str, m.Array], run_id: str) -> None:
        """Begin with what the run `run_id` left, and no plan; before the first tick.

        Raises:
            ValueError: it does not fit this configuration; the text names the array.
        """
        begin = self.keyframe(-1).arrays
        expected = {name for name in begin if _lasts(name)}
        for name in sorted(expected ^ lasting.keys()):
            raise ValueError(f"array {name} is {'missing' if name in expected else 'not known'}")
        for name in sorted(expected):
            if (lasting[name].shape, lasting[name].dtype) != (begin[name].shape, begin[name].dtype):
                raise ValueError(f"array {name} is {lasting[name].shape} there and {begin[name].shape} here")
        arrays = {**begin, **lasting}
        self.restore(m.Keyframe(run_id=self.run_id, seq=-1, arrays=arrays, resumed=run_id))

    def belongs(self) -> dict[str, str]:
        """Whose memory this is, in words: what must be equal for another process to go on with it."""
        model = self.controller.model
        numbers = b"".join(array.tobytes() for array in (model.A, model.B, self.plant.x_e, self.plant.u_e))
        words = {
            "plant": self.config.name,
            "model": f"{self.plant.name} {hashlib.sha256(numbers).hexdigest()[:12]}",
            "rate": f"{self.config.rate:g} Hz",
            "oracle": self.config.controller.oracle,
        }
        if self.description is not None:
            what = self.description
            layers = "-".join(map(str, what.hidden))
            words["network"] = f"{what.architecture} {layers} {what.sha256()[:12]}"
        return words

    def hidden_snapshot(self, seq: int) -> m.HiddenSnapshot | None:
        """The hidden weights in force, for a trainer that joins late; None without a network."""
        if self._dnn is None or self.description is None:
            return None
        layers = [m.Array.of(layer, "<f4") for layer in self._dnn.hidden(self.state.oracle)]
        return m.HiddenSnapshot(
            run_id=self.run_id,
            seq=seq,
            hidden_version=self._version(NEWEST),
            hidden_sha256=self._hidden_hash,
            description=msgspec.json.encode(self.description).decode(),
            layers=layers,
        )

    def certified_sets(self) -> m.CertifiedSets | None:
        """The sets in force, for the log; None without any."""
        if self.sets is None:
            return None
        return m.CertifiedSets(
            run_id=self.run_id,
            seq=0,
            kind=self.sets.certificate.kind,
            sha256=self.sets.sha256,
            content=self.sets.to_bytes(),
        )

    def run_info(self, unix_time: float) -> m.RunInfo:
        """What a log needs to be replayed on its own."""
        facts = {"machine": platform.machine(), "kernels": self.kernels}
        if self.sets is not None:
            facts |= {"certified sets": self.sets.sha256}
        return provenance.run_info(
            self.config,
            "controller",
            self.run_id,
            self.plant.units,
            packages=provenance.CONTROLLER,
            facts=facts,
            unix_time=unix_time,
        )

    def _observe(self, tick: m.Tick) -> Observation:
        state = tick.state if tick.state_verdict == "fresh" else None
        hidden = None
        if tick.weights is not None:
            layers = [array.numpy().astype(float) for array in tick.weights.layers]
            hidden = HiddenSet(tick.weights.seq, layers, tick.weights.sha256, tick.weights.network_sha256)
        if state is None:
            return Observation(None, None, 0, -1, hidden)
        applied = None if state.applied is None else np.array(state.applied) - self.plant.u_e
        pieces = tuple((piece.seconds, np.array(piece.u) - self.plant.u_e) for piece in state.pieces)
        total = sum(seconds for seconds, _u in pieces)
        if pieces and not math.isclose(total, self.config.period, rel_tol=1e-3):
            # Not the whole period: what acted in the rest of it is not known.
            applied, pieces = None, ()
        x = np.array(state.x) - self.plant.x_e
        return Observation(x, applied, _source(state.run_id), state.seq, hidden, pieces)

    def _command(self, tick: m.Tick, result: StepResult) -> m.Command:
        plan = result.plan + self.plant.u_e
        return m.Command(
            run_id=self.run_id,
            seq=tick.seq,
            state_run_id=tick.state.run_id if tick.state else "",
            state_seq=tick.state.seq if tick.state and tick.state_verdict == "fresh" else -1,
            period=self.config.period,
            mode=result.mode,
            u=plan[0].tolist(),
            plan=plan.tolist(),
        )

    def _result(self, tick: m.Tick, command: m.Command, result: StepResult) -> m.TickResult:
        solution, label = result.solution, result.label
        state = self.state.oracle
        return m.TickResult(
            run_id=self.run_id,
            seq=tick.seq,
            x=list(tick.state.x) if tick.state else [],
            u=command.u,
            mode=result.mode,
            status=str(solution.status) if solution else f"no solve: state {tick.state_verdict}",
            iterations=solution.iterations if solution else 0,
            slack=solution.slack if solution else 0.0,
            slack_row=solution.slack_row if solution else "",
            h=label.h.tolist() if label else None,
            h_hat=label.h_hat.tolist() if label else None,
            prediction_error=_norm(label.h_hat - label.h) if label else None,
            oracle_norms=[_norm(column) for column in state["K"].T] if self._dnn else [],
            hidden_version=self._version(),
            hidden_sha256=self._hidden_hash,
            tick_crc32=zlib.crc32(encode(tick)),
            input_delay=result.delay,
            weights_verdict=result.verdict,
            set_margin=result.first.margin if result.first else None,
            set_piece=result.first.piece if result.first else -1,
            weights_rolled_back=result.rolled_back,
        )

    def _sample(self, tick: m.Tick, result: StepResult) -> m.Sample | None:
        label = result.label
        if label is None:
            return None
        # The label of tick t is complete at tick t + 1.
        x, u, h, past = label.x.tolist(), label.u.tolist(), label.h.tolist(), label.past.tolist()
        return m.Sample(tick.seq - 1, x, u, h, past)

    def _weights(self, tick: m.Tick) -> Callable[[], m.OutputWeights] | None:
        if self._dnn is None:
            return None
        K, version, sha256 = self.state.oracle["K"], self._version(NEWEST), self._hidden_hash
        return lambda: m.OutputWeights(
            run_id=self.run_id, seq=tick.seq, hidden_version=version, hidden_sha256=sha256, K=m.Array.of(K)
        )

    def _version(self, which: int = IN_USE) -> int:
        return int(self.state.oracle["version"][which]) if self._dnn else -1

    def _hash_hidden(self) -> str:
        return hash_layers(self._dnn.hidden(self.state.oracle)) if self._dnn else ""


def _lasts(name: str) -> bool:
    """Whether a new process can go on with this array. Not with a plan, or with a state whose successor it missed."""
    return name == "delay" or name.startswith("oracle.")


@lru_cache(maxsize=16)
def _source(run_id: str) -> int:
    """A number for a run id, the same in every process."""
    return int.from_bytes(hashlib.sha256(run_id.encode()).digest()[:7], "little")


def _norm(vector: np.ndarray) -> float:
    """Euclidean; numpy's own takes ten times as long for so few numbers."""
    return math.sqrt(vector.dot(vector))
