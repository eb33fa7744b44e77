"""The declaration of an experiment: groups of cases, each with a configuration, seeds, initial states and faults."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from lbmpc.plants import Description
from node_runtime.config.loading import from_tree
from node_runtime.config.sections import Config, Count, Section
from node_runtime.config.shipped import config_file
from node_runtime.config.strict import ConfigError, did_you_mean, load_tree, strict
from tandem.experiments.simulation import wave
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.study.isolated import Limits

Picture = Literal["episodes", "trajectories", "states", "survival", "lemma", "recovery", "rows"]
ORACLE = "controller.oracle"
ORACLES = {
    "linear": "linear MPC",
    "constant": "constant ĥ",
    "l2nw": "L2NW",
    "dnn": "network",
    "perfect": "true h",
}
"""Names of the oracles in the report."""
STEPS = 200
Name = Annotated[str, msgspec.Meta(pattern=r"^[^/\\]{1,60}$")]


class Starts(Section, frozen=True):
    """Initial states: a list of points, or a grid."""

    points: list[list[float]] | None = None
    """Points, each (d,), plant units."""
    grid: dict[str, list[float]] | None = None
    """Values by state name, for every combination; other states have the values of the plant's x0."""


class Runs(Section, frozen=True, kw_only=True):
    """Settings of runs. A case, its group and the experiment may set them; the innermost setting has precedence."""

    config: str | None = None
    """Base: the name of a shipped configuration, or a file, relative to the experiment's or to the current folder."""
    set: dict[str, Any] = msgspec.field(default_factory=dict)
    """Changes of the configuration, as a table of the same form. Those of a case override its group's, and so on."""
    seeds: list[Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]] | Count | None = None
    """Seeds, or their number from 0; 1 by default. A case without random numbers uses only the first."""
    steps: Count | None = None
    """Ticks of an episode; 200 by default."""
    episodes: Count | None = None
    """Number of starts of the plant with the memory kept; 1 by default."""
    faults: Faults | None = None
    set_points: dict[str, list[float]] | None = None
    """Set-points by state name: values of equal duration within `steps` ticks, repeated in every episode. The plant is
    not reset between episodes, so an episode is a cycle."""


class Group(Runs, frozen=True, kw_only=True):
    """Cases that are shown in one table."""

    name: Name
    title: str
    about: str = ""
    """The question of the group in a few sentences, shown above the table."""
    picture: Picture = "rows"
    reference: str | None = None
    """The reference case of the comparison below the table."""
    x0s: Name = "default"
    """A name of [x0s]; "default" is the configuration's own x0."""


class Case(Runs, frozen=True, kw_only=True):
    name: Name
    group: Name
    label: str = ""
    """Title in the report; by default the name."""
    vary: dict[str, list[Any]] = msgspec.field(default_factory=dict)
    """Values by "section.key"; each combination is a case."""
    x0s: Name | None = None
    """Name of its initial states, if not those of its group."""
    log: bool = False
    """Keep the MCAP log of every run from the default x0."""
    quick: bool = True
    """Whether --quick runs it."""


class Quick(Section, frozen=True):
    """Limits of each case with --quick."""

    seeds: Count = 2
    x0s: Count = 3
    values: Count = 3
    """Number of values of each `vary`: the first, the last and some between; oracles are all kept."""
    episodes: Count = 2


class Declaration(Runs, frozen=True, kw_only=True):
    """The declaration in the file."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
    title: str
    about: str = ""
    x0s: dict[str, Starts] = msgspec.field(default_factory=dict)
    quick: Quick = Quick()
    limits: Limits = Limits()
    group: list[Group]
    case: list[Case]


class Resolved(msgspec.Struct, frozen=True, kw_only=True):
    """One case, ready to run. `config_of` gives the configuration for a seed and an initial state."""

    name: str
    group: str
    label: str
    family: str
    """The label without the last varied value, which neighbouring cases share."""
    config: Config
    varied: dict[str, Any]
    """Values of the declaration's `vary` in this case."""
    words: dict[str, str]
    """The same values as texts of the report."""
    seeds: list[int]
    x0s: list[list[float] | None]
    steps: int
    episodes: int
    faults: Faults
    set_points: dict[str, list[float]] | None
    log: bool

    @property
    def draws(self) -> bool:
        """Whether two seeds give two different runs."""
        return _draws(self.config)

    def config_of(self, seed: int, x0: list[float] | None) -> Config:
        plant = self.config.plant if x0 is None else msgspec.structs.replace(self.config.plant, x0=x0)
        return msgspec.structs.replace(self.config, seed=seed, plant=plant)


