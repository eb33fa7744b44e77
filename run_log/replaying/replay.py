"""`tandem replay`: run the recorded ticks through a fresh controller, and compare its output byte for byte."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from controller_node.certified_sets import CertifiedSets
from controller_node.core import ControllerCore, sha256_of_known
from network_model.registry import register
from node_runtime.config.architecture import OwnArchitecture, register_architecture
from node_runtime.config.loading import override
from node_runtime.config.reference import is_reference
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError, apply_override
from node_runtime.provenance import versions
from node_runtime.realtime.scheduling import one_blas_thread
from protocol import codec, topics
from run_log.errors import LogError
from run_log.named_plant import given_plant
from run_log.replaying.comparison import Comparison, Difference
from run_log.replaying.recorded import RecordedController, recorded_controllers
from run_log.replaying.segments import replayable
from run_log.run import Run

ROUNDING = 1e-7
"""Units of u: largest difference of the inputs of a log from another machine or build."""
SAID = ("machine", "processor", "kernels", "blas")
"""Facts about the arithmetic of a log's machine, beside versions; a log may lack them."""
Progress = Callable[[int, int], None]


class ReplayResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a replay. Equal means: every command, backup, result, output weight and keyframe, every byte."""

    ticks: int
    """Number of replayed and compared ticks."""
    equal: bool
    first_difference: Difference | None
    differing_ticks: int
    largest_difference: float | None
    """Largest |recorded - replayed| among the inputs of all plans, in units of u; null if sizes differ."""
    keyframes: int
    """Number of compared keyframes."""
    first_tick: int
    """Start of the replay: the tick after a keyframe."""
    run_ids: list[str]
    rounding: bool
    """Whether the replay is not equal, but no input of a plan differs by more than `ROUNDING`."""
    elsewhere: bool | None
    """Whether the log was recorded with another processor, BLAS kernel, compiler or version; None if the log lacks some
    of these facts and the others are equal."""
    lost_ticks: int
    """Ticks that could not be replayed or not be compared completely: the log lacks them, or their initial memory."""
    notes: list[str]
    """Notes for a person: other versions, changed settings, an incomplete last tick."""


def replay(
    run: Run,
    from_tick: int | None = None,
    overrides: Sequence[str] = (),
    progress: Progress | None = None,
    architecture: OwnArchitecture | None = None,
) -> ReplayResult:
    """Replay every controller run of a log from the log alone, or with the user's architecture file.

    Args:
        run: a log, as read.
        from_tick: begin at the nearest keyframe before this tick; None: at the first tick.
        overrides: `section.key=value`, to see the effect of a change.
        progress: called with (ticks done, ticks in all).
        architecture: the user's file with the log's network; no file is loaded because a log names it.

    Raises:
        LogError: no tick can be replayed, messages are recorded twice or do not fit the plant, or the log's
            configuration does not give a controller.
        ConfigError: an override cannot be applied.
    """
    recorded = recorded_controllers(run)
    if not recorded:
        raise LogError(
            f"{run.path}: contains no tick of a controller; there is nothing to replay{run.unreadable}"
        )
    if from_tick is not None:
        inside = [r for r in recorded if 0 <= from_tick <= r.last]
        if not inside:
            ranges = ", ".join(f"{min(r.ticks)} to {r.last}" for r in recorded)
            raise LogError(f"{run.path}: there is no tick {from_tick}; the log has {ranges}")
        recorded = inside
    segments = [replayable(run, r, from_tick) for r in recorded]
    gaps = [note for found in segments for note in found.notes]
    total = sum(end - begin for found in segments for begin, end in found.ranges)
    if not total:
        raise LogError(f"{run.path}: no tick can be replayed: {'; '.join(gaps)}{run.unreadable}")
    comparison, arithmetic = Comparison(), versions()
    for r, found in zip(recorded, segments, strict=True):
        with one_blas_thread():
            core = _core(run, r, overrides, architecture)
            arithmetic |= core.arithmetic()
            for begin, end in found.ranges:
                _restore(run, r, core, begin, comparison)
                for seq in range(begin + 1, end + 1):
                    _replay_tick(run, r, core, seq, comparison)
                    if progress is not None:
                        progress(comparison.ticks, total)
    differs, unsaid = _foreign(run, recorded, arithmetic)
    equal, largest = comparison.first is None, comparison.largest
    return ReplayResult(
        ticks=comparison.ticks,
        equal=equal,
        first_difference=comparison.first,
        differing_ticks=sum(tick >= 0 for _, tick in comparison.differing),
        largest_difference=largest,
        keyframes=comparison.keyframes,
        first_tick=segments[0].start + 1,
        run_ids=[r.run_id for r in recorded],
        rounding=not equal and largest is not None and largest <= ROUNDING,
        elsewhere=True if differs else None if unsaid else False,
        lost_ticks=sum(found.lost for found in segments),
        notes=_notes(run, recorded, overrides)
        + _other_text(run, recorded, architecture)
        + _where(differs, unsaid, equal)
        + gaps,
    )


def _core(
    run: Run, recorded: RecordedController, overrides: Sequence[str], own: OwnArchitecture | None
) -> ControllerCore:
    config = override(recorded.config, list(overrides)) if overrides else recorded.config
    _know_architecture(run, recorded, config, own)
    sets = _sets_for(run, recorded, config)
    changed = {apply_override({}, text) for text in overrides}
    hint = ""
    try:
        given = given_plant(run, config, changed)
        if given.equations is None and is_reference(config.plant.model):
            hint = "; --plant FILE:NAME gives the replay the equations of its plant"
        elif isinstance(config.plant.truth, str) and given.truth is None:
            hint = "; --set plant.truth=FILE:NAME gives the replay its true plant"
        return ControllerCore(config, recorded.run_id, sets, given)
    except ConfigError as error:
        if overrides:
            raise ConfigError(f"{error}{hint}") from error
        raise LogError(f"{run.path}: its configuration does not give a controller: {error}{hint}") from error


def _know_architecture(
    run: Run, recorded: RecordedController, config: Config, own: OwnArchitecture | None
) -> None:
    reference = config.network.architecture
    if config.controller.oracle != "dnn":
        return
    if reference != recorded.config.network.architecture:
        # Named by the person who replays.
        register_architecture(config)
    elif own is not None and not is_reference(reference):
        raise LogError(
            f"{run.path}: its network is Tandem's own {reference}; --set network.architecture shows what another "
            "would have done"
        )
    elif own is not None:
        # Under its name in the log, so that a file with a changed comment replays byte for byte.
        recorded_name = recorded.architecture if is_reference(recorded.architecture) else own.name
        register(reference, recorded_name, own.architecture)
    elif is_reference(reference):
        name = (recorded.architecture or Path(reference).name).partition("@")[0]
        raise LogError(
            f"{run.path}: its network is {name}, and Tandem loads no file because a log names it: add --architecture "
            f"{name}, with the path to it"
        )


def _other_text(run: Run, recorded: list[RecordedController], own: OwnArchitecture | None) -> list[str]:
    then = {r.architecture for r in recorded if r.architecture}
    if own is None or then <= {own.name}:
        return []
    return [
        f"recorded with {', '.join(sorted(then))}, replayed with {own.name}: the content of the file differs"
    ]


def _replay_tick(
    run: Run, recorded: RecordedController, core: ControllerCore, seq: int, comparison: Comparison
) -> None:
    tick = recorded.ticks[seq].message
    if tick.state is not None:
        try:
            codec.check_dimensions(topics.PLANT_STATE, tick.state, core.plant.d, core.plant.m)
        except codec.BadMessage as error:
            raise LogError(f"{run.path}: tick {seq} does not fit the plant: {error}") from error
    outputs = core.step(tick)
    if seq in recorded.commands:
        comparison.compare(recorded.commands[seq], outputs.command, "command")
        comparison.measure(recorded.commands[seq].message, outputs.command)
    if seq in recorded.backups:
        comparison.compare(recorded.backups[seq], core.backup(outputs.command), "backup")
    if seq in recorded.results:
        comparison.compare(recorded.results[seq], outputs.result, "result")
    if seq in recorded.weights and outputs.output_weights is not None:
        comparison.compare(recorded.weights[seq], outputs.output_weights, "output_weights")
    if seq in recorded.keyframes:
        comparison.compare_keyframe(recorded.keyframes[seq], core.memory.keyframe(seq))
    comparison.ticks += 1


def _restore(
    run: Run, recorded: RecordedController, core: ControllerCore, start: int, comparison: Comparison
) -> None:
    """Put the core into the state of the log's keyframe."""
    entry = recorded.keyframes[start]
    if start == -1 and not entry.message.resumed:
        # The memory before the first tick follows from the configuration and the seed: that is compared too.
        comparison.compare_keyframe(entry, core.memory.keyframe(-1))
    try:
        core.memory.restore(entry.message)
    except ValueError as error:
        if start == -1 and not entry.message.resumed:
            return  # a difference, and already noted; a changed configuration begins with its own memory
        hint = "; from the first tick on, the changed configuration starts with a new memory"
        raise LogError(f"{run.path}: {error}{hint if core.config != recorded.config else ''}") from error


