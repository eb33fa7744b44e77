"""Configuration: typed, strict, one tree for all processes, read from TOML.

A misspelt key, a wrong type or a value out of range raises `ConfigError`, which names the key, the file and the
nearest right key or the allowed values. Defaults are the paper's experiment as `../shared/paper` settles it.
"""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from protocol.network import Activation

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
PositiveInt = Annotated[int, msgspec.Meta(ge=1)]
Unit = Annotated[float, msgspec.Meta(gt=0, lt=1)]
OracleName = Literal["linear", "l2nw", "dnn"]
TighteningName = Literal["none", "first_step", "tube"]
Strategy = Literal["fifo", "reservoir", "novelty"]


class ConfigError(ValueError):
    """A configuration that cannot be used; the text says what, where and what would be right."""


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the configuration file."""


class PlantConfig(Section):
    model: str = "moore_greitzer"
    x0: list[float] | None = None
    """Initial state in the plant's own units; None: the plant's own (the paper's) x0."""
    plan_patience: Positive = 1.5
    """Periods without a fresh command after which the plant follows the last plan's next entry."""


class SolverConfig(Section):
    max_iterations: PositiveInt = 10
    tolerance: Positive = 1e-6
    """Converged when no input of the plan moves by more than this (input units)."""
    penalty: Positive = 1e4
    """Exact-penalty weight on soft state constraints, per unit of violation relative to the row's range."""


class ControllerConfig(Section):
    horizon: PositiveInt = 60
    oracle: OracleName = "dnn"
    tightening: TighteningName = "first_step"
    W: list[NonNegative] | None = None
    """Half-widths of the disturbance box used for tightening; None: the plant's own."""
    Q: list[NonNegative] | None = None
    """Diagonal state weights; None: ones."""
    R: list[Positive] | None = None
    """Diagonal input weights; None: ones."""
    keyframe_every: PositiveInt = 100
    """Ticks between keyframes in the log."""
    late_fraction: Unit = 0.2
    """A tick is late when it starts later than this share of a period after its slot."""
    phase_ms: NonNegative = 1.0
    """How long after a plant sample is due the controller's slot lies."""
    solver: SolverConfig = SolverConfig()


class NetworkConfig(Section):
    hidden: list[Annotated[int, msgspec.Meta(ge=1, le=4096)]] = msgspec.field(default_factory=lambda: [32, 32])
    activation: Activation = "tanh"
    """Of every hidden layer; must be bounded, since the last one is."""
    output_scale: Positive = 0.01
    """Units of h that count as 1 for the network."""
    max_layer_norm: Positive = 100.0


class AdaptationConfig(Section):
    gamma: Unit = 0.5
    """Learning rate of the last layer, 0 < gamma < 1."""
    column_bound: Positive = 0.05
    """Bound on the norm of each column of K, in units of h."""
    initial_scale: NonNegative = 1e-3
    """Standard deviation of the entries of K_0, in units of h."""


class L2nwConfig(Section):
    window: PositiveInt = 100
    bandwidth: Positive = 0.5
    regularisation: Positive = 1e-3
    variables: list[str] | None = None
    """Names of the states and inputs the kernel sees; None: the plant's own choice."""


class TrainerConfig(Section):
    enabled: bool = True
    """False: hidden layers are never trained (last layer only)."""
    capacity: PositiveInt = 2000
    """p_max of the replay buffer."""
    strategy: Strategy = "fifo"
    train_every: PositiveInt = 20
    """New samples between two trainings."""
    min_samples: PositiveInt = 20
    batch: PositiveInt = 512
    """M, the samples drawn at random from the buffer for one training."""
    steps: PositiveInt = 200
    """Adam steps in one training, each on all M samples."""
    learning_rate: Positive = 1e-3
    device: Literal["auto", "cpu", "cuda"] = "auto"


class BusConfig(Section):
    endpoint: str = "tcp/127.0.0.1:7447"
    """Where the router listens; nodes are its clients."""
    lease_ms: PositiveInt = 1500
    follow_silence: Positive = 1.0
    """Seconds of silence after which another process incarnation may take over a topic."""


class LogConfig(Section):
    path: str = "run.mcap"
    chunk_bytes: PositiveInt = 256 * 1024
    flush_ms: PositiveInt = 500


class RealtimeConfig(Section):
    priority: Annotated[int, msgspec.Meta(ge=0, le=99)] = 50
    """SCHED_FIFO priority of controller and plant; 0: leave the scheduler alone."""


class Config(Section):
    """The whole tree; `rate` is the one sampling rate of plant, model and controller."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{1,40}$")] = "jet1"
    """The plant's name, part of every key."""
    rate: Positive = 20.0
    """Samples a second (Hz)."""
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    plant: PlantConfig = PlantConfig()
    controller: ControllerConfig = ControllerConfig()
    network: NetworkConfig = NetworkConfig()
    adaptation: AdaptationConfig = AdaptationConfig()
    l2nw: L2nwConfig = L2nwConfig()
    trainer: TrainerConfig = TrainerConfig()
    bus: BusConfig = BusConfig()
    log: LogConfig = LogConfig()
    realtime: RealtimeConfig = RealtimeConfig()

    @property
    def period(self) -> float:
        """Seconds between samples."""
        return 1.0 / self.rate


def load(path: str | Path | None = None, overrides: list[str] | None = None) -> Config:
    """Read a TOML file (None: all defaults) and apply `section.key=value` overrides on top.

    Raises:
        ConfigError: unreadable file, TOML syntax, unknown key, wrong type, value out of range.
    """
    where = str(path) if path is not None else "the defaults"
    tree: dict[str, Any] = {}
    if path is not None:
        try:
            tree = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: not valid TOML: {error}") from error
    for override in overrides or []:
        _apply(tree, override)
        where = f"{path or 'defaults'} with {override}" if overrides and len(overrides) == 1 else where
    return from_tree(tree, where)


def from_tree(tree: dict[str, Any], where: str = "configuration") -> Config:
    """Convert a plain tree to a `Config`. Raises `ConfigError`."""
    _reject_unknown(tree, Config, where, "")
    try:
        config = msgspec.convert(tree, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {_readable(str(error))}") from error
    from protocol.network import BOUNDED

    if config.network.activation not in BOUNDED:
        raise ConfigError(
            f"{where}: network.activation = {config.network.activation!r} is unbounded; one of {', '.join(BOUNDED)}"
        )
    if config.trainer.min_samples > config.trainer.capacity:
        raise ConfigError(f"{where}: trainer.min_samples exceeds trainer.capacity ({config.trainer.capacity})")
    return config


def from_json(text: str) -> Config:
    """The inverse of `to_json`: a configuration as a log carries it. Raises `ConfigError`."""
    try:
        tree = msgspec.json.decode(text)
    except msgspec.DecodeError as error:
        raise ConfigError(f"the log's configuration is not valid JSON: {error}") from error
    if not isinstance(tree, dict):
        raise ConfigError("the log's configuration is not a table")
    return from_tree(tree, "the log's configuration")


def to_json(config: Config) -> str:
    return msgspec.json.encode(config).decode()


def to_tree(config: Config) -> dict[str, Any]:
    """Plain dictionaries and lists, in the order of the declaration."""
    return msgspec.to_builtins(config)


def override(config: Config, assignments: list[str]) -> Config:
    """A copy with `section.key=value` assignments applied. Raises `ConfigError`."""
    tree = to_tree(config)
    for assignment in assignments:
        _apply(tree, assignment)
    return from_tree(tree, " ".join(assignments) or "configuration")


def _apply(tree: dict[str, Any], assignment: str) -> None:
    key, separator, text = assignment.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"{assignment!r}: an override is written section.key=value")
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    *tables, last = key.strip().split(".")
    for table in tables:
        child = tree.setdefault(table, {})
        if not isinstance(child, dict):
            raise ConfigError(f"{assignment!r}: {table} is a value, not a table")
        tree = child
    tree[last] = value


def _sections(kind: type) -> dict[str, type]:
    return {
        f.name: f.type
        for f in msgspec.structs.fields(kind)
        if isinstance(f.type, type) and issubclass(f.type, msgspec.Struct)
    }


def _reject_unknown(tree: dict[str, Any], kind: type, where: str, path: str) -> None:
    """msgspec would reject unknown keys too, but cannot say which key was meant."""
    known = [f.name for f in msgspec.structs.fields(kind)]
    sections = _sections(kind)
    for key, value in tree.items():
        full = f"{path}.{key}" if path else key
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
            hint = f"did you mean {(path + '.' if path else '') + near[0]!r}?" if near else f"known: {', '.join(known)}"
            raise ConfigError(f"{where}: unknown key {full!r}; {hint}")
        if key in sections and isinstance(value, dict):
            _reject_unknown(value, sections[key], where, full)


def _readable(text: str) -> str:
    """msgspec says "Expected `int` >= 1 - at `$.trainer.batch`"; put the key first."""
    message, _, place = text.partition(" - at `$")
    key = place.rstrip("`").lstrip(".") or "the file"
    return f"{key}: {message[:1].lower()}{message[1:]}"
