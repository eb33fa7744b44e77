"""`tandem replay`: run a log's ticks again and compare byte for byte."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from tandem import terminal
from tandem.commands.base import Command


@dataclass(frozen=True, kw_only=True)
class Replay(Command):
    """Run a log's ticks through a fresh controller and compare every command and keyframe, byte for byte."""

    EXTRAS = "log"

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A log that `tandem run` or `tandem simulate --log` wrote."""
    from_tick: Annotated[int | None, arg(metavar="INT", help_behavior_hint="(default: the first)")] = None
    """Start at this tick, from the nearest keyframe before it."""
    set: Annotated[UseAppendAction[list[str]], arg(metavar="SECTION.KEY=VALUE")] = field(default_factory=list)
    """Replay with another value than the log's configuration has."""
    architecture: Annotated[str | None, arg(metavar="FILE:NAME", help_behavior_hint="(default: none)")] = None
    """The file of the log's network, if its architecture is one of your own. Tandem never loads code only because a log
    names it."""
    plant: Annotated[
        str | None, arg(metavar="FILE:NAME", help_behavior_hint="(default: the log's numbers)")
    ] = None
    """The plant file of the log, if a replay needs equations: oracle perfect, certified sets."""

    def run(self) -> int:
        """Return 0 if all commands and keyframes are equal to the byte, 1 if one differs or is lost."""
        import msgspec

        from node_runtime.config.architecture import load_architecture
        from run_log.named_plant import name_plant
        from run_log.reading.reader import read_run
        from run_log.replaying.replay import ROUNDING, replay

        own = None if self.architecture is None else load_architecture(self.architecture)
        ran = read_run(self.file)
        notes = [] if self.plant is None else name_plant(ran, self.plant)
        with terminal.progress_bar(self.console) as bar:
            task = bar.add_task("replaying", total=None)
            found = replay(
                ran,
                self.from_tick,
                self.set,
                lambda done, total: bar.update(task, completed=done, total=total),
                own,
            )
        if found.equal:
            text = (
                f"{found.ticks} of {found.ticks} ticks equal, byte for byte, and {found.keyframes} keyframes"
            )
            self.say(text, style="yellow" if found.lost_ticks else "green")
        elif found.rounding and found.elsewhere is not False:
            whose = "the tolerance for" if found.elsewhere else "which is the tolerance for"
            text = (
                f"{found.differing_ticks} of {found.ticks} ticks differ by rounding, "
                f"{found.largest_difference:.3g} at most in any input: within {ROUNDING:g}, {whose} a log of another "
                "machine or build; not equal byte for byte"
            )
            self.say(text, style="yellow")
        else:
            self.console.print(f"{found.differing_ticks} of {found.ticks} ticks differ", style="bold red")
            if found.rounding:
                text = (
                    "only by rounding, although log and machine have the same processor, kernels and versions"
                )
                self.console.print(text, style="bold red")
        if found.lost_ticks:
            text = f"{found.lost_ticks} ticks could not be replayed or compared: the log has gaps"
            self.console.print(text, style="bold red")
        first = found.first_difference
        if first is not None:
            values = f"recorded {first.recorded}, replayed {first.replayed}"
            self.say(f"first at tick {first.tick}: {first.field} {values}")
        if not (found.equal or found.rounding) and found.largest_difference is not None:
            self.say(f"largest difference of an input: {found.largest_difference:.3g}")
        found = msgspec.structs.replace(found, notes=[*notes, *found.notes])
        self.say(*(f"note: {note}" for note in found.notes), style="yellow")
        self.emit(msgspec.to_builtins(found))
        return 0 if found.equal and not found.lost_ticks else 1
