"""A constructed run of real messages: the true compressor under a plain state feedback."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lbmpc.plants import Plant, Truth, get_plant
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from run_log.reading.reader import read_run
from run_log.writing.writer import LogWriter

PLANT_RUN, RUN, TRAINER_RUN = "plant-1", "controller-1", "trainer-1"
MS = 1_000_000
GAIN = np.array([[-1.5, 1.2, 0.1, -0.005]])
Logged = tuple[Topic, m.Message, int]
STEPS = 60
"""Number of ticks of the shared log."""


def synthetic(config: Config | None = None, steps: int = 100, seed: int = 0) -> tuple[Config, list[Logged]]:
    """Yield the messages of `steps` ticks in the order in which a recorder receives them."""
    config = config or Config()
    plant: Plant = get_plant(config.plant.model)
    truth, rng = Truth(plant), np.random.default_rng(seed)
    x, applied, version = plant.x0.copy(), None, -1
    out: list[Logged] = []

    def log(topic: Topic, message: m.Message, seconds: float) -> None:
        out.append((topic, message, 1_700_000_000 * 1000 * MS + round(seconds * 1e9)))

    info = m.RunInfo(
        run_id=RUN,
        seq=0,
        process="controller",
        config="{}",
        versions={"python": "3.11"},
        seed=0,
        units=plant.units,
        unix_time=1.7e9,
    )
    log(topics.RUN_INFO["controller"], info, 0.0)
    for k in range(steps):
        t = k * config.period
        state = m.PlantState(
            run_id=PLANT_RUN,
            seq=k,
            t=100.0 + t,
            x=x.tolist(),
            applied=applied,
            source="hold" if k == 0 else "command",
            command_seq=k - 1,
        )
        log(topics.PLANT_STATE, state, t)
        late = k in (30, 31)
        weights = _weights(k, rng) if k % 20 == 19 else None
        if weights is not None:
            log(topics.HIDDEN_WEIGHTS, weights, t)
            version = weights.seq if k != 59 else version
        u = np.clip(plant.u_e + GAIN @ (x - plant.x_e), plant.u_min, plant.u_max)
        command = m.Command(
            run_id=RUN,
            seq=k,
            state_run_id=PLANT_RUN,
            state_seq=k,
            period=config.period,
            mode="shifted_plan" if k == 40 else "solver",
            u=u.tolist(),
            plan=[u.tolist()] * 3,
        )
        log(topics.COMMAND, command, t + 0.003)
        tick = m.Tick(
            run_id=RUN,
            seq=k,
            slot=k,
            t=t,
            skipped=0,
            lateness=0.02 if late else 1e-4,
            late=late,
            state_verdict="fresh",
            state=state,
            weights=weights,
        )
        log(topics.TICK, tick, t + 0.004)
        h = np.array([4e-3, 2e-3, 0.0, 0.0]) * np.exp(-t)
        h_hat = h * (1 - np.exp(-2 * t)) + rng.normal(scale=1e-5, size=4)
        verdict = "none" if weights is None else "refused: sha256" if k == 59 else "adopted"
        result = m.TickResult(
            run_id=RUN,
            seq=k,
            x=x.tolist(),
            u=u.tolist(),
            mode=command.mode,
            status="iteration limit" if k == 6 else "converged",
            iterations=3,
            slack=1e-3 if k == 5 else 0.0,
            slack_row="y at step 3" if k == 5 else "",
            h=h.tolist() if k else None,
            h_hat=h_hat.tolist() if k else None,
            prediction_error=float(np.linalg.norm(h - h_hat)) if k else None,
            oracle_norms=(np.ones(4) * 0.01).tolist(),
            hidden_version=version,
            hidden_sha256="0" * 64,
            tick_crc32=0,
            input_delay=0.0,
            weights_verdict=verdict,
        )
        log(topics.RESULT, result, t + 0.004)
        solve = 2.0 + rng.gamma(2.0, 0.3)
        timing = m.TickTiming(
            run_id=RUN, seq=k, solve_ms=solve, tick_ms=solve + 0.5, lateness_ms=0.1, state_age_ms=1.0
        )
        log(topics.TIMING, timing, t + 0.005)
        if k:
            sample = m.Sample(k - 1, (x - plant.x_e).tolist(), (u - plant.u_e).tolist(), h.tolist())
            log(topics.SAMPLES, m.Samples(run_id=RUN, seq=k - 1, samples=[sample]), t + 0.006)
        K = m.Array.of(rng.normal(scale=0.01, size=(33, 4)))
        log(
            topics.OUTPUT_WEIGHTS,
            m.OutputWeights(run_id=RUN, seq=k, hidden_version=version, hidden_sha256="", K=K),
            t + 0.006,
        )
        if k % config.controller.keyframe_every == 0:
            log(topics.KEYFRAME, m.Keyframe(run_id=RUN, seq=k - 1, arrays={"K": K}), t + 0.007)
        if k % 10 == 0:
            health = m.Health(
                run_id=RUN,
                seq=k // 10,
                process="controller",
                status="running",
                counters={"ticks": k},
                note="",
            )
            log(topics.HEALTH["controller"], health, t + 0.008)
        x, applied = truth.step(x, u, config.period), u.tolist()
    return config, out


def _weights(k: int, rng: np.random.Generator) -> m.HiddenWeights:
    layers = [
        m.Array.of(rng.normal(size=(6, 32)).astype(np.float32), "<f4"),
        m.Array.of(rng.normal(size=(33, 32)), "<f4"),
    ]
    return m.HiddenWeights(
        run_id=TRAINER_RUN,
        seq=k // 20,
        for_run=RUN,
        trained_on=k - 5,
        base_sha256="0" * 64,
        samples=k,
        loss_before=1e-3 / (k + 1),
        loss_after=1e-4 / (k + 1),
        network_sha256="0" * 64,
        sha256="0" * 64,
        layers=layers,
    )


def write(path: Path, config: Config, messages: list[Logged], flush_every: int = 50) -> Path:
    """Write a complete log of these messages."""
    with LogWriter(path, config, get_plant(config.plant.model), versions={"python": "3.11"}) as writer:
        for i, (topic, message, log_time) in enumerate(messages):
            writer.write(topic.name, codec.encode(message), log_time)
            if i % flush_every == flush_every - 1:
                writer.flush()
    return path


def payloads(messages: list[Logged]) -> dict[str, list[bytes]]:
    """Return the messages that a log of them must contain, by topic."""
    found: dict[str, list[bytes]] = {}
    for topic, message, _ in messages:
        found.setdefault(topic.name, []).append(codec.encode(message))
    return found


def logged(path: Path) -> dict[str, list[bytes]]:
    """Return the messages that the log contains, by topic."""
    return {name: [entry.payload for entry in entries] for name, entries in read_run(path).streams.items()}
