"""A run in memory: every message decoded, with its exact bytes. It is read from a log, or made without a file."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

import node_runtime.config.plant
from lbmpc.plants import PLANTS, Known, Plant, TrueMotion, get_plant, get_truth
from node_runtime.config.reference import is_reference
from node_runtime.config.sections import Config, PlantConfig
from node_runtime.config.strict import ConfigError
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from run_log.errors import LogError

M = TypeVar("M", bound=m.Message)


@dataclass(frozen=True)
class Entry(Generic[M]):
    """One message as it was logged."""

    log_time: int
    """Nanoseconds; Unix time of arrival for a live run, virtual time for a simulated one."""
    payload: bytes
    message: M


class Messages(Generic[M]):
    """An attribute of a `Run` with the messages of one topic, or of several in the order of their times."""

    def __init__(self, *of: Topic):
        self._of = of

    def __get__(self, run: Run, owner: type[Run]) -> list[M]:
        entries = [entry for topic in self._of for entry in run.entries(topic)]
        if len(self._of) > 1:
            entries.sort(key=lambda entry: entry.log_time)
        return [entry.message for entry in entries]


@dataclass
class Run:
    """The content of a log. The lists are in the order of the log; `entries` has the bytes as well."""

    path: Path
    config: Config
    attachments: dict[str, bytes] = field(default_factory=dict)
    streams: dict[str, list[Entry[Any]]] = field(default_factory=dict)
    """By topic name."""
    bad: dict[str, int] = field(default_factory=dict)
    """Number of logged payloads that are not valid messages, by topic and reason."""
    strangers: dict[str, int] = field(default_factory=dict)
    """Number of messages on unknown keys, by key."""
    user: dict[str, list[tuple[int, bytes]]] = field(default_factory=dict)
    """Messages on user topics, by key: (log_time in ns, bytes). A controller does not depend on them."""
    truncated: bool = False
    recovered: bool = False
    part: int = 1
    """Number of this part among the parts of its run (`run_log.writing.parts`)."""
    continued: str | None = None
    """Name of the next part; None: this is the last, or was cut off."""
    note: str = ""
    """Notes on the file for a person, for example where it was cut off."""
    plant: Known | None = None
    """The controllers' numbers of the plant; None: the log has none."""
    files: dict[str, str] = field(default_factory=dict)
    """The sha256 of the files that its configuration named, by key."""
    truth: Known | Plant | TrueMotion | None = None
    """The true motion of the plant; None for a log, which does not contain it."""
    named: Known | Plant | None = None
    """The plant that the reader of the log named."""

    plant_states = Messages[m.PlantState](topics.PLANT_STATE)
    commands = Messages[m.Command](topics.COMMAND)
    ticks = Messages[m.Tick](topics.TICK)
    results = Messages[m.TickResult](topics.RESULT)
    timings = Messages[m.TickTiming](topics.TIMING)
    output_weights = Messages[m.OutputWeights](topics.OUTPUT_WEIGHTS)
    hidden_weights = Messages[m.HiddenWeights](topics.HIDDEN_WEIGHTS)
    keyframes = Messages[m.Keyframe](topics.KEYFRAME)
    health = Messages[m.Health](*topics.HEALTH.values())
    _sample_batches = Messages[m.Samples](topics.SAMPLES)
    _all_run_infos = Messages[m.RunInfo](*topics.RUN_INFO.values())

    def entries(self, topic: Topic) -> list[Entry[Any]]:
        return self.streams.get(topic.name, [])

    @property
    def samples(self) -> list[m.Sample]:
        return [sample for batch in self._sample_batches for sample in batch.samples]

    @property
    def run_infos(self) -> list[m.RunInfo]:
        """The first entry of each process incarnation."""
        first: dict[str, m.RunInfo] = {}
        for info in self._all_run_infos:
            first.setdefault(info.run_id, info)
        return list(first.values())

    @property
    def controllers(self) -> list[str]:
        """Runs with ticks, in order, without strangers.

        A stranger sent no info, health or keyframe, or none of its results belongs to one of its ticks by the checksum
        in the result. If that holds for every run, none counts as a stranger.
        """
        spoke = {x.run_id for x in (*self.run_infos, *self.health, *self.keyframes)}
        sums: dict[tuple[str, int], set[int]] = {}
        for entry in self.entries(topics.TICK):
            sums.setdefault((entry.message.run_id, entry.message.seq), set()).add(zlib.crc32(entry.payload))
        answered = {r.run_id for r in self.results if r.tick_crc32 in sums.get((r.run_id, r.seq), ())}
        ticked = list(dict.fromkeys(run_id for run_id, _seq in sums))
        known = [run_id for run_id in ticked if run_id in spoke]
        return [run_id for run_id in known if run_id in answered] or known or ticked

    @property
    def ends_within(self) -> bool:
        """Whether the log ends while its run continues: the last tick may lack some of its messages."""
        return self.truncated or self.recovered or self.continued is not None

    @property
    def unreadable(self) -> str:
        """End of a sentence about missing messages: they may be in the log as invalid ones."""
        found = ", ".join(f"{count} {what}" for what, count in self.bad.items())
        return f". In the log but not readable: {found}" if found else ""


