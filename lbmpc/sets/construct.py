"""The construction of a certificate from a model: W, the invariant set, and sets around it."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping, Sequence

import numpy as np

from lbmpc.model import Model
from lbmpc.sets.certificate import FORMAT, Certificate, Kind, Piece, model_of
from lbmpc.sets.constraint_sets import input_set, state_set
from lbmpc.sets.enclosures.disturbance import (
    DisturbanceBound,
    Region,
    bound_box,
    bound_hull,
    given_box,
    require_half_widths,
)
from lbmpc.sets.geometry.operations import Body, body, body_of
from lbmpc.sets.geometry.polytope import SetError
from lbmpc.sets.invariance.regions import ControllableSet, controllable_sets
from lbmpc.sets.invariance.robust_control import Stage, UncertainSystem, predecessor, predecessor_iteration
from lbmpc.sets.motion import over_any_delay

Saved = MutableMapping[str, dict[str, np.ndarray]]
"""Intermediate results by name, from which an interrupted construction continues."""
Report = Callable[[str, float], None]
"""Receives the present task and the share of it that is done."""
SAVE_EVERY = 5


def silent(_what: str, _done: float) -> None:
    """A `Report` that does nothing."""


def construct(
    model: Model,
    kind: Kind,
    start: np.ndarray,
    W: np.ndarray | None = None,
    slack: float = 3e-4,
    patience: int = 150,
    saved: Saved | None = None,
    report: Report = silent,
) -> Certificate:
    """Compute the sets of one kind for the whole of X and U.

    Args:
        model: the model.
        kind: `given` uses W as it is. `box` and `hull` bound h over X x U rigorously. `regions` adds sets around a path
            from `start` into the set of `hull`, with local bounds of h. `extension` is the approximation used in the
            paper (Aswani, Bouffard and Tomlin 2012), X with one predecessor of X, and is not certified.
        start: a state that should be in the sets, (d,), in deviations.
        W: half-widths (d,) for `given`; the plant's own by default. The sets use slightly more, see `over_any_delay`.
        slack, patience: as for `predecessor_iteration`.
        saved: intermediate results of an earlier call with the same arguments; updated during the work.
        report: receives the progress.

    Raises:
        EmptySetError: there are no such sets. The text says which set is empty at which step, and what may help.
        SetError, DisturbanceError: the construction does not apply to this model or its bounds.
    """
    saved = {} if saved is None else saved
    bound = _bound(model, kind, W, saved, report)
    if kind == "extension":
        return _extension(model, bound)
    stage = _invariant(model, bound, slack, patience, saved, report)
    base = stage.set
    around: list[ControllableSet] = []
    if kind == "regions" and not base.contains(start).all():
        around = controllable_sets(
            model, start, base, lambda done: report("sets around the way from x0", done)
        )
    return _certificate(model, kind, bound, stage, around, slack)


def _extension(model: Model, bound: DisturbanceBound) -> Certificate:
    X = body_of(state_set(model), "X", model.plant.x_scale)
    G, g = predecessor(X, UncertainSystem(model.A, model.B, bound, input_set(model)))
    once = body(np.vstack([X.G, G]), np.concatenate([X.g, g]), "X with its predecessor", X.scale).reduced()
    pieces = [_piece("X with Pre(X)", once, bound, 0)]
    return Certificate(
        format=FORMAT,
        kind="extension",
        certified=False,
        model=model_of(model),
        pieces=pieces,
        source_of_W="interval arithmetic",
        slack=0.0,
        steps=1,
    )


def whole(model: Model) -> Region:
    """Return the region X x U. Raises `SetError` if it is not bounded."""
    X, U, plant = state_set(model), input_set(model), model.plant
    open_ends = [
        f"{name} {end}"
        for names, lower, upper in ((plant.states, X.lower, X.upper), (plant.inputs, U.lower, U.upper))
        for name, low, high in zip(names, lower, upper, strict=True)
        for end, bound in (("below", low), ("above", high))
        if not np.isfinite(bound)
    ]
    if open_ends:
        raise SetError(
            f"{plant.name}: not bounded: {', '.join(open_ends)}. The model error h is bounded over all of X and U, so "
            "certified sets need a finite x_min, x_max, u_min and u_max of each state and input. Give the plant such "
            "bounds, as wide as its range of use; `scale` is not a bound"
        )
    return Region(X.lower, X.upper, U.lower, U.upper)


def _bound(model: Model, kind: Kind, W: np.ndarray | None, saved: Saved, report: Report) -> DisturbanceBound:
    region = whole(model)
    if kind == "given":
        half = require_half_widths(model, model.plant.W * model.period if W is None else W)
        return given_box(model, over_any_delay(model, half), region)
    if model.equations is None:
        raise SetError(
            f"{model.plant.name} is given by numbers alone, but bounds of h need equations; use the kind `given`, "
            "which uses W as it is"
        )
    name = "W as a box" if kind == "box" else "W as a hull"
    if "W" not in saved:
        find = bound_box if kind == "box" else bound_hull
        saved["W"] = {"vertices": find(model, region, progress=lambda done: report(name, done)).vertices}
    return DisturbanceBound.plain(region, saved["W"]["vertices"])


def _invariant(
    model: Model, bound: DisturbanceBound, slack: float, patience: int, saved: Saved, report: Report
) -> Stage:
    X = body_of(state_set(model), "X", model.plant.x_scale)
    plant = UncertainSystem(model.A, model.B, bound, input_set(model))
    stage = _thaw(saved["stage"], X) if "stage" in saved else None
    first = None
    if stage is None or not stage.invariant:
        for found in predecessor_iteration(X, plant, slack, patience, stage):
            stage = found
            if stage.invariant or stage.step % SAVE_EVERY == 0:
                saved["stage"] = _freeze(stage)
            # The excess decreases by about the same factor at each step, down to the slack.
            first = max(stage.excess, 2 * slack) if first is None else first
            left = np.log(max(stage.excess, slack / 10) / (slack / 10)) / np.log(first / (slack / 10))
            report(
                f"the invariant set: step {stage.step}, {len(stage.set.g)} facets",
                1.0 - min(max(left, 0.0), 1.0),
            )
    assert stage is not None
    return stage


def _freeze(stage: Stage) -> dict[str, np.ndarray]:
    return {
        "G": stage.set.G,
        "g": stage.set.g,
        "centre": stage.set.centre,
        "at": np.array([stage.step, stage.excess, stage.slack, stage.set.radius]),
    }


def _thaw(arrays: dict[str, np.ndarray], X: Body) -> Stage:
    step, excess, slack, radius = arrays["at"]
    # The numbers are exactly those that were saved, so an interrupted construction gives the same set.
    again = Body(arrays["G"], arrays["g"], X.scale, arrays["centre"], float(radius))
    return Stage(int(step), again, float(excess), float(slack))


def _certificate(
    model: Model,
    kind: Kind,
    bound: DisturbanceBound,
    stage: Stage,
    around: Sequence[ControllableSet],
    slack: float,
) -> Certificate:
    pieces = [_piece("C", stage.set, bound, 0)]
    pieces += [_piece(f"S{i + 1}", one.set, one.bound, i) for i, one in enumerate(around)]
    return Certificate(
        format=FORMAT,
        kind=kind,
        certified=True,
        model=model_of(model),
        pieces=pieces,
        source_of_W="given" if kind == "given" else "interval arithmetic",
        slack=slack,
        steps=stage.step,
    )


def _piece(name: str, set_: Body, bound: DisturbanceBound, target: int) -> Piece:
    region = bound.region
    return Piece(
        name,
        set_.G.tolist(),
        set_.g.tolist(),
        target,
        bound.slope_x.tolist(),
        bound.slope_u.tolist(),
        bound.vertices.tolist(),
        region.x_lower.tolist(),
        region.x_upper.tolist(),
        region.u_lower.tolist(),
        region.u_upper.tolist(),
    )


def volume_fraction(certificate: Certificate, samples: int = 20_000, seed: int = 0) -> float:
    """Return the volume of the union of all pieces as a share of the volume of X.

    The volume of the first piece is exact. The part of each other piece outside the earlier ones is found by sampling
    (Karp and Luby 1983).
    """
    low, high = (np.array(bound) for bound in certificate.model.X)
    half = (high - low) / 2
    bodies = [body(np.array(p.G), np.array(p.g), p.name, half) for p in certificate.pieces]
    total, rng = bodies[0].volume, np.random.default_rng(seed)
    for i, piece in enumerate(bodies[1:], start=1):
        inside = points_in(piece, max(100, samples // len(bodies)), rng)
        known = np.zeros(len(inside), dtype=bool)
        for earlier in bodies[:i]:
            known |= earlier.contains(inside)
        total += piece.volume * float((~known).mean())
    return float(total / np.prod(high - low))


def points_in(piece: Body, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return uniform points inside the piece, (count, d), by rejection from a bounding box."""
    low, high = piece.vertices.min(axis=0), piece.vertices.max(axis=0)
    found = np.zeros((0, piece.dimension))
    while len(found) < count:
        points = rng.uniform(low, high, (4 * count, piece.dimension))
        found = np.vstack([found, points[piece.contains(points)]])
    return found[:count]
