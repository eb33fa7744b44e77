"""The plottable view of each message: flat JSON with a JSON schema, vectors under the plant's own names.

A view is a message's fields, by name, and what is made of others; its JSON and its schema both follow from the
message's own Struct. Weights are summarised by their norms, and a keyframe has no view. What a message lacks (no input
was applied, no estimate yet) is left out rather than null, since plotting tools skip absent fields and choke on others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import inspect

from lbmpc.plants import Description
from protocol import messages as m
from protocol import topics
from protocol.codec import BadMessage
from protocol.topics import Topic

Json = dict[str, Any]
Vector = list[float]
VECTORS = ("x", "oracle_norms", "target_x", "target_u", "weight", "constant_weight", "deviation", "noise")
NAMED_AFTER = dict.fromkeys((*VECTORS, "h", "h_hat", "column_norms"), "states") | dict.fromkeys(
    ("u", "applied", "target_u"), "inputs"
)
"""Of each vector, the plant's attribute that has the names of its entries."""
LACKING = (*VECTORS, "sensor_faults", "reference")
"""What a result has not, where it is empty."""
JSON_TYPES: dict[type[inspect.Type], str] = {
    inspect.FloatType: "number",
    inspect.IntType: "integer",
    inspect.StrType: "string",
    inspect.LiteralType: "string",
    inspect.BoolType: "boolean",
}


def _of_command(command: m.Command) -> Json:
    return {"plan_entries": len(command.plan)}


def _of_tick(tick: m.Tick) -> Json:
    state, weights = tick.state, tick.weights
    shown: Json = {} if state is None else {"state_seq": state.seq, "x": state.x}
    return shown if weights is None else {**shown, "weights_version": weights.seq}


def _of_result(result: m.TickResult) -> Json:
    piece = None if result.set_margin is None else result.set_piece
    aimed = None if result.target_status == "none" else result.target_status
    lacking = {name: getattr(result, name) or None for name in LACKING}
    asked = None if result.reference_verdict == "none" else result.reference_verdict
    return {**lacking, "set_piece": piece, "target_status": aimed, "reference_verdict": asked}


def _of_samples(samples: m.Samples) -> Json:
    """How many there are, and the last of them."""
    last = {name: getattr(sample, name) for sample in samples.samples[-1:] for name in ("x", "u", "h")}
    return {"count": len(samples.samples), **last}


def _of_output_weights(weights: m.OutputWeights) -> Json:
    K = weights.K.numpy()
    # Of a K that is no matrix the norm along its first axis is a number: one entry, which is the wrong size.
    columns = np.atleast_1d(np.linalg.norm(K, axis=0))
    return {"norm": float(np.linalg.norm(K)), "column_norms": columns.tolist()}


def _of_hidden_weights(weights: m.HiddenWeights) -> Json:
    norms = [float(np.linalg.norm(layer.numpy())) for layer in weights.layers]
    newest = None if weights.newest is msgspec.UNSET else weights.newest
    return {"newest": newest, "layer_norms": {f"W_{i}": norm for i, norm in enumerate(norms, 1)}}


class Shown(NamedTuple):
    """What is shown of one kind of message."""

    fields: str
    """Their names, in this order, after run_id and seq."""
    made: Callable[[Any], Json] = lambda _message: {}
    """The values of those that the message does not have, or has otherwise; None, or none at all, of what it lacks."""
    types: Mapping[str, Any] = {}
    """Of those, where the message's own are not right."""


