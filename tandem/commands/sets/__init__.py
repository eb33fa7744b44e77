"""`tandem sets`: compute, check and plot certified sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import subcommand

from tandem.commands.sets.check import SetsCheck
from tandem.commands.sets.compute import SetsCompute
from tandem.commands.sets.plot import SetsPlot


@dataclass(frozen=True, kw_only=True)
class SetsCommand:
    """Certified sets: compute, check, plot."""

    action: (
        Annotated[SetsCompute, subcommand("compute")]
        | Annotated[SetsCheck, subcommand("check")]
        | Annotated[SetsPlot, subcommand("plot")]
    )
