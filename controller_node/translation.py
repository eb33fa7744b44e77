"""Translates between messages in plant units and deviations, for the inputs and outputs of a tick."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from msgspec import UNSET

from controller_node.asked import RefusedReference, change_of, source_of, verdict_on
from lbmpc.controller.backup_policy import Policy
from lbmpc.controller.signals import Observation, StepResult
from lbmpc.oracles.base import HiddenSet, LearnedNetwork
from lbmpc.plants import Description
from lbmpc.references import Change
from lbmpc.targets import SteadyState
from protocol import messages as m
from protocol.codec import encode


@dataclass(frozen=True)
class Outputs:
    """Everything one tick produces; `sample` and `output_weights` may be None."""

    command: m.Command
    result: m.TickResult
    sample: m.Sample | None
    new_network: bool
    """Whether the hidden layers in use change with this tick."""
    _weights: Callable[[], m.OutputWeights] | None

    @cached_property
    def output_weights(self) -> m.OutputWeights | None:
        """The output weights, created on first use because a fast loop sends them at few ticks."""
        return None if self._weights is None else self._weights()


@dataclass(frozen=True, eq=False)
class Translation:
    """The translation for one run of one controller."""

    run_id: str
    """Written into every message."""
    plant: Description
    period: float
    """Seconds."""

    def observation(self, tick: m.Tick) -> Observation:
        """Return the controller's observation of a tick."""
        state = tick.state if tick.state_verdict == "fresh" else None
        hidden = None
        if tick.weights is not None:
            layers = [array.numpy().astype(float) for array in tick.weights.layers]
            weights = tick.weights
            # The label of the sample before this tick's own is complete now.
            later = None if weights.newest is UNSET else max(0, tick.seq - 1 - weights.newest)
            hidden = HiddenSet(weights.seq, layers, weights.sha256, weights.network_sha256, later)
        asked = self._asked(tick)
        if state is None:
            return Observation(
                None, None, 0, -1, hidden, truth=tick.truth, reference=asked, skipped=tick.skipped
            )
        applied = None if state.applied is None else np.array(state.applied) - self.plant.u_e
        pieces = tuple((piece.seconds, np.array(piece.u) - self.plant.u_e) for piece in state.pieces)
        total = sum(seconds for seconds, _u in pieces)
        if pieces and not math.isclose(total, self.period, rel_tol=1e-3):
            # Part of the period is not reported, so its mean is unknown. The present input is known.
            applied = None
        x = np.array(state.x) - self.plant.x_e
        if state.missing:
            x[[name in state.missing for name in self.plant.states]] = math.nan
        source = source_of(state.run_id)
        return Observation(x, applied, source, state.seq, hidden, pieces, tick.truth, asked, tick.skipped)

    def _asked(self, tick: m.Tick) -> Change | None:
        """Return the change that the tick's reference requests; None without one, or if it is refused."""
        if tick.reference is UNSET:
            return None
        try:
            return change_of(tick.reference, self.plant, self.period)
        except RefusedReference:
            return None

    def outputs(
        self, tick: m.Tick, result: StepResult, network: LearnedNetwork | None, hidden_sha256: str
    ) -> Outputs:
        """Return the messages of a step.

        Args:
            tick: the step's input.
            result: the step's result.
            network: the oracle's network after the step.
            hidden_sha256: hash of that network's hidden layers; empty without one.
        """
        command = self._command(tick, result)
        return Outputs(
            command,
            self._result(tick, command, result, network, hidden_sha256),
            self._sample(tick, result),
            result.new_network,
            None if network is None else self._weights(tick, network, hidden_sha256),
        )

    def backup(self, policy: Policy, command: m.Command) -> m.Backup:
        """Return a policy in plant units that starts one period after `command`."""
        inputs = policy.inputs + self.plant.u_e - policy.gain @ self.plant.x_e
        return m.Backup(
            run_id=self.run_id,
            seq=command.seq,
            period=self.period,
            gain=policy.gain.tolist(),
            inputs=inputs.tolist(),
        )

    def _command(self, tick: m.Tick, result: StepResult) -> m.Command:
        plan = result.plan + self.plant.u_e
        return m.Command(
            run_id=self.run_id,
            seq=tick.seq,
            state_run_id=tick.state.run_id if tick.state else "",
            state_seq=tick.state.seq if tick.state and tick.state_verdict == "fresh" else -1,
            period=self.period,
            mode=result.mode,
            u=plan[0].tolist(),
            plan=plan.tolist(),
        )

    def _result(
        self,
        tick: m.Tick,
        command: m.Command,
        result: StepResult,
        network: LearnedNetwork | None,
        hidden_sha256: str,
    ) -> m.TickResult:
        solution, label = result.solution, result.label
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
            oracle_norms=[] if network is None else [_norm(column) for column in network.K.T],
            hidden_version=-1 if network is None else network.version,
            hidden_sha256=hidden_sha256,
            tick_crc32=zlib.crc32(encode(tick)),
            input_delay=result.delay,
            weights_verdict=m.weights_verdict(*result.verdict),
            set_margin=result.first.margin if result.first else None,
            set_piece=result.first.piece if result.first else -1,
            weights_rolled_back=result.rolled_back,
            sensor_faults=result.sensor_faults,
            **self._target(result.target),
            **self._judged(tick),
            **dict(zip(("weight", "constant_weight"), result.weights.tolist(), strict=False)),
            deviation=result.deviation.tolist(),
            noise=result.noise.tolist(),
        )

    def _judged(self, tick: m.Tick) -> dict[str, Any]:
        """Return the fields of a `TickResult` that answer the sender of a reference."""
        if tick.reference is UNSET:
            return {}
        verdict = verdict_on(tick.reference, self.plant, self.period)
        return {"reference_verdict": verdict, "reference_from": tick.reference.run_id}

    def _target(self, target: SteadyState | None) -> dict[str, Any]:
        """Return the fields of a `TickResult` about the target."""
        if target is None:
            return {}
        x, u = target.xu[: self.plant.d] + self.plant.x_e, target.xu[self.plant.d :] + self.plant.u_e
        return {
            "target_status": target.status,
            "target_x": x.tolist(),
            "target_u": u.tolist(),
            "target_distance": target.distance,
            "reference": {
                self.plant.states[i]: float(r + self.plant.x_e[i])
                for i, r in zip(target.outputs, target.r, strict=True)
            },
        }

    def _sample(self, tick: m.Tick, result: StepResult) -> m.Sample | None:
        label = result.label
        if label is None:
            return None
        # The label of tick t is complete at tick t + 1.
        x, u, h, past = label.x.tolist(), label.u.tolist(), label.h.tolist(), label.past.tolist()
        variance = label.variance.tolist() if label.variance.any() else []
        return m.Sample(tick.seq - 1, x, u, h, past, variance)

    def _weights(
        self, tick: m.Tick, network: LearnedNetwork, hidden_sha256: str
    ) -> Callable[[], m.OutputWeights]:
        return lambda: m.OutputWeights(
            run_id=self.run_id,
            seq=tick.seq,
            hidden_version=network.newest,
            hidden_sha256=hidden_sha256,
            K=m.Array.of(network.K),
        )


def _norm(vector: np.ndarray) -> float:
    """Return the Euclidean norm. numpy's function takes ten times as long on such short vectors."""
    return math.sqrt(vector.dot(vector))
