"""Messages of a run as a live view receives them."""

from __future__ import annotations

from lbmpc.plants import get_plant
from node_runtime.bus.mailbox import Delivery
from node_runtime.config.sections import Config
from protocol import codec
from protocol import messages as m
from protocol.topics import Topic

CONFIG = Config()
PLANT = get_plant(CONFIG.plant.model)
START = 100.0


def delivery(topic: Topic, message: m.Message, at: float) -> Delivery:
    return Delivery(topic.key(CONFIG.name), codec.encode(message), round(at * 1e9))


def state(seq: int, z: float = 0.3) -> m.PlantState:
    return m.PlantState(
        run_id="p",
        seq=seq,
        t=seq * 0.05,
        x=[z, 1.5, 1.1, 0.2],
        applied=[1.0],
        source="command",
        command_seq=seq,
    )


def command(seq: int) -> m.Command:
    return m.Command(
        run_id="c",
        seq=seq,
        state_run_id="p",
        state_seq=seq,
        period=0.05,
        mode="solver",
        u=[1.0],
        plan=[[1.0]],
    )


def tick(seq: int, late: bool = False, skipped: int = 0) -> m.Tick:
    return m.Tick(
        run_id="c",
        seq=seq,
        slot=seq,
        t=seq * 0.05,
        skipped=skipped,
        lateness=0.0,
        late=late,
        state_verdict="fresh",
        state=None,
        weights=None,
    )


def result(
    seq: int,
    *,
    mode: m.CommandMode = "solver",
    verdict: str = "none",
    error: float = 1e-3,
    slack: float = 0.0,
) -> m.TickResult:
    return m.TickResult(
        run_id="c",
        seq=seq,
        x=[0.3, 1.5, 1.1, 0.2],
        u=[1.0],
        mode=mode,
        status="converged",
        iterations=2,
        slack=slack,
        slack_row="y at step 3" if slack else "",
        h=None,
        h_hat=None,
        prediction_error=error,
        oracle_norms=[],
        hidden_version=3,
        hidden_sha256="",
        tick_crc32=0,
        input_delay=0.0,
        weights_verdict=verdict,
    )


def health(process: str, counters: dict[str, int], note: str = "") -> m.Health:
    return m.Health(run_id=process, seq=0, process=process, status="running", counters=counters, note=note)
