"""The plottable view of each message: flat JSON with a JSON schema, vectors under the plant's own names.

Each view is declared once, as a Struct; its JSON and its schema both follow from that. Weights are summarised by their
norms, and a keyframe has no view. What a message lacks (no input was applied, no estimate yet) is left out rather than
null, since plotting tools skip absent fields and choke on others.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias, get_args, get_origin

import msgspec
import numpy as np

from lbmpc.plants import Plant
from protocol import messages as m
from protocol import topics
from protocol.codec import BadMessage
from protocol.topics import Topic

Json = dict[str, Any]
State: TypeAlias = Annotated[dict[str, float], "states"]
"""A vector under the names of the plant's states; a view makes it of a plain list."""
Input: TypeAlias = Annotated[dict[str, float], "inputs"]
"""The same under the names of its inputs."""
NAMED_AFTER = {State: "states", Input: "inputs"}
"""The plant's attribute that has the names."""
JSON_TYPES = {float: "number", int: "integer", str: "string", bool: "boolean"}


class MessageView(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What is shown of one kind of message, in this order. What may be absent has the default None.

    A field is the message's field of the same name, or what `derived` says.
    """

    run_id: str
    seq: int

    @staticmethod
    def derived(message: Any) -> Json:
        """The fields that the message does not have under their names, or has otherwise."""
        return {}


class PlantStateView(MessageView, frozen=True, kw_only=True):
    t: float
    x: State
    applied: Input | None = None
    source: str
    command_seq: int


class CommandView(MessageView, frozen=True, kw_only=True):
    state_run_id: str
    state_seq: int
    period: float
    mode: str
    u: Input
    plan_entries: int

    @staticmethod
    def derived(message: m.Command) -> Json:
        return {"plan_entries": len(message.plan)}


class TickView(MessageView, frozen=True, kw_only=True):
    slot: int
    t: float
    skipped: int
    lateness: float
    late: bool
    state_verdict: str
    state_seq: int | None = None
    x: State | None = None
    weights_version: int | None = None

    @staticmethod
    def derived(message: m.Tick) -> Json:
        state, weights = message.state, message.weights
        shown = {} if state is None else {"state_seq": state.seq, "x": state.x}
        return shown if weights is None else {**shown, "weights_version": weights.seq}


class TickResultView(MessageView, frozen=True, kw_only=True):
    x: State | None = None
    u: Input
    mode: str
    status: str
    iterations: int
    slack: float
    slack_row: str
    h: State | None = None
    h_hat: State | None = None
    prediction_error: float | None = None
    oracle_norms: State | None = None
    hidden_version: int
    hidden_sha256: str
    weights_verdict: str
    set_margin: float | None = None
    set_piece: int | None = None

    @staticmethod
    def derived(message: m.TickResult) -> Json:
        absent = {"set_piece": None} if message.set_margin is None else {}
        return {"x": message.x or None, "oracle_norms": message.oracle_norms or None, **absent}


class TickTimingView(MessageView, frozen=True, kw_only=True):
    solve_ms: float
    tick_ms: float
    lateness_ms: float
    state_age_ms: float


class SamplesView(MessageView, frozen=True, kw_only=True):
    """How many there are, and the last of them."""

    count: int
    x: State | None = None
    u: Input | None = None
    h: State | None = None

    @staticmethod
    def derived(message: m.Samples) -> Json:
        count: Json = {"count": len(message.samples)}
        return count | {
            name: getattr(last, name) for last in message.samples[-1:] for name in ("x", "u", "h")
        }


class OutputWeightsView(MessageView, frozen=True, kw_only=True):
    hidden_version: int
    hidden_sha256: str
    norm: float
    column_norms: State

    @staticmethod
    def derived(message: m.OutputWeights) -> Json:
        K = message.K.numpy()
        # Of a K that is no matrix the norm along its first axis is a number: one entry, which is the wrong size.
        columns = np.atleast_1d(np.linalg.norm(K, axis=0))
        return {"norm": float(np.linalg.norm(K)), "column_norms": columns.tolist()}


class HiddenWeightsView(MessageView, frozen=True, kw_only=True):
    for_run: str
    trained_on: int
    base_sha256: str
    samples: int
    loss_before: float
    loss_after: float
    sha256: str
    layer_norms: dict[str, float]

    @staticmethod
    def derived(message: m.HiddenWeights) -> Json:
        norms = [float(np.linalg.norm(layer.numpy())) for layer in message.layers]
        return {"layer_norms": {f"W_{i}": norm for i, norm in enumerate(norms, 1)}}


class CertifiedSetsView(MessageView, frozen=True, kw_only=True):
    kind: str
    sha256: str


class RunInfoView(MessageView, frozen=True, kw_only=True):
    process: str
    versions: dict[str, str]
    seed: int
    units: dict[str, str]
    unix_time: float


class HealthView(MessageView, frozen=True, kw_only=True):
    process: str
    status: str
    counters: dict[str, int]
    note: str


VIEW_OF: dict[Topic, type[MessageView]] = {
    topics.PLANT_STATE: PlantStateView,
    topics.COMMAND: CommandView,
    topics.TICK: TickView,
    topics.RESULT: TickResultView,
    topics.TIMING: TickTimingView,
    topics.SAMPLES: SamplesView,
    topics.OUTPUT_WEIGHTS: OutputWeightsView,
    topics.HIDDEN_WEIGHTS: HiddenWeightsView,
    topics.SETS: CertifiedSetsView,
    **dict.fromkeys(topics.RUN_INFO.values(), RunInfoView),
    **dict.fromkeys(topics.HEALTH.values(), HealthView),
}


class View:
    """How one topic is shown for one plant."""

    def __init__(self, topic: Topic, plant: Plant):
        self.topic = topic
        self._kind = VIEW_OF[topic]
        fields = msgspec.structs.fields(self._kind)
        # What may be absent is declared as `kind | None`, and stands last in a schema.
        kinds = {f.name: f.type if f.required else get_args(f.type)[0] for f in fields}
        required = [field.name for field in fields if field.required]
        schemas = {
            name: _schema(kinds[name], plant) for name in sorted(kinds, key=lambda n: n not in required)
        }
        self._copied = [name for name in kinds if name in topic.type.__struct_fields__]
        self._vectors = {
            name: getattr(plant, NAMED_AFTER[kind]) for name, kind in kinds.items() if kind in NAMED_AFTER
        }
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
            values |= self._kind.derived(message)
            for name, names in self._vectors.items():
                if (vector := values.get(name)) is not None:
                    values[name] = _named(names, vector)
        except ValueError as error:
            raise BadMessage(self.topic.name, "wrong size", str(error)) from error
        return msgspec.json.encode(self._kind(**values))


def views(plant: Plant) -> dict[str, View]:
    """The views of all topics that have one, by topic name."""
    return {topic.name: View(topic, plant) for topic in VIEW_OF}


def _schema(kind: Any, plant: Plant) -> Json:
    if kind in NAMED_AFTER:
        names = list(getattr(plant, NAMED_AFTER[kind]))
        return _object(dict.fromkeys(names, _schema(float, plant)), names)
    if get_origin(kind) is dict:
        return {"type": "object", "additionalProperties": _schema(get_args(kind)[1], plant)}
    return {"type": JSON_TYPES[kind]}


def _object(properties: Json, required: list[str]) -> Json:
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def _named(names: tuple[str, ...], values: list[float]) -> dict[str, float]:
    if len(names) != len(values):
        raise ValueError(f"{len(values)} entries where the plant has {len(names)} ({', '.join(names)})")
    return dict(zip(names, values, strict=True))
