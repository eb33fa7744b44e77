"""The bounds and the targets as series, and the marks of held samples."""

from __future__ import annotations

import json
from typing import Any

import jsonschema
import msgspec
import pytest

from lbmpc.plants import get_plant
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from run_log.views.views import Views
from tests.run_log.samples import synthetic

PLANT = get_plant("moore_greitzer")
_, LOGGED = synthetic(steps=2)
RESULT = next(message for topic, message, _ in LOGGED if topic is topics.RESULT)
STATE = next(message for topic, message, _ in LOGGED if topic is topics.PLANT_STATE)


def shown(views: Views, name: str, message: m.Message, time_ns: int) -> dict[str, Any]:
    """Return the shown values of a message, by channel."""
    found = {}
    for channel, data in views.show(name, codec.encode(message), time_ns).shown:
        jsonschema.validate(json.loads(data), channel.schema)
        found[channel.topic] = json.loads(data)
    return found


def test_bounds_come_once_a_second_and_have_the_units() -> None:
    views = Views(override(Config(), ["controller.W=[0.1,0.2,0.3,0.4]", "rate=10"]), PLANT)
    found = [shown(views, "plant/state", STATE, k * 100_000_000).get("view/bounds") for k in range(21)]
    assert [k for k, bounds in enumerate(found) if bounds] == [0, 10, 20]
    first = found[0]
    assert first["x_min"] == dict(zip(PLANT.states, PLANT.x_min.tolist(), strict=True))
    assert first["u_max"] == dict(zip(PLANT.inputs, PLANT.u_max.tolist(), strict=True))
    assert first["h_max"] == pytest.approx({"z": 0.01, "y": 0.02, "r": 0.03, "rdot": 0.04})
    schema = next(one for one in views.channels if one.topic == "view/bounds").schema
    assert schema["properties"]["x_max"]["properties"]["rdot"]["unit"] == "1/s"


def test_the_target_is_shown_or_else_the_equilibrium() -> None:
    views = Views(Config(), PLANT)
    rest = shown(views, "controller/result", RESULT, 0)["view/targets"]
    assert (rest["status"], rest["x"]) == ("none", dict(zip(PLANT.states, PLANT.x_e.tolist(), strict=True)))
    aimed = msgspec.structs.replace(
        RESULT, target_status="nearest", target_x=[1.0, 2.0, 3.0, 4.0], target_u=[0.5], target_distance=0.25
    )
    target = shown(views, "controller/result", aimed, 10**9)["view/targets"]
    assert target == {"x": {"z": 1.0, "y": 2.0, "r": 3.0, "rdot": 4.0}, "u": {"u": 0.5}, "status": "nearest",
                      "distance": 0.25}  # fmt: skip
    wrong = views.show(
        "controller/result", codec.encode(msgspec.structs.replace(aimed, target_x=[1.0])), 2 * 10**9
    )
    assert wrong.bad is not None
    assert wrong.bad.reason == "wrong size"


def test_a_sample_before_the_first_command_is_marked() -> None:
    views = Views(Config(), PLANT)
    assert shown(views, "plant/state", STATE, 0)["view/plant/state"]["held"] is True
    driven = msgspec.structs.replace(STATE, source="command")
    assert shown(views, "plant/state", driven, 10**9)["view/plant/state"]["held"] is False


def test_a_counter_that_comes_later_is_declared_in_a_new_channel_of_the_same_name() -> None:
    views = Views(Config(), PLANT)
    health = m.Health(run_id="p", seq=0, process="plant", status="running", counters={}, note="")
    channels = []
    for k, counters in enumerate(
        [{}, {"samples": 1}, {"samples": 2}, {"samples": 3, "bad_x": 1}, {"bad_x": 2}]
    ):
        (one, *_) = (
            one.channel
            for one in views.show(
                "plant/health", codec.encode(msgspec.structs.replace(health, counters=counters)), k
            ).shown
            if one.channel.topic == "view/plant/health"
        )
        channels.append(one)
    assert len({id(one) for one in channels}) == 3
    declared = [list(one.schema["properties"].get("counters", {}).get("properties", {})) for one in channels]
    assert declared == [[], ["samples"], ["samples"], ["samples", "bad_x"], ["samples", "bad_x"]]


def test_names_that_never_end_are_not_all_declared() -> None:
    views = Views(Config(), PLANT)
    health = m.Health(run_id="p", seq=0, process="plant", status="running", counters={}, note="")
    channels = set()
    for k in range(300):
        message = msgspec.structs.replace(health, seq=k, counters={f"c{k}_{i}": 1 for i in range(5)})
        for one in views.show("plant/health", codec.encode(message), k).shown:
            jsonschema.validate(json.loads(one.data), one.channel.schema)
            channels.add(one.channel)
    assert len(channels) <= 35
