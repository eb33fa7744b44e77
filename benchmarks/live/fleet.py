"""One trainer for many plants: time from samples to weights, and the savings of a stack.

    python -m benchmarks.live.fleet --document docs/results/fleet.md

A real router and a real `tandem trainer --plants 'plant*'` run. The controllers are simulated, all in this process.
Each publishes ten samples and its K twice a second, as a loop at 20 Hz does, answers the trainer's questions, and
accepts its weights.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import tyro
import zenoh
from rich.console import Console

from benchmarks.document_block import DocumentError, Marks, conditions
from benchmarks.live import process_usage
from benchmarks.live.ports import free_port
from network_model.description import NetworkDescription, hash_layers, initial_hidden
from node_runtime import provenance
from node_runtime.bus.session import session_config
from node_runtime.config.loading import override, to_toml
from node_runtime.config.sections import Config, TrainerConfig
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m

MARKS = Marks.of("fleet", "python -m benchmarks.live.fleet")
NETWORK = NetworkDescription(
    states=4,
    inputs=1,
    hidden=[32, 32],
    activations=["tanh", "tanh"],
    input_scale=[0.5, 0.5, 1.0, 20.0, 1.0],
    output_scale=[0.01, 0.01, 0.02, 0.01],
)
SAMPLES, EVERY_S = 10, 0.5


@dataclass(frozen=True)
class Fleet:
    """Measure one trainer for many plants."""

    plants: tuple[int, ...] = (1, 8, 64, 256)
    seconds: float = 40.0
    """Samples for each number of plants."""
    warm: float = 20.0
    """Seconds at the beginning that do not count."""
    batch: tuple[int, ...] = (512, 64)
    """`trainer.batch`: the samples drawn for one training."""
    document: Path | None = None
    """Document that receives the tables between their two marks."""


class Simulated:
    """A controller reduced to its messages."""

    def __init__(self, name: str, number: int):
        self.name, self.run_id, self.seq = name, f"controller-{name}", -1
        rng = np.random.default_rng([11, number])
        self.hidden = initial_hidden(NETWORK, rng)
        self.version, self.sha256 = 0, hash_layers(self.hidden)
        self._K = m.Array.of(rng.normal(size=(NETWORK.features, NETWORK.states)) * 0.1)
        self._rng = rng
        self._told: list[tuple[int, float]] = []
        self.waited: list[tuple[float, float]] = []
        """Times at which weights came, and the age of the oldest sample that was new in them; seconds."""

    def speak(self, session: zenoh.Session) -> None:
        """Publish ten samples of a plant of its own, and K."""
        xu = self._rng.uniform(-1, 1, (SAMPLES, 5)) * NETWORK.input_scale
        h = 0.01 * np.sin(3.0 * xu[:, :4]) * np.tanh(xu[:, 4:])
        samples = []
        for row, label in zip(xu, h, strict=True):
            self.seq += 1
            samples.append(m.Sample(self.seq, row[:4].tolist(), row[4:].tolist(), label.tolist()))
        self._told.append((self.seq, time.monotonic()))
        self._put(session, topics.SAMPLES, m.Samples(run_id=self.run_id, seq=self.seq, samples=samples))
        self.say_weights(session)

    def say_weights(self, session: zenoh.Session) -> None:
        weights = m.OutputWeights(
            run_id=self.run_id,
            seq=max(self.seq, 0),
            hidden_version=self.version,
            hidden_sha256=self.sha256,
            K=self._K,
        )
        self._put(session, topics.OUTPUT_WEIGHTS, weights)

    def snapshot(self) -> bytes:
        layers = [m.Array.of(layer, "<f4") for layer in self.hidden]
        return codec.encode(
            m.HiddenSnapshot(
                run_id=self.run_id,
                seq=max(self.seq, 0),
                hidden_version=self.version,
                hidden_sha256=self.sha256,
                description=msgspec.json.encode(NETWORK).decode(),
                layers=layers,
            )
        )

    def take(self, weights: m.HiddenWeights, now: float) -> None:
        self.hidden = [layer.numpy().astype(float) for layer in weights.layers]
        self.version, self.sha256 = weights.seq, weights.sha256
        served = [at for seq, at in self._told if seq <= weights.trained_on]
        self._told = self._told[len(served) :]
        if served:
            self.waited.append((now, now - served[0]))

    @property
    def oldest(self) -> float | None:
        """Time of the oldest sample that is in no weights yet."""
        return self._told[0][1] if self._told else None

    def _put(self, session: zenoh.Session, topic: topics.Topic, message: m.Message) -> None:
        session.put(
            topic.key(self.name), codec.encode(message), congestion_control=zenoh.CongestionControl.BLOCK
        )


@dataclass
class Row:
    """Results for one number of plants."""

    plants: int
    batch: int
    waited: list[float] = field(default_factory=list)
    trainings: list[int] = field(default_factory=list)
    """Weights that each plant received during the measurement."""
    waits: float = 0.0
    """Age of the oldest waiting sample at the end, in seconds."""
    cpu: float = 0.0
    """Processor time of the trainer, in cores."""


def main() -> int:
    settings = tyro.cli(Fleet, description=__doc__)
    console = Console(highlight=False)
    try:
        MARKS.check(settings.document)
    except DocumentError as error:
        console.print(str(error), markup=False)
        return 2
    rows, text = [], _command(settings)
    text += _ratios(settings, console)
    for batch in settings.batch:
        for plants in settings.plants:
            row = _measure(plants, batch, settings)
            rows.append(row)
            console.print(_line(row))
    text += ["", *_table(rows, settings), "", f"Load of the machine at the end: {provenance.load():.1f}."]
    MARKS.put(settings.document, "\n".join(text))
    console.print("\n".join(text))
    return 0


def _command(settings: Fleet) -> list[str]:
    words = "" if settings.seconds == Fleet.seconds else f" --seconds {settings.seconds:g}"
    return conditions(f"python -m benchmarks.live.fleet{words}")


# -- the trainer as a process ------------------------------------------------------------------------------


def _measure(plants: int, batch: int, settings: Fleet) -> Row:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = override(Config(), [f'bus.endpoint="{endpoint}"', f"trainer.batch={batch}"])
    controllers = {f"plant{k}": Simulated(f"plant{k}", k) for k in range(plants)}
    with tempfile.TemporaryDirectory() as folder, open_router(config):
        file = Path(folder) / "fleet.toml"
        file.write_text(to_toml(config))
        words = ("trainer", "--plants", "plant*", "--config", str(file))
        command = [sys.executable, "-P", "-m", "tandem", *words]
        with zenoh.open(session_config("client", endpoint, 10_000)) as session:
            arrived: list[tuple[str, bytes, float]] = []
            declared = _serve(session, controllers, arrived)
            trainer = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            try:
                begin = _let_speak(session, controllers, arrived, settings.warm, None)
                cpu = process_usage.processor_seconds(trainer.pid)
                end = _let_speak(session, controllers, arrived, settings.seconds, begin)
                cpu = (process_usage.processor_seconds(trainer.pid) - cpu) / (end - begin)
            finally:
                # An overloaded trainer takes long to leave its plants.
                trainer.kill()
                trainer.wait()
            del declared
    row = Row(plants, batch, cpu=cpu)
    for controller in controllers.values():
        # A plant's first weights waited for the trainer to start.
        counted = [waited for at, waited in controller.waited[1:] if at >= begin]
        row.waited += counted
        row.trainings.append(sum(at >= begin for at, _ in controller.waited))
        row.waits = max(row.waits, end - controller.oldest) if controller.oldest is not None else row.waits
    return row


def _serve(
    session: zenoh.Session, controllers: dict[str, Simulated], arrived: list[tuple[str, bytes, float]]
) -> list[object]:
    """Messages from the trainer; kept as long as the list exists."""

    def hidden(query: zenoh.Query) -> None:
        with query:
            controller = controllers.get(str(query.key_expr).split("/")[1])
            if controller is not None:
                query.reply(query.key_expr, controller.snapshot())

    def weights(sample: zenoh.Sample) -> None:
        arrived.append((str(sample.key_expr).split("/")[1], sample.payload.to_bytes(), time.monotonic()))

    def outbox(query: zenoh.Query) -> None:
        """Messages from before the trainer's start are not kept."""
        with query:
            controller = controllers.get(str(query.key_expr).split("/")[1])
            if controller is not None:
                none = m.Samples(run_id=controller.run_id, seq=max(controller.seq, 0), samples=[])
                query.reply(query.key_expr, codec.encode(none))

    direct = zenoh.handlers.Callback
    return [
        session.declare_queryable(f"{topics.PREFIX}/*/{topics.OUTBOX_QUERY}", direct(outbox, indirect=False)),
        session.declare_queryable(f"{topics.PREFIX}/*/{topics.HIDDEN_QUERY}", direct(hidden, indirect=False)),
        session.declare_subscriber(topics.HIDDEN_WEIGHTS.key("*"), direct(weights, indirect=False)),
    ]


