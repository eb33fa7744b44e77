"""The plottable view of each message: flat JSON with a JSON schema, vectors under the plant's own names.

Weights are summarised by their norms, and a keyframe has no view. What a message lacks (no input was applied,
no estimate yet) is left out rather than null, since plotting tools skip absent fields and choke on others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from lbmpc.plants import Plant
from protocol import messages as m
from protocol import topics
from protocol.codec import BadMessage
from protocol.topics import Topic

Json = dict[str, Any]
NUMBER: Json = {"type": "number"}
INTEGER: Json = {"type": "integer"}
TEXT: Json = {"type": "string"}
YES_NO: Json = {"type": "boolean"}
NUMBERS: Json = {"type": "object", "additionalProperties": NUMBER}
INTEGERS: Json = {"type": "object", "additionalProperties": INTEGER}
TEXTS: Json = {"type": "object", "additionalProperties": TEXT}


def table(required: Json, optional: Json | None = None) -> Json:
    """JSON schema of an object; `optional` fields may be absent."""
    return {
        "type": "object",
        "properties": {**required, **(optional or {})},
        "required": list(required),
        "additionalProperties": False,
    }


@dataclass(frozen=True)
class View:
    """How one topic is shown: the schema, and the function from a decoded message to a JSON object."""

    topic: Topic
    schema: Json
    _render: Callable[[Any], Json]

    def render(self, message: m.Message) -> bytes:
        """JSON text of one message.

        Raises:
            BadMessage: a vector's length is not the plant's, or a number is not finite.
        """
        try:
            shown = {"run_id": message.run_id, "seq": message.seq, **self._render(message)}
        except ValueError as error:
            raise BadMessage(self.topic.name, "wrong size", str(error)) from error
        return msgspec.json.encode(shown)


def views(plant: Plant) -> dict[str, View]:
    """The views of all topics that have one, by topic name."""
    x = table(dict.fromkeys(plant.states, NUMBER))
    u = table(dict.fromkeys(plant.inputs, NUMBER))
    states, inputs = plant.states, plant.inputs

    def plant_state(s: m.PlantState) -> Json:
        return _present(
            t=s.t,
            x=_named(states, s.x),
            applied=_named(inputs, s.applied),
            source=s.source,
            command_seq=s.command_seq,
        )

    def command(c: m.Command) -> Json:
        return {
            "state_run_id": c.state_run_id,
            "state_seq": c.state_seq,
            "period": c.period,
            "mode": c.mode,
            "u": _named(inputs, c.u),
            "plan_entries": len(c.plan),
        }

    def tick(t: m.Tick) -> Json:
        return _present(
            slot=t.slot,
            t=t.t,
            skipped=t.skipped,
            lateness=t.lateness,
            late=t.late,
            state_verdict=t.state_verdict,
            state_seq=None if t.state is None else t.state.seq,
            x=None if t.state is None else _named(states, t.state.x),
            weights_version=None if t.weights is None else t.weights.seq,
        )

    def result(r: m.TickResult) -> Json:
        return _present(
            x=_named(states, r.x) if r.x else None,
            u=_named(inputs, r.u),
            mode=r.mode,
            status=r.status,
            iterations=r.iterations,
            slack=r.slack,
            slack_row=r.slack_row,
            h=_named(states, r.h),
            h_hat=_named(states, r.h_hat),
            prediction_error=r.prediction_error,
            oracle_norms=_named(states, r.oracle_norms) if r.oracle_norms else None,
            hidden_version=r.hidden_version,
            hidden_sha256=r.hidden_sha256,
            weights_verdict=r.weights_verdict,
            set_margin=r.set_margin,
            set_piece=None if r.set_margin is None else r.set_piece,
        )

    def sets(s: m.CertifiedSets) -> Json:
        return {"kind": s.kind, "sha256": s.sha256}

    def samples(s: m.Samples) -> Json:
        if not s.samples:
            return {"count": 0}
        last = s.samples[-1]
        named = {"x": _named(states, last.x), "u": _named(inputs, last.u), "h": _named(states, last.h)}
        return {"count": len(s.samples), **named}

    def output_weights(w: m.OutputWeights) -> Json:
        K = w.K.numpy()
        norms = np.linalg.norm(K, axis=0)
        return {
            "hidden_version": w.hidden_version,
            "hidden_sha256": w.hidden_sha256,
            "norm": float(np.linalg.norm(K)),
            "column_norms": _named(states, norms.tolist()),
        }

    def hidden_weights(w: m.HiddenWeights) -> Json:
        norms = {f"W_{i}": float(np.linalg.norm(layer.numpy())) for i, layer in enumerate(w.layers, 1)}
        fields = ("for_run", "trained_on", "base_sha256", "samples", "loss_before", "loss_after", "sha256")
        return {**{name: getattr(w, name) for name in fields}, "layer_norms": norms}

    def run_info(r: m.RunInfo) -> Json:
        fields = ("process", "versions", "seed", "units", "unix_time")
        return {name: getattr(r, name) for name in fields}

    def health(h: m.Health) -> Json:
        return {"process": h.process, "status": h.status, "counters": h.counters, "note": h.note}

    def timing(t: m.TickTiming) -> Json:
        return {name: getattr(t, name) for name in ("solve_ms", "tick_ms", "lateness_ms", "state_age_ms")}

    weights = {"hidden_version": INTEGER, "hidden_sha256": TEXT}
    rows: list[tuple[Topic, Callable[[Any], Json], Json, Json]] = [
        (
            topics.PLANT_STATE,
            plant_state,
            {"t": NUMBER, "x": x, "source": TEXT, "command_seq": INTEGER},
            {"applied": u},
        ),
        (
            topics.COMMAND,
            command,
            {
                "state_run_id": TEXT,
                "state_seq": INTEGER,
                "period": NUMBER,
                "mode": TEXT,
                "u": u,
                "plan_entries": INTEGER,
            },
            {},
        ),
        (
            topics.TICK,
            tick,
            {
                "slot": INTEGER,
                "t": NUMBER,
                "skipped": INTEGER,
                "lateness": NUMBER,
                "late": YES_NO,
                "state_verdict": TEXT,
            },
            {"state_seq": INTEGER, "x": x, "weights_version": INTEGER},
        ),
        (
            topics.RESULT,
            result,
            {
                "u": u,
                "mode": TEXT,
                "status": TEXT,
                "iterations": INTEGER,
                "slack": NUMBER,
                "slack_row": TEXT,
                **weights,
                "weights_verdict": TEXT,
            },
            {
                **{"x": x, "h": x, "h_hat": x, "prediction_error": NUMBER, "oracle_norms": x},
                **{"set_margin": NUMBER, "set_piece": INTEGER},
            },
        ),
        (topics.SETS, sets, {"kind": TEXT, "sha256": TEXT}, {}),
        (
            topics.TIMING,
            timing,
            {"solve_ms": NUMBER, "tick_ms": NUMBER, "lateness_ms": NUMBER, "state_age_ms": NUMBER},
            {},
        ),
        (topics.SAMPLES, samples, {"count": INTEGER}, {"x": x, "u": u, "h": x}),
        (topics.OUTPUT_WEIGHTS, output_weights, {**weights, "norm": NUMBER, "column_norms": x}, {}),
        (
            topics.HIDDEN_WEIGHTS,
            hidden_weights,
            {
                "for_run": TEXT,
                "trained_on": INTEGER,
                "base_sha256": TEXT,
                "samples": INTEGER,
                "loss_before": NUMBER,
                "loss_after": NUMBER,
                "sha256": TEXT,
                "layer_norms": NUMBERS,
            },
            {},
        ),
    ]
    info = {"process": TEXT, "versions": TEXTS, "seed": INTEGER, "units": TEXTS, "unix_time": NUMBER}
    rows += [(topic, run_info, info, {}) for topic in topics.RUN_INFO.values()]
    state = {"process": TEXT, "status": TEXT, "counters": INTEGERS, "note": TEXT}
    rows += [(topic, health, state, {}) for topic in topics.HEALTH.values()]
    return {
        topic.name: View(topic, _titled(topic, required, optional), render)
        for topic, render, required, optional in rows
    }


def _titled(topic: Topic, required: Json, optional: Json) -> Json:
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"{topic.type.__name__} (view)",
        **table({"run_id": TEXT, "seq": INTEGER, **required}, optional),
    }


def _named(names: Sequence[str], values: Sequence[float] | None) -> dict[str, float] | None:
    if values is None:
        return None
    if len(names) != len(values):
        raise ValueError(f"{len(values)} entries where the plant has {len(names)} ({', '.join(names)})")
    return dict(zip(names, values, strict=True))


def _present(**fields: Any) -> Json:
    """Without what is None; NaN and infinity are not JSON and count as absent too."""
    return {
        name: value
        for name, value in fields.items()
        if value is not None and not (isinstance(value, float) and not math.isfinite(value))
    }
