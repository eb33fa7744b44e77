"""Every reader of bytes from outside, as one function each: it accepts, or raises what it declares."""

from __future__ import annotations

import gzip
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from controller_node.asked import verdict_on
from controller_node.build import build_model, build_plant
from controller_node.certified_sets import CertifiedSets, Found
from controller_node.codegen.compiler import SEAL, is_sealed, sealed
from controller_node.core import ControllerCore
from controller_node.outbox import Outbox
from lbmpc.model import ModelError
from lbmpc.model import build_model as nominal_model
from lbmpc.sets.certificate import CertificateError, encode
from network_model.description import NetworkDescription
from node_runtime.bus.batches import unbatch
from node_runtime.bus.mailbox import Delivery
from node_runtime.config.loading import from_json, from_tree, to_json, to_toml
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.rejected import RejectedMessages
from plant_sim.hand import Hand
from plant_sim.way_back import WayBack
from protocol import codec, topics
from protocol import messages as m
from protocol.codec import BadMessage
from protocol.topics import Topic
from run_log import plant_record
from run_log.errors import LogError
from run_log.named_plant import given_plant
from run_log.reading.reader import read_run
from run_log.run import Run
from run_log.writing.writer import LogWriter
from verification.fuzz import certified, mutate
from verification.fuzz.mutate import Mutator, Reteller
from verification.fuzz.seeds import ANSWERS, config, seeds

SHARE_OF_SLOW = 0.01
"""Share of the payloads for readers of whole files, which are a thousand times slower than messages."""

LIBRARY = "kernel-0123456789ab.so"

ACCEPTED = ("accepted", "accepted, cut short")
Read = Callable[[bytes], str]
"""Read; return the outcome, one of `ACCEPTED` or the reason, in a few words that can be counted."""


@dataclass(frozen=True)
class Target:
    """One reader."""

    name: str
    read: Read
    make: Callable[[], bytes]
    weight: float
    """Share of the payloads, relative to the others."""


def targets(seed: int, folder: Path) -> list[Target]:
    """Return all targets. folder: place for files of targets that read files."""
    payloads = seeds()
    everything = [payload for known in payloads.values() for payload in known]
    found: list[Target] = []

    def add(name: str, read: Read, known: Sequence[bytes], weight: float, textual: bool = False) -> None:
        mutations = mutate.TEXTUAL if textual else mutate.BINARY
        make = Mutator(known, known if textual else everything, mutations, seed * 1000 + len(found))
        found.append(Target(name, read, make, weight))

    batches = {topic.name for topic in topics.BATCH.values()}
    for topic in (*topics.ALL, *ANSWERS):
        weight = 1.0 if topic.type not in (m.Tick, m.Keyframe) else 0.5
        if topic.name not in batches:
            add(topic.name, _decoding(topic), payloads[topic.name], weight)
    for topic in topics.BATCH.values():
        add(topic.name, _separating(topic), payloads[topic.name], 1.0)
    add("head of a message", _glancing, everything, 0.5)
    settings = config()
    core = ControllerCore(settings, "controller-1")
    add("hidden weights: adoption", _adopting(core), payloads[topics.HIDDEN_WEIGHTS.name], 0.5)
    add("override: at a plant", _driving(core), payloads[topics.OVERRIDE.name], 0.2)
    add("reference: what a plan makes of it", _aiming(core), payloads[topics.REFERENCE.name], 0.2)
    add("keyframe: restored", _restoring(core), payloads[topics.KEYFRAME.name], 0.2)
    add(
        "outbox: a question", _asking(), [b"run=controller-1;since=3;last=10", b"since=-1"], 0.5, textual=True
    )
    described = msgspec.json.encode(core.controller.oracle.description)
    add("network description", _describing, [described], 0.2, textual=True)
    add("configuration, TOML", _configuring, [to_toml(settings).encode(), b"rate = 20\n"], 0.02, textual=True)
    add("configuration, JSON", _reconfiguring, [to_json(settings).encode()], 0.02, textual=True)
    sets = _sets()
    add("certified sets", _certifying, [sets, gzip.compress(sets, mtime=0)], 0.1)
    add("compiled code", _loading, [sealed(b"\x7fELF" + bytes(range(256)), LIBRARY)], 0.2)
    small = certified.small_sets()
    retold = Reteller(encode(small), seed * 1000 + len(found))
    found.append(Target("certified sets, forged", certified.forged(small), retold, SHARE_OF_SLOW))
    states = certified.States(small, seed * 1000 + len(found))
    found.append(Target("a control step with certified sets", certified.asked(small), states, 0.05))
    retold = Reteller(to_json(settings).encode(), seed * 1000 + len(found))
    found.append(Target("configuration of a log, its controller", _building, retold, 0.2 * SHARE_OF_SLOW))
    plant = plant_record.encode(build_plant(settings), {"plant.model": "0" * 64}).encode()
    add("plant of a log", _knowing, [plant], 0.02, textual=True)
    retold = Reteller(plant, seed * 1000 + len(found))
    found.append(Target("plant of a log, its model", _modelling, retold, 2.0 * SHARE_OF_SLOW))
    log = _log(settings, payloads, folder)
    add("log file", _logging(folder / f"fuzzed-{seed}.mcap"), [log], SHARE_OF_SLOW)
    return found