def _let_speak(
    session: zenoh.Session,
    controllers: dict[str, Simulated],
    arrived: list[tuple[str, bytes, float]],
    seconds: float,
    begin: float | None,
) -> float:
    """Let every controller publish twice a second, one after the other; return the time at the end."""
    begin = time.monotonic() if begin is None else begin
    everyone = list(controllers.values())
    gap, turn = EVERY_S / len(everyone), 0
    while (now := time.monotonic()) < begin + seconds:
        while arrived:
            name, payload, at = arrived.pop(0)
            controllers[name].take(codec.decode_as(m.HiddenWeights, payload), at)
            # A controller publishes K at every tick.
            controllers[name].say_weights(session)
        due = begin + turn * gap
        if now >= due:
            everyone[turn % len(everyone)].speak(session)
            turn += 1
        else:
            time.sleep(min(due - now, 0.005))
    return time.monotonic()


# -- a stack against one by one ----------------------------------------------------------------------------


def _ratios(settings: Fleet, console: Console) -> list[str]:
    """Time the descent alone, in a process of its own, in turns."""
    plants = [count for count in settings.plants if count > 1]
    ran = subprocess.run(
        [sys.executable, "-m", "benchmarks.live.stacked_descent", json.dumps([settings.batch, plants])],
        capture_output=True,
        text=True,
        check=True,
    )
    lines = [
        "",
        "| samples drawn | networks | one by one, ms a network | stacked, ms a network | one by one / stacked |",
    ]
    lines += ["| ---: | ---: | ---: | ---: | ---: |"]
    for batch, count, alone, stacked in json.loads(ran.stdout):
        lines.append(f"| {batch} | {count} | {alone:.1f} | {stacked:.1f} | {alone / stacked:.2f} |")
    console.print("\n".join(lines))
    return lines


