"""The layout for Foxglove and Lichtblick names existing fields, for any plant."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from examples.quadrotor.quadrotor import QUADROTOR
from lbmpc.plants import get_plant
from node_runtime.config.sections import Config
from run_log.views.views import Views
from tandem.web.layout import layout

PLANTS = {"compressor": get_plant("moore_greitzer"), "quadrotor": QUADROTOR}


def panels_in(tree: Any) -> Iterator[str]:
    if isinstance(tree, str):
        yield tree
        return
    assert tree["direction"] in ("row", "column")
    assert 0.0 < tree["splitPercentage"] < 100.0
    yield from panels_in(tree["first"])
    yield from panels_in(tree["second"])


@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
def test_every_series_is_a_number_that_is_in_the_schema_of_its_channel(plant: Any):
    schemas = {channel.topic: channel.schema for channel in Views(Config(), plant).channels}
    panels = layout(plant)["configById"]
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    missing = set()
    for path in paths:
        topic, *fields = path.split(".")
        schema = schemas[topic]
        for field in fields:
            schema = schema["properties"].get(field, {"type": "nothing", "properties": {}})
        if schema["type"] != "number":
            missing.add(path)
    # An unbounded state or input has no series of bounds.
    assert all(".x_m" in path or ".u_m" in path for path in missing), missing
    shown = {path for path in paths if path not in missing}
    for name in plant.states:
        assert {f"view/plant/state.x.{name}", f"view/controller/result.h_hat.{name}"} <= shown
    assert schemas[panels["RosOut!tandem"]["topicToRender"]]["title"] == "foxglove.Log"


@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
def test_every_panel_stands_in_the_tree_once(plant: Any):
    made = layout(plant)
    placed = list(panels_in(made["layout"]))
    assert sorted(placed) == sorted(made["configById"])
    assert {name.partition("!")[0] for name in placed} == {"Plot", "RosOut"}


def test_a_name_that_is_no_identifier_is_quoted():
    plant = get_plant("moore_greitzer")
    odd = replace(plant, states=("Δp 1", *plant.states[1:]))
    paths = [path["value"] for panel in layout(odd)["configById"].values() for path in panel.get("paths", [])]
    assert 'view/plant/state.x."Δp 1"' in paths
    plain = re.compile(r"[a-z_/]+(\.[a-zA-Z0-9_-]+)*(\.\"[^\"]+\")?")
    assert all(plain.fullmatch(path) for path in paths)