def _decoding(topic: Topic) -> Read:
    def read(payload: bytes) -> str:
        try:
            message = codec.decode(topic, payload)
            codec.check_dimensions(topic, message, 4, 1)
        except BadMessage as error:
            return error.reason
        return "accepted"

    return read


def _glancing(payload: bytes) -> str:
    return "malformed" if codec.head_of(payload) is None else "accepted"


def _separating(topic: Topic) -> Read:
    bad = RejectedMessages()
    key = topic.key("jet1")

    def read(payload: bytes) -> str:
        parts = list(unbatch(Delivery(key, payload, 10**9), bad))
        return "accepted" if parts and parts[0].key != key else "malformed"

    return read


def _adopting(core: ControllerCore) -> Read:
    """From the bus to the controller's memory, through a whole step."""
    before = core.memory.state
    states = [codec.decode(topics.TICK, payload) for payload in seeds()[topics.TICK.name]]
    tick = states[-1]
    assert isinstance(tick, m.Tick)

    def read(payload: bytes) -> str:
        try:
            weights = codec.decode(topics.HIDDEN_WEIGHTS, payload)
        except BadMessage as error:
            return error.reason
        assert isinstance(weights, m.HiddenWeights)
        seen = core.translation.observation(msgspec.structs.replace(tick, weights=weights))
        assert seen.hidden is not None
        _, verdict = core.controller.oracle.adopt(before.oracle, seen.hidden)
        return ACCEPTED[0] if verdict.outcome == "adopted" else _kind(verdict.reason)

    return read


def _driving(core: ControllerCore) -> Read:
    """From the bus to the input of a plant, over the sample behind it."""
    plant, period = core.plant, core.config.period
    way_back = WayBack(core.controller.model, core.config.controller.backup.margin, 60)

    def read(payload: bytes) -> str:
        try:
            override = codec.decode(topics.OVERRIDE, payload)
            codec.check_dimensions(topics.OVERRIDE, override, plant.d, plant.m)
        except BadMessage as error:
            return error.reason
        assert isinstance(override, m.Override)
        hand = Hand(plant, way_back)
        verdict = hand.take(override, 0.0)
        hand.look(plant.x_e, plant.u_e)
        u = hand.input(period)
        if u is not None:
            assert ((u >= plant.u_min) & (u <= plant.u_max)).all(), "outside of U"
        return ACCEPTED[0] if verdict == "ok" else verdict

    return read


def _aiming(core: ControllerCore) -> Read:
    """From the bus to the reference in force, in this tick and after its lease."""
    before, aims = core.memory.state, core.controller.aims
    theta = core.controller.oracle.theta(before.oracle)
    tick = codec.decode(topics.TICK, seeds()[topics.TICK.name][0])
    assert isinstance(tick, m.Tick)

    def read(payload: bytes) -> str:
        try:
            reference = codec.decode(topics.REFERENCE, payload)
        except BadMessage as error:
            return error.reason
        assert isinstance(reference, m.Reference)
        asked = msgspec.structs.replace(tick, reference=reference)
        verdict = verdict_on(reference, core.plant, core.config.period)
        seen = core.translation.observation(asked)
        assert seen.x is not None
        now = aims.latched(before.reference, seen.reference, 0, seen.x, before.target)
        for _ in range(2):
            aim = aims.find(now, theta, before.target, 0.0)
            for array in (aim.xu, aim.xr, aim.ur):
                assert array is None or np.isfinite(array).all()
            now = None if now is None else now.advanced(1 if now.left < 0 else now.left)
        return ACCEPTED[0] if verdict == "taken" else _kind(verdict)

    return read