# -- what a person reads -----------------------------------------------------------------------------------


def _table(rows: list[Row], settings: Fleet) -> list[str]:
    lines = [
        f"Each row: {settings.seconds:g} s with this number of plants, after {settings.warm:g} s of warming up. "
        f"A training has {TrainerConfig().steps} steps.",
        "",
        "| plants | samples drawn | from samples to weights, s: median | p99 | longest | still waiting at the end, s "
        "| weights a plant, fewest, most | trainings a second | trainer, cores |",
        "| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in rows:
        spread = [
            f"{np.percentile(row.waited, at):.2f}" if row.waited else "none came" for at in (50, 99, 100)
        ]
        lines.append(
            f"| {row.plants} | {row.batch} | {' | '.join(spread)} | {row.waits:.2f} | {min(row.trainings)}, "
            f"{max(row.trainings)} | {sum(row.trainings) / settings.seconds:.1f} | {row.cpu:.2f} |"
        )
    return lines


def _line(row: Row) -> str:
    waited = np.array(row.waited or [np.nan])
    return (
        f"{row.plants} plants, {row.batch} samples: {np.median(waited):.2f} s, longest {waited.max():.2f} s, "
        f"{min(row.trainings)} to {max(row.trainings)} weights a plant"
    )


if __name__ == "__main__":
    sys.exit(main())
