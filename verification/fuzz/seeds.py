"""Valid messages of every topic, from a controller and a plant that run a few steps: the input of the mutations."""

from __future__ import annotations

import msgspec
from msgspec import UNSET

from controller_node.core import ControllerCore
from controller_node.outbox import Outbox
from lbmpc.plants import get_plant, true_motion
from node_runtime.bus.batches import Waiting, encode_batch
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.provenance import run_info
from plant_sim.simulator import PlantSim
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from trainer_node.questions import HIDDEN_ANSWER, SAMPLES_ANSWER

SETTINGS = [
    "controller.solver.compile=never",
    "controller.horizon=8",
    "network.hidden=[6, 5]",
    "log.path=fuzz.mcap",
]
STEPS = 6

_REFERENCE = m.Reference(
    run_id="commander-1", seq=0, outputs=["y", "z"], times=[0.0, 0.1, 0.1, 4.0],
    values=[[1.65, 0.5], [1.7, 0.5], [1.75, 0.52], [1.7, 0.5]],
)  # fmt: skip
ANSWERS = (HIDDEN_ANSWER, SAMPLES_ANSWER)


def config() -> Config:
    """Configuration of the controller that sends the messages."""
    return override(Config(), SETTINGS)


def seeds() -> dict[str, list[bytes]]:
    """Payloads that every reader accepts, by topic or answer."""
    settings = config()
    core = ControllerCore(settings, "controller-1")
    true = get_plant(settings.plant.model)
    plant = PlantSim(
        true, true_motion(true), settings.period, true.x0, settings.plant.plan_patience, "plant-1"
    )
    outbox = Outbox("controller-1")
    out: dict[str, list[bytes]] = {topic.name: [] for topic in (*topics.ALL, *ANSWERS)}

    def said(topic: Topic, message: m.Message) -> None:
        out[topic.name].append(codec.encode(message))

    asked = {
        1: _REFERENCE,
        3: msgspec.structs.replace(_REFERENCE, seq=1, times=[0.2], values=[[1.7, 0.5]], lease=3.0),
    }
    for reference in asked.values():
        said(topics.REFERENCE, reference)
    for kind in ("hold", "configured"):
        said(topics.REFERENCE, m.Reference(run_id="commander-1", seq=2, kind=kind, lease=1.0))
    said(topics.OVERRIDE, m.Override(run_id="commander-1", seq=0, mode="manual", u=[1.2]))
    said(topics.KEYFRAME, core.memory.keyframe(-1))
    for step in range(STEPS):
        state = plant.sample(step * settings.period)
        weights = _weights(core, step) if step == STEPS - 1 else None
        tick = m.Tick(
            run_id="controller-1",
            seq=step,
            slot=step,
            t=step * settings.period,
            skipped=0,
            lateness=1e-4,
            late=False,
            state_verdict="fresh",
            state=state,
            weights=weights,
            reference=asked.get(step, UNSET),
        )
        outputs = core.step(tick)
        # Acts a little after the sample, so that the next state has pieces.
        plant.command(outputs.command, step * settings.period + 0.003)
        said(topics.PLANT_STATE, state)
        said(topics.COMMAND, outputs.command)
        if (backup := core.backup(outputs.command)) is not None:
            said(topics.BACKUP, backup)
        said(topics.TICK, tick)
        said(topics.RESULT, outputs.result)
        timing = m.TickTiming(
            run_id="controller-1", seq=step, solve_ms=1.0, tick_ms=2.0, lateness_ms=0.1, state_age_ms=1.0
        )
        said(topics.TIMING, timing)
        if outputs.sample is not None:
            outbox.add(outputs.sample)
        if outputs.output_weights is not None:
            said(topics.OUTPUT_WEIGHTS, outputs.output_weights)
        if weights is not None:
            said(topics.HIDDEN_WEIGHTS, weights)
    for batch in outbox.batches(outbox.since(-1)):
        said(topics.SAMPLES, batch)
        said(SAMPLES_ANSWER, batch)
    said(topics.KEYFRAME, core.memory.keyframe(STEPS - 1))
    snapshot = core.memory.hidden_snapshot(STEPS - 1)
    assert snapshot is not None
    said(HIDDEN_ANSWER, snapshot)
    said(
        topics.SETS, m.CertifiedSets(run_id="controller-1", seq=0, kind="box", sha256="0" * 64, content=b"{}")
    )
    said(topics.OVERRIDE, m.Override(run_id="commander-1", seq=0, mode="manual", u=[1.2], lease=1.0))
    said(topics.OVERRIDE, m.Override(run_id="commander-1", seq=1, mode="auto"))
    for process in topics.PROCESSES:
        said(topics.RUN_INFO[process], run_info(settings, process, f"{process}-1", {"z": "1"}))
        health = m.Health(
            run_id=f"{process}-1",
            seq=3,
            process=process,
            status="running",
            counters={"ticks": 7},
            note="well",
        )
        said(topics.HEALTH[process], health)
    for name, topic in topics.BATCH.items():
        inside = topics.PLANT_STATE if name == "plant" else topics.COMMAND
        parts = [Waiting(inside.name, i, payload) for i, payload in enumerate(out[inside.name])]
        out[topic.name].append(encode_batch(f"{name}-1", 0, parts))
    return out


def _weights(core: ControllerCore, seq: int) -> m.HiddenWeights:
    """Acceptable ones."""
    snapshot = core.memory.hidden_snapshot(seq)
    assert snapshot is not None
    assert core.controller.oracle.description is not None
    return m.HiddenWeights(
        run_id="trainer-1",
        seq=1,
        for_run="controller-1",
        trained_on=seq - 1,
        base_sha256=snapshot.hidden_sha256,
        samples=20,
        loss_before=1e-3,
        loss_after=1e-4,
        network_sha256=core.controller.oracle.description.sha256(),
        sha256=snapshot.hidden_sha256,
        layers=snapshot.layers,
    )