def load(path: Path) -> Declaration:
    """Read an experiment.

    Raises:
        ConfigError: the file is invalid; the message names the key and the nearest valid one.
    """
    declared = strict(load_tree(path), Declaration, str(path))
    groups = [group.name for group in declared.group]
    for i, case in enumerate(declared.case):
        _known(path, f"case[{i}].group", case.group, groups)
        _known(path, f"case[{i}].x0s", case.x0s or "default", ["default", *declared.x0s])
    for i, group in enumerate(declared.group):
        _known(path, f"group[{i}].x0s", group.x0s, ["default", *declared.x0s])
    for names, what in ((groups, "group"), ([case.name for case in declared.case], "case")):
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ConfigError(f"{path}: two [[{what}]] are called {twice[0]!r}")
    return declared


def resolve(declared: Declaration, plant: Description, where: str, quick: bool = False) -> list[Resolved]:
    """Return every case with its configuration. Raises `ConfigError`, as `load` does."""
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


def config_of(levels: Sequence[Runs], varied: Mapping[str, Any], where: str, folder: Path) -> Config:
    """Return the configuration of an experiment, a group or a case, with the varied values.

    where: for messages; folder: that of the experiment, to which its references are relative.

    Raises:
        ConfigError: the base configuration does not exist, or the changes do not fit it.
    """
    name = _said(levels, "config", None)
    changes: dict[str, Any] = {}
    for change in (*(level.set for level in levels), *(_below(key, value) for key, value in varied.items())):
        changes = _merged(changes, change)
    try:
        file = None if name is None else _file(name, folder)
        tree = {} if file is None else load_tree(file)
    except ConfigError as error:
        raise ConfigError(f"{where}: config: {error}") from error
    origins = dict.fromkeys(_keys(changes), where)
    return from_tree(_merged(tree, changes), where, origins, file and file.parent, folder)


def _file(name: str, folder: Path) -> Path:
    beside = folder / name
    return beside if beside.is_file() else config_file(name)


def _resolve(
    declared: Declaration, case: Case, plant: Description, where: str, quick: bool
) -> list[Resolved]:
    group = next(group for group in declared.group if group.name == case.group)
    levels = (declared, group, case)
    named = _said(levels, "seeds", 1)
    seeds = named if isinstance(named, list) else list(range(named))
    x0s = _x0s(declared, case.x0s or group.x0s, plant, where)
    episodes = _said(levels, "episodes", 1)
    faults, set_points = _said(levels, "faults", Faults()), _said(levels, "set_points", None)
    if set_points is not None:
        wave.require_fit(set_points, plant, f"{where}: case {case.name!r}: set_points")
    vary = case.vary
    if quick:
        few = declared.quick
        seeds, x0s = seeds[: few.seeds], x0s[: few.x0s]
        episodes = min(episodes, few.episodes)
        vary = {key: values if key == ORACLE else _spread(values, few.values) for key, values in vary.items()}
    made = []
    for values in itertools.product(*vary.values()):
        varied = dict(zip(vary, values, strict=True))
        config = config_of(levels, varied, f"{where}: case {case.name!r}", Path(where).parent)
        names = ", ".join(f"{key.rpartition('.')[2]} = {_shown(value)}" for key, value in varied.items())
        words = {key: _words(key, value) for key, value in varied.items()}
        made.append(
            Resolved(
                name=f"{case.name}: {names}" if names else case.name,
                group=case.group,
                label=_label(case, list(words.values())),
                family=_label(case, list(words.values())[:-1]),
                config=config,
                varied=varied,
                words=words,
                seeds=seeds if _draws(config) else seeds[:1],
                x0s=x0s,
                steps=_said(levels, "steps", STEPS),
                episodes=episodes,
                faults=faults,
                set_points=set_points,
                log=case.log,
            )
        )
    return made


def _draws(config: Config) -> bool:
    return config.controller.oracle == "dnn" or config.plant.sensors.random


def _said(levels: Sequence[Runs], key: str, otherwise: Any) -> Any:
    """Return the innermost setting of a key of `Runs`."""
    said = [getattr(level, key) for level in levels]
    return next((value for value in reversed(said) if value is not None), otherwise)


def _x0s(declared: Declaration, name: str, plant: Description, where: str) -> list[list[float] | None]:
    if name == "default":
        return [None]
    starts, key = declared.x0s[name], f"x0s.{name}"
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
    """Return a copy of a plain tree, with the values of another one over it."""
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


def _below(key: str, value: Any) -> Any:
    """Return a plain tree that contains only the value at "section.key"."""
    for name in reversed(key.split(".")):
        value = {name: value}
    return value


def _keys(tree: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """Yield every "section.key" of a plain tree, and the sections."""
    for name, value in tree.items():
        yield above + name
        if isinstance(value, dict):
            yield from _keys(value, f"{above}{name}.")


def _label(case: Case, words: list[str]) -> str:
    return ": ".join(filter(None, (case.label, ", ".join(words)))) or case.name


def _words(key: str, value: Any) -> str:
    """Return a value as text for the report; an oracle and a table of values need no key."""
    if key == ORACLE:
        return ORACLES.get(value, value)
    if isinstance(value, dict):
        return ", ".join(f"{name} = {_shown(below)}" for name, below in value.items())
    return f"{key.rpartition('.')[2]} = {_shown(value)}"


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()
