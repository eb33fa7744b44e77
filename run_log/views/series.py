"""Series that are not in a message: the bounds of the plant, and the targets of the plans."""

from __future__ import annotations

import msgspec
import numpy as np

from lbmpc.plants import Description
from node_runtime.config.sections import Config
from protocol.messages import TickResult
from run_log.views.channel import Channel, Json, Shown, document, leaf, object_schema
from run_log.views.fields import meaning_of
from run_log.views.view import entry, named

BOUNDS_EVERY_NS = 1_000_000_000
"""Interval between two messages, so short that every part of a run shows a line."""


class Bounds:
    """The bounds of X, U and W as a series, to be plotted with the states, the inputs and h."""

    def __init__(self, config: Config, plant: Description):
        given = config.controller.W
        w = (plant.W if given is None else np.asarray(given, dtype=float)) * config.period
        none = np.full(len(plant.inputs), np.inf)
        rates = none if plant.u_rate_max is None else plant.u_rate_max
        found: dict[str, tuple[tuple[str, ...], np.ndarray]] = {
            "x_min": (plant.states, plant.x_min),
            "x_max": (plant.states, plant.x_max),
            "u_min": (plant.inputs, plant.u_min),
            "u_max": (plant.inputs, plant.u_max),
            "u_rate_max": (plant.inputs, rates),
            "h_min": (plant.states, -w),
            "h_max": (plant.states, w),
        }
        values: dict[str, dict[str, float]] = {}
        schemas: Json = {}
        for name, (names, numbers) in found.items():
            # An infinite bound is left out.
            finite = {
                one: value for one, value in named(names, numbers.tolist()).items() if np.isfinite(value)
            }
            if finite:
                values[name] = finite
                entries = {one: entry(plant, one) for one in finite}
                text = meaning_of("bounds", name).text
                schemas[name] = object_schema(entries, entries) | {"description": text}
        self.channel = Channel("bounds", document("Bounds of X, U and W", schemas, schemas))
        self._shown = Shown(self.channel, msgspec.json.encode(values))
        self._next: int | None = None

    def show(self, time_ns: int) -> Shown | None:
        """Return the bounds at the first message and then once a second; else None."""
        # A clock that was set back, or that of another run, does not stop the series.
        if self._next is not None and self._next - BOUNDS_EVERY_NS <= time_ns < self._next:
            return None
        self._next = time_ns + BOUNDS_EVERY_NS
        return self._shown


class Targets:
    """Targets of the plans: the target of the reference, or the equilibrium if there is no reference."""

    def __init__(self, plant: Description):
        self._plant = plant
        self._rest = plant.x_e.tolist(), plant.u_e.tolist()
        schemas: Json = {}
        for name, names in (("x", plant.states), ("u", plant.inputs)):
            entries = {one: entry(plant, one) for one in names}
            text = meaning_of("targets", name).text
            schemas[name] = object_schema(entries, entries) | {"description": text}
        for name, kind in (("status", "string"), ("distance", "number")):
            schemas[name] = leaf(kind, *meaning_of("targets", name))
        self.channel = Channel("targets", document("Targets of the plans", schemas, ("x", "u", "status")))

    def show(self, result: TickResult) -> Shown:
        """Raises `ValueError` if a target does not fit this plant."""
        x, u = (result.target_x, result.target_u) if result.target_x else self._rest
        plant = self._plant
        shown: Json = {
            "x": named(plant.states, x),
            "u": named(plant.inputs, u),
            "status": result.target_status,
        }
        if result.target_distance is not None:
            shown["distance"] = result.target_distance
        return Shown(self.channel, msgspec.json.encode(shown))
