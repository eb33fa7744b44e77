"""`tandem plant` with a trace: every sample and every command it takes is also written to a file.

    python traced_plant.py SUPERVISOR CONFIG TRACE

The bus does not show what the true plant does while the router is dead or its link is cut. The plant's own code is
`plant_sim.node.main`, unchanged. Its gateway only gets a `Shield` that records its calls and
answers.
A line on standard input lets it begin.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np

from node_runtime.config.loading import load
from node_runtime.realtime import clock
from plant_sim import gateway, node
from plant_sim.shield import Shield, Verdict
from protocol.messages import Command, PlantState
from tandem.child import end_with


class Sampled(msgspec.Struct, frozen=True, tag="sample"):
    """One sample, and when the plant's loop handled it; seconds on the monotonic clock."""

    at: float
    state: PlantState


class Commanded(msgspec.Struct, frozen=True, tag="command"):
    """One command that reached the plant's own checks."""

    at: float
    """When it arrived."""
    run_id: str
    seq: int
    verdict: str


Traced = Sampled | Commanded


def read(path: Path) -> list[Traced]:
    """Read a trace; an unfinished last line of a killed plant is left out."""
    lines = path.read_bytes().split(b"\n")[:-1] if path.exists() else []
    decoder = msgspec.json.Decoder(Traced)
    return [decoder.decode(line) for line in lines]


class TracedShield(Shield):
    """A `Shield` that records what happens."""

    file: BinaryIO
    encoder = msgspec.json.Encoder()

    def sample(self, t: float, x: np.ndarray, measured: float | None = None) -> PlantState:
        state = super().sample(t, x, measured)
        self._note(Sampled(clock.now(), state))
        return state

    def command(self, command: Command, t: float) -> Verdict:
        verdict = super().command(command, t)
        self._note(Commanded(t, command.run_id, command.seq, verdict))
        return verdict

    def _note(self, what: Traced) -> None:
        self.file.write(self.encoder.encode(what) + b"\n")


def main(supervisor: int, config: str, trace: str) -> int:
    """Run the plant until it is told to stop."""
    end_with(supervisor)
    logging.basicConfig(format="%(message)s", level="INFO")
    with open(trace, "ab", buffering=0) as file:
        TracedShield.file = file
        gateway.Shield = TracedShield  # type: ignore[misc]
        if not sys.stdin.readline():
            return 1
        return node.main(load(config))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2], sys.argv[3]))
