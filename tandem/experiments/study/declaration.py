"""An experiment as its file declares it: groups of cases, each a configuration, seeds, initial states and faults."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from lbmpc.plants import Plant
from node_runtime.config.sections import Config, Count, Section, from_tree
from node_runtime.config.strict import ConfigError, apply_override, did_you_mean, load_tree, strict
from tandem.experiments.simulation.faults import Faults

Picture = Literal["trajectories", "states", "survival", "lemma", "recovery", "rows"]
Name = Annotated[str, msgspec.Meta(pattern=r"^[^/\\]{1,60}$")]


class Starts(Section, frozen=True):
    """Initial states: some by hand, or a grid."""

    points: list[list[float]] | None = None
    """Each (d,), plant units."""
    grid: dict[str, list[float]] | None = None
    """Values by state name, every combination; the states that are not named are the plant's x0's."""


class Group(Section, frozen=True):
    """Cases that one table shows together."""

    name: Name
    title: str
    about: str = ""
    """What is asked, in a few sentences; above the table."""
    picture: Picture = "rows"
    reference: str | None = None
    """The case that the others are compared with, in words below the table."""


class Case(Section, frozen=True):
    name: Name
    group: Name
    label: str = ""
    """What the report calls it; the name where there is none."""
    set: dict[str, Any] = msgspec.field(default_factory=dict)
    """Changes of the configuration, as a table like it."""
    vary: dict[str, list[Any]] = msgspec.field(default_factory=dict)
    """Makes a case of each combination: "section.key" -> values."""
    seeds: list[Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]] | Count = 1
    """Which, or how many from 0 on."""
    x0s: Name = "default"
    """A name of [x0s]; "default" is the configuration's own x0."""
    steps: Count | None = None
    faults: Faults = Faults()
    log: bool = False
    """Keep the MCAP log of every run from the default x0."""
    quick: bool = True
    """Whether --quick runs it."""


class Quick(Section, frozen=True):
    """What --quick leaves of each case."""

    seeds: Count = 2
    x0s: Count = 3
    values: Count = 3
    """Of each `vary`, first, last and some between."""


class Declaration(Section, frozen=True, kw_only=True):
    """The file."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
    title: str
    about: str = ""
    steps: Count = 200
    base: dict[str, Any] = msgspec.field(default_factory=dict)
    """Changes of the configuration for all cases."""
    x0s: dict[str, Starts] = msgspec.field(default_factory=dict)
    quick: Quick = Quick()
    group: list[Group]
    case: list[Case]


class Resolved(msgspec.Struct, frozen=True, kw_only=True):
    """One case, ready to run: a configuration for each seed and initial state is `config_of`."""

    name: str
    group: str
    label: str
    config: Config
    varied: dict[str, Any]
    """What this case has of its declaration's `vary`."""
    seeds: list[int]
    x0s: list[list[float] | None]
    steps: int
    faults: Faults
    log: bool

    def config_of(self, seed: int, x0: list[float] | None) -> Config:
        plant = self.config.plant if x0 is None else msgspec.structs.replace(self.config.plant, x0=x0)
        return msgspec.structs.replace(self.config, seed=seed, plant=plant)


def load(path: Path) -> Declaration:
    """Read an experiment.

    Raises:
        ConfigError: names the file, the key and the nearest right one.
    """
    declared = strict(load_tree(path), Declaration, str(path))
    groups = [group.name for group in declared.group]
    for i, case in enumerate(declared.case):
        _known(path, f"case[{i}].group", case.group, groups)
        _known(path, f"case[{i}].x0s", case.x0s, ["default", *declared.x0s])
    for names, what in ((groups, "group"), ([case.name for case in declared.case], "case")):
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ConfigError(f"{path}: two [[{what}]] are called {twice[0]!r}")
    return declared


def resolve(declared: Declaration, plant: Plant, where: str, quick: bool = False) -> list[Resolved]:
    """Every case with its configuration. Raises `ConfigError`, as `load` does."""
    resolved = [
        one
        for case in declared.case
        if case.quick or not quick
        for one in _resolve(declared, case, plant, where, quick)
    ]
    known = [case.name for case in resolved]
    if twice := [name for name in known if known.count(name) > 1]:
        raise ConfigError(f"{where}: two cases are called {twice[0]!r}")
    for group in declared.group:
        if group.reference is not None and not quick:
            _known(Path(where), f"group {group.name!r}: reference", group.reference, known)
    return resolved


def _resolve(declared: Declaration, case: Case, plant: Plant, where: str, quick: bool) -> list[Resolved]:
    seeds = case.seeds if isinstance(case.seeds, list) else list(range(case.seeds))
    x0s = _x0s(declared, case, plant, where)
    vary = case.vary
    if quick:
        few = declared.quick
        seeds, x0s = seeds[: few.seeds], x0s[: few.x0s]
        vary = {key: _spread(values, few.values) for key, values in vary.items()}
    made = []
    for values in itertools.product(*vary.values()):
        varied = dict(zip(vary, values, strict=True))
        tree = _merged(_merged({}, declared.base), case.set)
        for key, value in varied.items():
            apply_override(tree, f"{key}={msgspec.json.encode(value).decode()}")
        suffix = ", ".join(f"{key.rpartition('.')[2]} = {_shown(value)}" for key, value in varied.items())
        label = case.label or ("" if suffix else case.name)
        made.append(
            Resolved(
                name=f"{case.name}: {suffix}" if suffix else case.name,
                group=case.group,
                label=": ".join(text for text in (label, suffix) if text),
                config=from_tree(tree, f"{where}: case {case.name!r}"),
                varied=varied,
                seeds=seeds,
                x0s=x0s,
                steps=case.steps or declared.steps,
                faults=case.faults,
                log=case.log,
            )
        )
    return made


def _x0s(declared: Declaration, case: Case, plant: Plant, where: str) -> list[list[float] | None]:
    if case.x0s == "default":
        return [None]
    starts, key = declared.x0s[case.x0s], f"x0s.{case.x0s}"
    if (starts.points is None) == (starts.grid is None):
        raise ConfigError(f"{where}: {key}: give either points or grid")
    if starts.points is not None:
        for point in starts.points:
            if len(point) != plant.d:
                raise ConfigError(f"{where}: {key}: {point} has {len(point)} entries, not {plant.d}")
        return list(starts.points)
    grid = starts.grid or {}
    for name in grid:
        _known(Path(where), f"{key}.grid", name, list(plant.states))
    made: list[list[float] | None] = []
    for values in itertools.product(*grid.values()):
        x0 = plant.x0.tolist()
        for name, value in zip(grid, values, strict=True):
            x0[plant.states.index(name)] = value
        made.append(x0)
    return made


def _known(path: Path, key: str, name: str, names: list[str]) -> None:
    if name not in names:
        hint = did_you_mean(name, names, f"there are {', '.join(names)}")
        raise ConfigError(f"{path}: {key} = {name!r} is not known; {hint}")


def _merged(tree: dict[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a plain tree with another laid over it."""
    merged = dict(tree)
    for key, value in change.items():
        below = merged.get(key)
        merged[key] = (
            _merged(below if isinstance(below, dict) else {}, value) if isinstance(value, dict) else value
        )
    return merged


def _spread(values: list[Any], count: int) -> list[Any]:
    if len(values) <= count:
        return values
    return [values[round(i * (len(values) - 1) / max(1, count - 1))] for i in range(count)]


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()