def _restoring(core: ControllerCore) -> Read:
    def read(payload: bytes) -> str:
        try:
            keyframe = codec.decode(topics.KEYFRAME, payload)
        except BadMessage as error:
            return error.reason
        assert isinstance(keyframe, m.Keyframe)
        try:
            # Weights that no float32 holds are infinite in a hash of float32; numpy warns, which is expected.
            with np.errstate(over="ignore"):
                core.memory.restore(keyframe)
        except ValueError:
            return "does not fit"
        return "accepted"

    return read


def _asking() -> Read:
    outbox = Outbox("controller-1")
    for seq in range(20):
        outbox.add(m.Sample(seq, [0.0] * 4, [0.0], [0.0] * 4))

    def read(payload: bytes) -> str:
        words = payload.decode(errors="replace").split(";")
        parameters = dict(word.partition("=")[::2] for word in words)
        try:
            answers = outbox.answer(parameters)
        except ValueError:
            return "bad question"
        return "accepted" if answers else "nothing to answer"

    return read


def _describing(payload: bytes) -> str:
    try:
        msgspec.json.decode(payload, type=NetworkDescription)
    except ValueError:
        return "refused"
    return "accepted"


def _configuring(payload: bytes) -> str:
    try:
        from_tree(tomllib.loads(payload.decode()))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return "not TOML"
    except ConfigError:
        return "refused"
    return "accepted"


def _reconfiguring(payload: bytes) -> str:
    try:
        from_json(payload.decode(errors="replace"))
    except ConfigError:
        return "refused"
    return "accepted"


def _building(payload: bytes) -> str:
    """As far as a replay: the controller of a recorded configuration, if that is a small one."""
    try:
        said = from_json(payload.decode(errors="replace"))
        given = given_plant(Run(Path("fuzzed.mcap"), said), said, set())
        build_model(said, given)
        if said.controller.horizon > 20 or said.controller.solver.compile != "never":
            return "accepted"
        ControllerCore(said, "controller-1", given=given)
    except (ConfigError, LogError):
        return "refused"
    return "accepted"


def _knowing(payload: bytes) -> str:
    try:
        plant_record.decode(payload)
    except plant_record.PlantRecordError:
        return "refused"
    return "accepted"


def _modelling(payload: bytes) -> str:
    """As far as the model of the numbers in a log."""
    try:
        known, _files = plant_record.decode(payload)
        nominal_model(known, 0.05)
    except plant_record.PlantRecordError:
        return "refused"
    except ModelError:
        return "no model"
    return "accepted"


def _certifying(payload: bytes) -> str:
    try:
        CertifiedSets.from_bytes(payload)
    except CertificateError:
        return "refused"
    return "accepted"


def _loading(payload: bytes) -> str:
    """Nothing is loaded: a library is accepted only if it equals, byte for byte, what was written for its name."""
    if not is_sealed(payload, LIBRARY):
        return "refused"
    content = payload.rpartition(SEAL)[0]
    assert payload == sealed(content, LIBRARY)
    return "accepted"


def _logging(path: Path) -> Read:
    def read(payload: bytes) -> str:
        path.write_bytes(payload)
        try:
            run = read_run(path)
        except LogError:
            return "refused"
        return "accepted, cut short" if run.truncated else "accepted"

    return read


def _kind(reason: str) -> str:
    """Without its figures."""
    return re.sub(r"\(.*|\[.*|-?\d[\d.e+-]*", "", reason)[:40].strip(" ,")


def _sets() -> bytes:
    """A small file of certified sets, from the shipped ones."""
    from controller_node.certified_sets import SHIPPED

    path = min(SHIPPED.glob("*.json*"), key=lambda path: path.stat().st_size)
    whole = CertifiedSets.from_bytes(path.read_bytes())
    few = msgspec.structs.replace(whole.certificate, pieces=whole.certificate.pieces[:1])
    return CertifiedSets.of(few, Found(0.5, 0.1, True, 1.0)).to_bytes()


def _log(settings: Config, payloads: dict[str, list[bytes]], folder: Path) -> bytes:
    from lbmpc.plants import get_plant

    path = folder / "seed.mcap"
    path.unlink(missing_ok=True)
    with LogWriter(path, settings, get_plant(settings.plant.model), versions={"python": "3.11"}) as writer:
        for name, known in payloads.items():
            for at, payload in enumerate(known):
                writer.write(name, payload, 10**9 + at)
        writer.flush()
    return path.read_bytes()