SHOWN: dict[type[m.Message], Shown] = {
    m.PlantState: Shown("t x applied source command_seq"),
    m.Command: Shown("state_run_id state_seq period mode u plan_entries", _of_command, {"plan_entries": int}),
    m.Tick: Shown(
        "slot t skipped lateness late state_verdict state_seq x weights_version",
        _of_tick,
        {"state_seq": int | None, "x": Vector | None, "weights_version": int | None},
    ),
    m.TickResult: Shown(
        "x u mode status iterations slack slack_row h h_hat prediction_error oracle_norms hidden_version "
        "hidden_sha256 weights_verdict set_margin set_piece target_status target_x target_u target_distance "
        "sensor_faults reference reference_verdict weight constant_weight deviation noise",
        _of_result,
        {
            **dict.fromkeys(VECTORS, Vector | None),
            "set_piece": int | None,
            "target_status": m.TargetStatus | None,
            "sensor_faults": dict[str, str] | None,
            "reference": dict[str, float] | None,
            "reference_verdict": str | None,
        },
    ),
    m.TickTiming: Shown("solve_ms tick_ms lateness_ms state_age_ms"),
    m.Samples: Shown(
        "count x u h", _of_samples, {"count": int, **dict.fromkeys(("x", "u", "h"), Vector | None)}
    ),
    m.OutputWeights: Shown(
        "hidden_version hidden_sha256 norm column_norms",
        _of_output_weights,
        {"norm": float, "column_norms": Vector},
    ),
    m.HiddenWeights: Shown(
        "for_run trained_on newest base_sha256 samples loss_before loss_after sha256 layer_norms",
        _of_hidden_weights,
        {"newest": int | None, "layer_norms": dict[str, float]},
    ),
    m.Override: Shown("mode u lease", lambda override: {"u": override.u or None}, {"u": Vector | None}),
    m.CertifiedSets: Shown("kind sha256"),
    m.RunInfo: Shown("process versions seed units unix_time"),
    m.Health: Shown("process status counters note"),
}


class View:
    """How one topic is shown for one plant."""

    def __init__(self, topic: Topic, plant: Description):
        self.topic = topic
        shown = SHOWN[topic.type]
        own = {field.name: field.type for field in msgspec.structs.fields(topic.type)}
        self._made = shown.made
        self._names = ["run_id", "seq", *shown.fields.split()]
        self._copied = [name for name in self._names if name in own]
        self._vectors = {
            name: getattr(plant, NAMED_AFTER[name]) for name in self._names if name in NAMED_AFTER
        }
        kinds = {name: inspect.type_info({**own, **shown.types}[name]) for name in self._names}
        # What may be absent stands last in a schema.
        optional = [name for name, kind in kinds.items() if isinstance(kind, inspect.UnionType)]
        required = [name for name in kinds if name not in optional]
        schemas = {name: self._schema(name, kinds[name]) for name in (*required, *optional)}
        self.schema: Json = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": f"{topic.type.__name__} (view)",
            **_object(schemas, required),
        }

    def render(self, message: m.Message) -> bytes:
        """JSON text of one message.

        Raises:
            BadMessage: a vector's length is not the plant's.
        """
        values: Json = {name: getattr(message, name) for name in self._copied}
        try:
            values |= self._made(message)
            for name, names in self._vectors.items():
                if (vector := values.get(name)) is not None:
                    values[name] = _named(names, vector)
        except ValueError as error:
            raise BadMessage(self.topic.name, "wrong size", str(error)) from error
        shown = {name: values[name] for name in self._names if values.get(name) is not None}
        return msgspec.json.encode(shown)

    def _schema(self, name: str, kind: inspect.Type) -> Json:
        if name in self._vectors:
            entries = list(self._vectors[name])
            return _object({entry: {"type": "number"} for entry in entries}, entries)
        match kind:
            case inspect.UnionType(types=types):
                return self._schema(name, next(t for t in types if not isinstance(t, inspect.NoneType)))
            case inspect.DictType(value_type=value):
                return {"type": "object", "additionalProperties": self._schema("", value)}
        return {"type": JSON_TYPES[type(kind)]}


def views(plant: Description) -> dict[str, View]:
    """The views of all topics that have one, by topic name."""
    return {topic.name: View(topic, plant) for topic in topics.ALL if topic.type in SHOWN}


def _object(properties: Json, required: list[str]) -> Json:
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def _named(names: tuple[str, ...], values: list[float]) -> dict[str, float]:
    if len(names) != len(values):
        raise ValueError(f"{len(values)} entries where the plant has {len(names)} ({', '.join(names)})")
    return dict(zip(names, values, strict=True))
