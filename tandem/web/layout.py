"""A layout for Foxglove and Lichtblick, made for one plant's names. Pure.

Both read the same JSON: a tree of panels, and a configuration by panel. Each takes the keys that it knows.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from lbmpc.plants import Description

Json = dict[str, Any]
WINDOW_S = 30.0
BLUE, ORANGE, GREEN, RED = "#1a6fb5", "#d0721f", "#2f8f57", "#c2473a"
PLAIN_NAME = re.compile(r"[a-zA-Z0-9_-]+")


def layout(plant: Description) -> Json:
    """Return the layout: states and inputs with bounds and targets, h with h_hat, margin, tick times, events."""
    panels: Json = {}

    def plot(title: str, unit: str, *series: tuple[str, str, str]) -> str:
        name = f"Plot!tandem{len(panels)}"
        panels[name] = _plot(title, unit, series)
        return name

    units = plant.units
    states = [
        plot(
            name,
            units.get(name, ""),
            (_path("plant/state.x", name), "measured", BLUE),
            (_path("targets.x", name), "target", GREEN),
            *_bounds("x", name),
        )
        for name in plant.states
    ]
    inputs = [
        plot(
            name,
            units.get(name, ""),
            (_path("plant/state.applied", name), "applied", BLUE),
            (_path("controller/result.u", name), "command", ORANGE),
            (_path("targets.u", name), "target", GREEN),
            *_bounds("u", name),
        )
        for name in plant.inputs
    ]
    errors = [
        plot(
            f"h, {name}",
            units.get(name, ""),
            (_path("controller/result.h", name), "h", BLUE),
            (_path("controller/result.h_hat", name), "h_hat", ORANGE),
            *_bounds("h", name),
        )
        for name in plant.states
    ]
    margin = plot("margin to the certified sets", "1", ("view/controller/result.set_margin", "margin", BLUE))
    times = plot(
        "times of a tick",
        "ms",
        ("view/controller/timing.tick_ms", "tick", BLUE),
        ("view/controller/timing.solve_ms", "solve", ORANGE),
        ("view/controller/timing.lateness_ms", "lateness", GREEN),
    )
    events = "RosOut!tandem"
    panels[events] = {"searchTerms": [], "minLogLevel": 2, "topicToRender": "view/events"}
    columns = [_split("column", part) for part in (states, [*inputs, margin, times], [*errors, events])]
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", columns),
    }


def _path(field: str, name: str) -> str:
    """The path of one state or input in a message."""
    return f"view/{field}." + (name if PLAIN_NAME.fullmatch(name) else f'"{name}"')


def _bounds(vector: str, name: str) -> list[tuple[str, str, str]]:
    return [(_path(f"bounds.{vector}_{end}", name), end, RED) for end in ("min", "max")]


def _plot(title: str, unit: str, series: Sequence[tuple[str, str, str]]) -> Json:
    """One panel; series as (path, label, colour)."""
    return {
        "foxglovePanelTitle": title,
        "lichtblickPanelTitle": title,
        "paths": [
            {
                "value": path,
                "label": label,
                "color": color,
                "enabled": True,
                "timestampMethod": "receiveTime",
                "showLine": True,
                "lineSize": 1 if color in (RED, GREEN) else 1.5,
            }
            for path, label, color in series
        ],
        "yAxisLabel": unit,
        "followingViewWidth": WINDOW_S,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
    }


def _split(direction: str, parts: Sequence[Any]) -> Any:
    """A tree of two each, in which every part has the same room."""
    first, *rest = parts
    if not rest:
        return first
    share = 100.0 / len(parts)
    return {
        "direction": direction,
        "first": first,
        "second": _split(direction, rest),
        "splitPercentage": share,
    }
