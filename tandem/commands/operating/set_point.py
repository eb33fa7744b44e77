"""`tandem set-point`: give a running controller set-points, and print its answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import Configured
from tandem.terminal import Refused

if TYPE_CHECKING:
    from protocol import messages as m

LONGEST = 1e6


@dataclass(frozen=True, kw_only=True)
class SetPoint(Configured):
    """Give a running controller set-points. With certificates it needs the commander's."""

    values: Annotated[Positional[list[str]], arg(metavar="NAME=VALUE...")] = field(default_factory=list)
    """States and their set-points, in the plant's own units: y=1.8."""
    over: Annotated[float, arg(metavar="S")] = 0.0
    """Seconds of a straight line from the present reference to the set-points."""
    lease: Annotated[
        float | None, arg(name="for", metavar="S", help_behavior_hint="(default: until another is given)")
    ] = None
    """Seconds after which the configured reference returns, 60 at most."""
    file: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """A sequence of set-points instead: a CSV file with the columns time (seconds from now) and states."""
    configured: bool = False
    """Return to the reference of the configuration."""
    seconds: Annotated[float, arg(metavar="S")] = 3.0
    """Seconds to wait for the controller's answer."""

    def run(self) -> int:
        config, plant = self.resolve_with_plant()
        from tandem.operating import set_points
        from tandem.operating.hand_session import LONGEST_LEASE_S

        terminal.limited("--seconds", self.seconds, 0.1, 86_400.0)
        terminal.limited("--over", self.over, 0.0, LONGEST)
        if self.lease is not None:
            terminal.limited("--for", self.lease, config.period, LONGEST_LEASE_S)
        asked = self._asked()
        where = str(self.file) if self.file is not None else " ".join(self.values)
        set_points.require_fit(asked, plant, config.period, where)
        from tandem.operating.commander import ask

        results = ask(config, asked, self.seconds)
        if not results:
            text = f"no answer from a controller of {config.name} within {self.seconds:g} s"
            terminal.complain(f"{text}; check that it is running (`tandem health`)", self.json)
            return 1
        verdict, _, why = results[0].reference_verdict.partition(": ")
        if verdict != "taken":
            terminal.complain(f"the controller refused the reference: {why}", self.json)
            return 1
        course = f"{where} in {self.over:g} s" if self.over else ""
        self.say(words(results[-1], course))
        self.emit(answer(results[-1]))
        return 0

    def _asked(self) -> m.Reference:
        from protocol import messages as m
        from tandem.operating import set_points

        if (bool(self.values), self.file is not None, self.configured).count(True) != 1:
            raise Refused("give exactly one of NAME=VALUE, --file and --configured")
        if self.configured:
            return m.Reference(run_id=set_points.UNSAID, seq=0, kind="configured")
        if self.file is not None:
            return set_points.from_file(self.file, self.lease)
        return set_points.set_point(set_points.from_words(self.values), self.over, self.lease)


def answer(result: m.TickResult) -> dict[str, object]:
    """Return the object that `--json` prints."""
    return {
        "tick": result.seq,
        "reference": result.reference,
        "target_status": result.target_status,
        "target_distance": result.target_distance,
    }


def words(result: m.TickResult, course: str = "") -> str:
    """Return the answer as text for a person; `course` says where a moving reference goes."""
    now = ", ".join(f"{name} {value:.6g}" for name, value in result.reference.items())
    if not now:
        return f"taken in tick {result.seq}: the target is the equilibrium again"
    rest = {
        "reached": "the plant has a steady state there",
        "nearest": f"out of reach: the nearest steady state differs by {100.0 * (result.target_distance or 0.0):.3g} % "
        "of a half-width",
        "no rest": "no steady state was found inside X and U",
    }
    said = f"taken in tick {result.seq}: {now} now, {rest.get(result.target_status, result.target_status)}"
    return f"{said}; {course}" if course else said
