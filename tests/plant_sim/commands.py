"""Commands as a controller sends them, and some facts about the compressor."""

from __future__ import annotations

from lbmpc.plants import Plant, get_plant
from protocol import messages as m

PLANT: Plant = get_plant("moore_greitzer")
PERIOD = 0.05
U = float(PLANT.u_e[0])


def planned(
    seq: int, plan: list[list[float]], answers: int, run_id: str = "plant-a", period: float = PERIOD
) -> m.Command:
    """Return the first input of a plan, (n, m), and the whole plan."""
    return m.Command(
        run_id="controller-a",
        seq=seq,
        state_run_id=run_id,
        state_seq=answers,
        period=period,
        mode="solver",
        u=plan[0],
        plan=plan,
    )


def command(
    seq: int,
    u: float,
    plan: list[float] | None = None,
    answers: int = 0,
    run_id: str = "plant-a",
    period: float = PERIOD,
) -> m.Command:
    """Return a command with the input u and the plan behind it."""
    return planned(seq, [[u], *([value] for value in plan or [])], answers, run_id, period)
