"""`tandem sets`: certified sets, computed, checked and drawn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from tandem.commands.base import Command, Configured


@dataclass(frozen=True, kw_only=True)
class SetsCompute(Configured):
    """Compute sets in which the true plant can be kept for ever, have them checked, and write them to a file."""

    kind: Annotated[
        Literal["regions", "hull", "box", "given", "all"], arg(metavar="regions|hull|box|given|all")
    ] = "regions"
    """What is known of the model error h: its bound as a box, as a hull, by regions around a way from x0 as well, or
    given as controller.W. `all`: box, hull and regions in one table, and the last one written."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("sets.json")
    """Where the sets go; gzipped where the name ends in .gz."""
    slack: Annotated[float, arg(metavar="SHARE")] = 3e-4
    """Room beyond W, as a share of X's half-widths: more ends sooner, with smaller sets."""
    fresh: bool = False
    """Take nothing from the cache."""

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands.sets import compute

        kinds: tuple[Literal["regions", "hull", "box", "given"], ...] = ("box", "hull", "regions")
        if self.kind != "all":
            kinds = (self.kind,)
        return compute.run(config, kinds, self.out, self.slack, self.fresh, self.json)


@dataclass(frozen=True, kw_only=True)
class SetsCheck(Configured):
    """Prove the claim of a file again, from the file alone; with the configuration, that it is about this model."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A file of certified sets."""
    samples: Annotated[int, arg(metavar="N")] = 20_000
    """States and inputs at which the true plant is asked whether W holds."""

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands.sets import check

        return check.run(config, self.file, self.samples, self.json)


@dataclass(frozen=True, kw_only=True)
class SetsPlot(Command):
    """Draw sets: projections and slices with X, W, the tube, x0, and a run if there is one."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A file of certified sets."""
    log: Annotated[Path | None, arg(name="run", metavar="LOG", help_behavior_hint="(default: none)")] = None
    """A log whose states are laid over the sets."""
    out: Annotated[Path | None, arg(metavar="PNG", help_behavior_hint="(default: FILE with .png)")] = None
    """Where the picture goes."""

    def run(self) -> int:
        from tandem.commands.sets import plot

        return plot.run(self.file, self.log, self.out, self.json)


@dataclass(frozen=True, kw_only=True)
class SetsCommand:
    """Certified sets: compute, check, plot."""

    action: (
        Annotated[SetsCompute, subcommand("compute")]
        | Annotated[SetsCheck, subcommand("check")]
        | Annotated[SetsPlot, subcommand("plot")]
    )