def gather(config: Config, messages: Iterable[tuple[Topic, m.Message, int]], path: str | Path = "") -> Run:
    """Make a `Run` of messages that were never in a file: (topic, message, log_time in ns)."""
    run = Run(Path(path), config)
    for topic, message, log_time in messages:
        run.streams.setdefault(topic.name, []).append(Entry(log_time, codec.encode(message), message))
    return run


def recorded_plant(run: Run, config: Config) -> Known | Plant | None:
    """Return the plant's numbers in the log, or the plant file that the reader named; None for a plant of Tandem.

    config: the log's, or that of one of its controllers.

    Raises:
        LogError: the plant is not known.
    """
    known, model = run.plant or run.named, config.plant.model
    if known is None and is_reference(model):
        raise LogError(
            f"{run.path}: its plant, {model}, is not in the log, and Tandem loads no file because a log names it; "
            "if you have that file, add --plant FILE:NAME"
        )
    return known


def as_logged(run: Run, config: Config, changed: Collection[str] = ()) -> Config:
    """Return `config` without the values that the log's numbers contain, except for the changed keys."""
    if run.plant is None or "plant" in changed:
        return config
    held = {
        name: getattr(PlantConfig(), name)
        for name in ("bounds", "x_e", "u_e")
        if not any(f"{key}.".startswith(f"plant.{name}.") for key in changed)
    }
    return msgspec.structs.replace(config, plant=msgspec.structs.replace(config.plant, **held))


def plant_of(run: Run) -> Known | Plant:
    """Return the plant of the run from its log; if the log does not contain it, Tandem's plant of that name.

    No file is loaded because a log names it.

    Raises:
        LogError: the log does not contain its plant, and this Tandem does not have it or cannot use it.
    """
    known = recorded_plant(run, run.config)
    try:
        return node_runtime.config.plant.plant_of(as_logged(run, run.config), get_plant, known)
    except ConfigError as error:
        end = "" if known is not None else " The log needs the plant with which it was recorded."
        raise LogError(f"{run.path}: {error}{end}") from error


def equations_of(run: Run, config: Config) -> Plant | None:
    """Return the equations from which the plant was linearised, if Tandem or the named plant file has them.

    Args:
        run: a log.
        config: the configuration for them.

    Raises:
        ConfigError: they do not fit the configuration.
    """
    found = PLANTS.get(config.plant.model) if run.named is None else run.named
    if not isinstance(found, Plant):
        return None
    equations = node_runtime.config.plant.plant_of(config, get_plant, found)
    return equations if isinstance(equations, Plant) else None


def true_plant_of(run: Run) -> Known | Plant | TrueMotion | None:
    """Return the true plant: `equations_of` with `plant.truth`; None if it is not known here.

    Raises:
        LogError: the plant has no such parameters.
    """
    if run.truth is not None:
        return run.truth
    try:
        equations = equations_of(run, run.config)
        if equations is None or isinstance(run.config.plant.truth, str):
            return None
        return node_runtime.config.plant.true_plant_of(run.config, get_plant, get_truth, equations)
    except ConfigError as error:
        raise LogError(f"{run.path}: {error}") from error
