"""Describes what a controller guarantees, and from which states, at its start."""

from __future__ import annotations

import numpy as np

from controller_node.certified_sets import CertifiedSets, find_sets, start_of
from lbmpc.model import Model
from lbmpc.sets.guard import Guard
from node_runtime.config.sections import Config


def guarantee(config: Config, model: Model, sets: CertifiedSets | None = None) -> str:
    """Return one or two sentences for the configured tightening.

    Args:
        config: the resolved configuration.
        model: the nominal model of that configuration.
        sets: the sets in use; None to find them by the configuration, for `invariant`.

    Raises:
        ConfigError: there are no sets for `invariant`.
    """
    said = _of_known_states(config, model, sets)
    if config.estimator.kind == "none" or config.controller.tightening == "none" or model.plant.dead_time:
        return said
    return (
        f"{said}. This applies to exactly known states. Here states are estimated, and the estimation error is "
        "not in W: nothing is guaranteed for the true state"
    )


def _of_known_states(config: Config, model: Model, sets: CertifiedSets | None) -> str:
    if model.plant.dead_time and config.controller.tightening in ("first_step", "tube"):
        return (
            f"guaranteed: nothing; {config.controller.tightening} tightens by the effect of W in one period, and not "
            f"over the dead time of {model.plant.dead_time:g} s, over which the state is predicted"
        )
    match config.controller.tightening:
        case "none":
            return "guaranteed: nothing; the constraints of the nominal prediction are not tightened"
        case "first_step":
            return (
                "guaranteed: the next state, at its sample, is in X for every h in W, from states where the "
                "plan satisfies its first constraint; nothing for later steps"
            )
        case "tube":
            return (
                "guaranteed: X and U at every sample, for all time and every h in W, from every state from "
                "which the problem is feasible once; W is assumed, not proved"
            )
    return _of_sets(find_sets(config, model) if sets is None else sets, start_of(config, model))


def _of_sets(sets: CertifiedSets, start: np.ndarray) -> str:
    certificate, found = sets.certificate, sets.found
    count, margin = len(certificate.pieces), Guard(certificate).first_inputs(start).margin
    inside = f"x0 is inside, {margin:.2g} from the boundary"
    if margin < 0:
        inside = "x0 is OUTSIDE the sets, so nothing is guaranteed from it"
    trust = "W is proved"
    if certificate.source_of_W == "given":
        trust = (
            "W is assumed, not proved, and the states are those that the linear model predicts over the delay"
        )
    sets_are = f"{count} certified {'set' if count == 1 else 'sets'} ({certificate.kind}, "
    sets_are += f"{100 * found.volume_fraction:.1f} % of X, margin {found.invariance_margin:.2g}, "
    return (
        "guaranteed: X and U at every sample, not between two samples, for any network, if inputs act for whole "
        f"periods, from every state of {sets_are}sha256 {sets.sha256[:12]}); {trust}; {inside} (shares of X's "
        "half-widths)"
    )
