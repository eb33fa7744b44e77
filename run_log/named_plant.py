"""A plant file that the reader of a log names, for features that need more than numbers."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from controller_node.build import GivenPlant
from lbmpc.plants import PLANTS, Known, Plant, get_plant, get_truth
from node_runtime.config.plant import load_plant, plant_of, true_plant_of
from node_runtime.config.reference import absolute, is_reference, sha256_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from run_log.run import Run, as_logged, equations_of, recorded_plant


def name_plant(run: Run, reference: str) -> list[str]:
    """Use this plant for the run; return notes on its differences from the log.

    Args:
        run: a log; gets `named`.
        reference: "tanks.py:TANKS", relative to the current folder, or the name of a plant that comes with Tandem.

    Raises:
        ConfigError: there is no such plant, or it does not fit the log.
    """
    named, notes = _named(run, reference)
    here = plant_of(run.config, get_plant, named)
    _require_names(run, reference, here)
    run.named = named
    if run.plant is not None and (other := _other(run.plant, here)):
        notes.append(
            f"{reference} differs from the log in {', '.join(other)}; the values of the log are used"
        )
    return notes


def name_truth(run: Run, reference: str) -> list[str]:
    """`name_plant`, for the true equations of the run. If the log names a truth of its own, it gets `truth`."""
    if not isinstance(run.config.plant.truth, str):
        return name_plant(run, reference)
    named, notes = _named(run, reference)
    try:
        truth = get_truth(named)
    except LookupError as error:
        raise ConfigError(f"{reference}: {error.args[0]}") from error
    _require_names(run, reference, truth)
    run.truth = truth
    return notes


def _named(run: Run, reference: str) -> tuple[Known | Plant, list[str]]:
    """Return the plant, and a sentence if its file differs from the log's."""
    whole = absolute(reference, Path.cwd())
    named = load_plant(whole) if is_reference(whole) else PLANTS.get(whole)
    if named is None:
        raise ConfigError(f"{reference}: Tandem has no plant of that name; for a file, write tanks.py:TANKS")
    sha256 = sha256_of(whole)
    theirs = sorted(text for key, text in run.files.items() if key in ("plant.model", "plant.truth"))
    if not theirs or sha256 is None or sha256 in theirs:
        return named, []
    logged = " and ".join(text[:12] for text in theirs)
    note = f"{reference} is not the file that the log names: its sha256 is {sha256[:12]}, and the log has {logged}"
    return named, [note]


def _require_names(run: Run, reference: str, here: Known | Plant) -> None:
    if run.plant is not None and (run.plant.states, run.plant.inputs) != (here.states, here.inputs):
        names = (*run.plant.states, *run.plant.inputs)
        raise ConfigError(
            f"{reference}: has the states and inputs {', '.join((*here.states, *here.inputs))}, and the log has "
            f"{', '.join(names)}"
        )


def given_plant(run: Run, config: Config, changed: set[str]) -> GivenPlant:
    """Return the plant of a replay: the log's numbers, and equations if they are named or belong to Tandem.

    Args:
        run: a log.
        config: that of one of its controllers, with the changes of the replay.
        changed: the keys of these changes. They may name code. Code that only the log names is never loaded.

    Raises:
        ConfigError: the plant does not fit the configuration.
        LogError: neither the log nor the changes say which plant it was.
    """
    if changed & {"plant", "plant.model"}:
        known = plant_of(config, get_plant)
        equations = known if isinstance(known, Plant) else None
    else:
        known = plant_of(as_logged(run, config, changed), get_plant, recorded_plant(run, config))
        equations = equations_of(run, config)
    truth, of_the_log = config.plant.truth, not changed & {"plant", "plant.truth"}
    if config.controller.oracle != "perfect" or equations is None:
        return GivenPlant(known, equations)
    if isinstance(truth, str) and is_reference(truth) and of_the_log:
        return GivenPlant(known, equations)
    return GivenPlant(known, equations, true_plant_of(config, get_plant, get_truth, equations))


def _other(logged: Known, plant: Known | Plant) -> list[str]:
    """Return the fields in which they differ."""
    here = plant if isinstance(plant, Known) else plant.known()

    def same(name: str) -> bool:
        one, other = getattr(logged, name), getattr(here, name)
        if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
            return one is not None and other is not None and np.array_equal(one, other)
        return bool(one == other)

    return [one.name for one in fields(Known) if not same(one.name)]
