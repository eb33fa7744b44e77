"""Commands for the compressor, as a controller would send them."""

from __future__ import annotations

from lbmpc.plants import Plant, get_plant
from protocol import messages as m

PLANT: Plant = get_plant("moore_greitzer")
PERIOD = 0.05
U = float(PLANT.u_e[0])


def command(
    seq: int,
    u: float,
    plan: list[float] | None = None,
    answers: int = 0,
    run_id: str = "plant-a",
    period: float = PERIOD,
) -> m.Command:
    entries = [[u], *([value] for value in plan or [])]
    return m.Command(
        run_id="controller-a",
        seq=seq,
        state_run_id=run_id,
        state_seq=answers,
        period=period,
        mode="solver",
        u=[u],
        plan=entries,
    )
