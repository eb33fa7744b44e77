"""The plottable view of each message: JSON with a JSON schema, vectors under the plant's own names.

A view contains fields of the message by name, and values computed from other fields. Its JSON and its schema follow
from the message's Struct. Weights are summarised by their norms, and a keyframe has no view. A missing value (no
input was applied, no estimate yet) is left out and not null, because plotting tools skip absent fields and fail on
null.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import inspect

from lbmpc.plants import Description
from protocol import messages as m
from protocol import topics
from protocol.codec import BadMessage
from protocol.topics import Topic
from run_log.views.channel import (
    Channel,
    Growing,
    Json,
    Shown,
    array_schema,
    document,
    leaf,
    object_schema,
)
from run_log.views.fields import Meaning, meaning_of

Vector = list[float]
VECTORS = ("x", "oracle_norms", "weight", "constant_weight", "deviation", "noise")
NAMED_AFTER = dict.fromkeys((*VECTORS, "h", "h_hat", "column_norms"), "states") | dict.fromkeys(
    ("u", "applied"), "inputs"
)
"""The plant's attribute that has the names of a vector's entries, by vector."""
WITHOUT_UNIT = ("oracle_norms", "weight", "constant_weight", "column_norms")
"""Vectors whose entries are not in the units of the plant."""
BY_STATE = ("sensor_faults", "reference", "values")
"""Fields with values of some states, by name."""
LACKING = (*VECTORS, "sensor_faults", "reference", "weights_rolled_back", "reference_from")
"""Fields of a result that are absent if they are empty."""
JSON_TYPES: dict[type[inspect.Type], str] = {
    inspect.FloatType: "number",
    inspect.IntType: "integer",
    inspect.StrType: "string",
    inspect.LiteralType: "string",
    inspect.BoolType: "boolean",
}


def _of_state(state: m.PlantState) -> Json:
    missing = None if state.missing is msgspec.UNSET else state.missing
    return {"held": state.source == "hold", "pieces": state.pieces or None, "missing": missing}


def _of_tick(tick: m.Tick) -> Json:
    state, weights = tick.state, tick.weights
    shown: Json = {} if state is None else {"state_seq": state.seq, "x": state.x}
    return shown if weights is None else {**shown, "weights_version": weights.seq}


def _of_result(result: m.TickResult) -> Json:
    piece = None if result.set_margin is None else result.set_piece
    lacking = {name: getattr(result, name) or None for name in LACKING}
    asked = None if result.reference_verdict == "none" else result.reference_verdict
    return {**lacking, "set_piece": piece, "reference_verdict": asked}


def _of_samples(samples: m.Samples) -> Json:
    """The number of samples, and the last of them."""
    last = {name: getattr(sample, name) for sample in samples.samples[-1:] for name in ("x", "u", "h")}
    return {"count": len(samples.samples), **last}


def _of_output_weights(weights: m.OutputWeights) -> Json:
    K = weights.K.numpy()
    if K.ndim != 2:
        raise ValueError(f"K is {K.shape}, not a matrix")
    return {"norm": float(_norm(K)), "column_norms": _norm(K, axis=0).tolist()}


def _of_hidden_weights(weights: m.HiddenWeights) -> Json:
    norms = [float(_norm(layer.numpy())) for layer in weights.layers]
    newest = None if weights.newest is msgspec.UNSET else weights.newest
    return {"newest": newest, "layer_norms": norms}


def _norm(values: np.ndarray, axis: int | None = None) -> Any:
    """Norms, at most the largest float: JSON has no infinity."""
    with np.errstate(over="ignore"):
        found = np.linalg.norm(values, axis=axis)
        if not np.isfinite(found).all():
            found = np.minimum(np.linalg.norm(values.astype(float), axis=axis), np.finfo(float).max)
    return found


def _of_reference(reference: m.Reference) -> Json:
    if {len(row) for row in reference.values} - {len(reference.outputs)}:
        raise ValueError("a point has not one value for each output")
    columns = {name: [row[i] for row in reference.values] for i, name in enumerate(reference.outputs)}
    return {"times": reference.times or None, "values": columns or None}


class Fields(NamedTuple):
    """The shown fields of one kind of message."""

    names: str
    """Names of the fields, in this order, after run_id and seq."""
    made: Callable[[Any], Json] = lambda _message: {}
    """Values of fields that the message lacks or has in another form; None or absent if it has no value."""
    types: Mapping[str, Any] = {}
    """Types of these values, if they differ from those of the message."""


FIELDS_OF: dict[type[m.Message], Fields] = {
    m.PlantState: Fields(
        "t x applied source held command_seq pieces missing",
        _of_state,
        {"held": bool, "pieces": list[m.Piece] | None, "missing": list[str] | None},
    ),
    m.Command: Fields("state_run_id state_seq period mode u plan"),
    m.Tick: Fields(
        "slot t skipped lateness late state_verdict state_seq x weights_version",
        _of_tick,
        {"state_seq": int | None, "x": Vector | None, "weights_version": int | None},
    ),
    m.TickResult: Fields(
        "x u mode status iterations slack slack_row h h_hat prediction_error oracle_norms hidden_version "
        "hidden_sha256 input_delay weights_verdict weights_rolled_back set_margin set_piece sensor_faults reference "
        "reference_verdict reference_from weight constant_weight deviation noise",
        _of_result,
        {
            **dict.fromkeys(VECTORS, Vector | None),
            "weights_rolled_back": str | None,
            "set_piece": int | None,
            "sensor_faults": dict[str, str] | None,
            "reference": dict[str, float] | None,
            "reference_verdict": str | None,
            "reference_from": str | None,
        },
    ),
    m.TickTiming: Fields("solve_ms tick_ms lateness_ms state_age_ms"),
    m.Samples: Fields(
        "count x u h", _of_samples, {"count": int, **dict.fromkeys(("x", "u", "h"), Vector | None)}
    ),
    m.OutputWeights: Fields(
        "hidden_version hidden_sha256 norm column_norms",
        _of_output_weights,
        {"norm": float, "column_norms": Vector},
    ),
    m.HiddenWeights: Fields(
        "for_run trained_on newest base_sha256 samples loss_before loss_after sha256 layer_norms",
        _of_hidden_weights,
        {"newest": int | None, "layer_norms": Vector},
    ),
    m.Reference: Fields(
        "kind times values lease",
        _of_reference,
        {"times": Vector | None, "values": dict[str, Vector] | None},
    ),
    m.Override: Fields("mode u lease", lambda override: {"u": override.u or None}, {"u": Vector | None}),
    m.CertifiedSets: Fields("kind sha256"),
    m.RunInfo: Fields("process versions seed units unix_time"),
    m.Health: Fields("process status counters note"),
}


class View:
    """View of one topic for one plant."""

    def __init__(self, topic: Topic, plant: Description):
        self.topic = topic
        fields = FIELDS_OF[topic.type]
        own = {field.name: field.type for field in msgspec.structs.fields(topic.type)}
        self._plant, self._made = plant, fields.made
        self._names = ["run_id", "seq", *fields.names.split()]
        self._copied = [name for name in self._names if name in own]
        self._kinds = {name: inspect.type_info({**own, **fields.types}[name]) for name in self._names}
        self._vectors: dict[str, Sequence[str]] = {
            name: getattr(plant, NAMED_AFTER[name]) for name in self._names if name in NAMED_AFTER
        }
        self._growing: dict[str, Growing] = {
            name: Growing(JSON_TYPES[type(kind.value_type)], self._meaning(name).text)
            for name, kind in self._kinds.items()
            if isinstance(kind, inspect.DictType) and name not in BY_STATE
        }
        self.channel = self._channel()
        """The channel with its present schema."""

    def render(self, message: m.Message) -> Shown:
        """Return the view of one message.

        Raises:
            BadMessage: the length of a vector does not fit the plant.
        """
        values: Json = {name: getattr(message, name) for name in self._copied}
        try:
            values |= self._made(message)
            self._name_entries(values)
        except ValueError as error:
            raise BadMessage(self.topic.name, "wrong size", str(error)) from error
        if self._growing:
            self._grow(values)
        shown = {name: values[name] for name in self._names if values.get(name) is not None}
        return Shown(self.channel, msgspec.json.encode(shown))

    def _name_entries(self, values: Json) -> None:
        """Name the entries after the plant's states or inputs. Raises `ValueError` if the numbers differ."""
        for name, names in self._vectors.items():
            if (vector := values.get(name)) is not None:
                values[name] = named(names, vector)
        inputs = self._plant.inputs
        if (pieces := values.get("pieces")) is not None:
            values["pieces"] = [{"seconds": one.seconds, "u": named(inputs, one.u)} for one in pieces]
        if (plan := values.get("plan")) is not None:
            if {len(entry) for entry in plan} != {len(inputs)}:
                raise ValueError(f"an entry of the plan has not one value for each of {', '.join(inputs)}")
            values["plan"] = dict(zip(inputs, zip(*plan, strict=True), strict=True))
        for name in BY_STATE:
            if (found := values.get(name)) is not None:
                values[name] = {state: found[state] for state in self._plant.states if state in found}

    def _grow(self, values: Json) -> None:
        grown = False
        for name, growing in self._growing.items():
            grown |= growing.grow(values[name])
            values[name] = growing.declared(values[name]) or None
        if grown:
            self.channel = self._channel()

    def _channel(self) -> Channel:
        # Optional fields are last in a schema.
        optional = [name for name, kind in self._kinds.items() if isinstance(kind, inspect.UnionType)]
        required = [name for name in self._kinds if name not in optional and name not in self._growing]
        # An object is not in the schema until one of its fields is known.
        growing = [name for name, one in self._growing.items() if one]
        names = (*required, *growing, *optional)
        schemas = {name: self._schema(name, self._kinds[name]) for name in names}
        schema = document(f"{self.topic.type.__name__} (view)", schemas, required)
        return Channel(self.topic.name, schema)

    def _meaning(self, name: str) -> Meaning:
        return meaning_of(self.topic.type.__name__, name)

    def _schema(self, name: str, kind: inspect.Type) -> Json:
        plant, (text, unit) = self._plant, self._meaning(name)
        if isinstance(kind, inspect.UnionType):
            return self._schema(name, next(t for t in kind.types if not isinstance(t, inspect.NoneType)))
        if name in self._growing:
            return self._growing[name].schema
        if name in self._vectors:
            entries = {one: entry(plant, one, name not in WITHOUT_UNIT) for one in self._vectors[name]}
            return object_schema(entries, entries) | {"description": text}
        if name == "plan":
            columns = {one: array_schema(entry(plant, one)) for one in plant.inputs}
            return object_schema(columns, columns) | {"description": text}
        if name in BY_STATE:
            return object_schema({one: self._of_a_state(name, one) for one in plant.states}) | {
                "description": text
            }
        if name == "pieces":
            inputs = {one: entry(plant, one) for one in plant.inputs}
            piece = {
                "seconds": leaf("number", *meaning_of("", "seconds")),
                "u": object_schema(inputs, inputs),
            }
            return array_schema(object_schema(piece, piece)) | {"description": text}
        if isinstance(kind, inspect.ListType):
            return array_schema(leaf(JSON_TYPES[type(kind.item_type)], "", unit)) | {"description": text}
        return leaf(JSON_TYPES[type(kind)], text, unit)

    def _of_a_state(self, name: str, state: str) -> Json:
        if name == "sensor_faults":
            return leaf("string")
        number = entry(self._plant, state)
        return array_schema(number) if name == "values" else number


def views(plant: Description) -> dict[str, View]:
    """Return the views of all topics that have one, by topic name."""
    return {topic.name: View(topic, plant) for topic in topics.ALL if topic.type in FIELDS_OF}


def entry(plant: Description, name: str, with_unit: bool = True) -> Json:
    """Return the schema of the value of a state or an input."""
    return leaf("number", plant.names.get(name, ""), plant.units.get(name, "") if with_unit else "")


def named(names: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    """Raises `ValueError` if the numbers of entries and names differ."""
    if len(names) != len(values):
        raise ValueError(f"{len(values)} entries where the plant has {len(names)} ({', '.join(names)})")
    return dict(zip(names, values, strict=True))
