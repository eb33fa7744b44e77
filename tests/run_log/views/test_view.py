"""Every view and its schema, byte for byte as plotting layouts of older logs expect them."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from lbmpc.plants import get_plant
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from run_log.views.view import LACKING, views

RECORDED = Path(__file__).with_name("views.jsonl")
"""Return a line for each message: topic, JSON text of its view, and text of its schema ("" if repeated)."""
VIEWS = views(get_plant("moore_greitzer"))


def messages() -> list[tuple[Topic, m.Message]]:
    """Return two messages of each kind: one with every field, and one without optional fields."""
    who = {"run_id": "c-1", "seq": 7}
    x, u, K = [0.5, 1.25, -3e-9, 20.0], [1.5], m.Array.of(np.arange(12.0).reshape(3, 4))
    state = m.PlantState(**who, t=1e22, x=x, applied=u, source="command", command_seq=6)
    pieces = [m.Piece(0.02, [1.0]), m.Piece(0.03, [2.0])]
    two = m.PlantState(**who, t=1.0, x=x, applied=u, pieces=pieces, source="plan", command_seq=6)
    held = m.PlantState(**who, t=0.0, x=x, applied=None, source="hold", command_seq=-1, missing=["y"])
    weights = m.HiddenWeights(
        run_id="t-1", seq=3, for_run="c-1", trained_on=5, base_sha256="ab", samples=40, loss_before=0.1,
        loss_after=1e-9, network_sha256="cd", sha256="ef", layers=[K, m.Array.of(np.ones((5, 2)), "<f4")],
        newest=6,
    )  # fmt: skip
    tick = m.Tick(
        **who, slot=8, t=0.35, skipped=1, lateness=-0.0, late=True, state_verdict="fresh", state=state, weights=weights
    )  # fmt: skip
    result = m.TickResult(
        **who, x=x, u=u, mode="solver", status="converged", iterations=3, slack=0.25, slack_row="y at step 3", h=x,
        h_hat=x, prediction_error=1e-3, oracle_norms=x, hidden_version=3, hidden_sha256="ef", tick_crc32=9,
        input_delay=0.002, weights_verdict="refused: \"ü\"", set_margin=-0.5, set_piece=2,
        sensor_faults={"y": "stuck; what it measures is estimated from the others"},
        reference={"y": 1.0}, reference_verdict="taken", reference_from="h-1", weights_rolled_back="worse",
        weight=[0.0, 1.0, 0.5, 0.25], constant_weight=x, deviation=x, noise=x,
    )  # fmt: skip
    absent = {"h": None, "h_hat": None, "prediction_error": None, "set_margin": None}
    absent |= {"reference_verdict": "none"}
    absent |= {name: type(getattr(result, name))() for name in LACKING}
    replaced = msgspec.structs.replace
    return [
        (topics.PLANT_STATE, state),
        (topics.PLANT_STATE, held),
        (topics.PLANT_STATE, two),
        (
            topics.COMMAND,
            m.Command(**who, state_run_id="p-1", state_seq=7, period=0.05, mode="solver", u=u, plan=[u] * 3),
        ),
        (topics.TICK, tick),
        (topics.TICK, replaced(tick, state=None, weights=None, state_verdict="missing", late=False)),
        (topics.RESULT, result),
        (topics.RESULT, replaced(result, **absent)),
        (topics.TIMING, m.TickTiming(**who, solve_ms=2.5, tick_ms=3.0, lateness_ms=0.1, state_age_ms=1.0)),
        (topics.SAMPLES, m.Samples(**who, samples=[m.Sample(i, x, u, x[::-1]) for i in (3, 4)])),
        (topics.SAMPLES, m.Samples(**who, samples=[])),
        (topics.OUTPUT_WEIGHTS, m.OutputWeights(**who, hidden_version=3, hidden_sha256="ef", K=K)),
        (topics.HIDDEN_WEIGHTS, weights),
        (topics.HIDDEN_WEIGHTS, replaced(weights, newest=msgspec.UNSET)),
        (
            topics.REFERENCE,
            m.Reference(run_id="h-1", seq=0, outputs=["r", "y"], times=[0.0, 2.0], values=[[1.0, 2.0], [3.0, 4.0]]),
        ),
        (topics.REFERENCE, m.Reference(run_id="h-1", seq=1, kind="hold", lease=1.5)),
        (topics.OVERRIDE, m.Override(run_id="h-1", seq=0, mode="manual", u=u, lease=1.5)),
        (topics.OVERRIDE, m.Override(run_id="h-1", seq=1, mode="auto")),
        (topics.SETS, m.CertifiedSets(**who, kind="invariant", sha256="01", content=b"x")),
        *(
            (topic, m.RunInfo(
                **who, process=name, config="{}", versions={"python": "3.11"}, seed=1, units={"z": "1"}, unix_time=1.5,
            ))
            for name, topic in topics.RUN_INFO.items()
        ),
        *(
            (topic, m.Health(**who, process=name, status="running", counters={"ticks": 2**40}, note="a note"))
            for name, topic in topics.HEALTH.items()
        ),
    ]  # fmt: skip


def test_views_and_their_schemas_are_the_recorded_ones() -> None:
    said = messages()
    assert {topic.name for topic, _ in said} == set(VIEWS)
    recorded = [json.loads(line) for line in RECORDED.read_text(encoding="utf-8").splitlines()]
    schemas: dict[str, str] = {}
    for (topic, message), (name, text, schema) in zip(said, recorded, strict=True):
        view = VIEWS[topic.name]
        assert topic.name == name
        assert view.render(message).data.decode() == text
        schemas[name] = schema or schemas[name]
        assert view.channel.schema_text.decode() == schemas[name]


@pytest.mark.parametrize("shape", [(), (4,), (3, 5), (0, 0), (2, 3, 4)])
def test_weights_of_the_wrong_shape_have_no_view(shape: tuple[int, ...]) -> None:
    K = m.Array.of(np.ones(shape))
    weights = m.OutputWeights(run_id="c", seq=0, hidden_version=0, hidden_sha256="", K=K)
    with pytest.raises(codec.BadMessage, match="wrong size"):
        VIEWS[topics.OUTPUT_WEIGHTS.name].render(weights)