def _sets_for(run: Run, recorded: RecordedController, config: Config) -> CertifiedSets | None:
    """Return the certified sets in use; None: there were none, or the changed configuration names others."""
    then = recorded.config.controller
    if config.controller.tightening != "invariant" or config.controller.sets != then.sets:
        return None
    if then.tightening == "invariant" and recorded.sets is None:
        raise LogError(
            f"{run.path}: the certified sets of {recorded.run_id} are not in the log: its recorder began after the "
            f"controller{run.unreadable}"
        )
    return recorded.sets


def _notes(run: Run, recorded: list[RecordedController], overrides: Sequence[str]) -> list[str]:
    notes = [f"changed: {' '.join(overrides)}"] if overrides else []
    if run.note:
        notes.append(run.note)
    strangers = {tick.run_id for tick in run.ticks} - set(run.controllers)
    if strangers:
        notes.append(
            "not replayed, because it did not identify itself or its results do not belong to its ticks: "
            f"{', '.join(sorted(strangers))}"
        )
    for r in recorded:
        if -1 in r.keyframes and (before := r.keyframes[-1].message.resumed):
            notes.append(f"{r.run_id}: continues from the memory of {before}, read from a checkpoint")
        if run.plant is not None and r.known and r.known != sha256_of_known(run.plant):
            notes.append(
                f"{r.run_id}: had another plant than the recorder, and the recorder's is used here: "
                "the plant file changed between the starts"
            )
        if not r.complete:
            notes.append(f"{r.run_id}: the log ends before the run does; replayed up to tick {r.last}")
    return notes


def _foreign(
    run: Run, recorded: list[RecordedController], here: dict[str, str]
) -> tuple[list[str], list[str]]:
    """Versions and arithmetic that differ between log and machine, and the facts of `SAID` that the log lacks."""
    differs: list[str] = []
    said: set[str] = set()
    runs = {r.run_id for r in recorded}
    for info in run.run_infos:
        if info.run_id in runs:
            said |= info.versions.keys()
            differs += [
                f"{name} {then} (here {here[name]})"
                for name, then in info.versions.items()
                if name in here and here[name] != then
            ]
    return list(dict.fromkeys(differs)), [name for name in SAID if name not in said]


def _where(differs: list[str], unsaid: list[str], equal: bool) -> list[str]:
    notes = []
    if differs:
        end = "still equal" if equal else f"equal to about {ROUNDING:g} at best, not to the byte"
        notes.append(f"recorded with {', '.join(differs)}: {end}")
    if unsaid and not equal:
        notes.append(
            f"the log does not contain its {', '.join(unsaid)}, so it is not known whether it was "
            "recorded on this machine"
        )
    return notes
