"""`tandem manual`, `tandem pause` and `tandem auto`: a hand on the switch of a plant that runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import Configured

if TYPE_CHECKING:
    import numpy as np

    from lbmpc.plants import Description
    from protocol.messages import Override, PlantState, Reference
    from tandem.commander import Commander

HEARD_S, HEARD_PERIODS = 2.0, 4.0
"""How soon the plant is to say what acts."""
HEALTH_S = 0.7
"""A little more than from one health to the next."""
LOOK_S = 0.1
LONGEST_S = 1e8
ENDED = 1


class ByHand(Configured):
    """A command that stays in the foreground while what it says counts."""

    seconds: float | None

    def _stay(
        self,
        commander: Commander,
        plant: Description,
        word: Callable[[int], Override | Reference],
        over: Callable[[], str],
        follower: Follower,
    ) -> str:
        """Say it again and again until something ends it: why, or "" where the person did."""
        from node_runtime.realtime import clock
        from tandem.commander import RENEWALS, lease_of

        every = lease_of(commander.config.period) / RENEWALS
        began = clock.now()
        end = math.inf if self.seconds is None else began + self.seconds
        said = shown = -math.inf
        while not commander.stopping.is_set() and clock.now() < end:
            now = clock.now()
            if now - said >= every:
                commander.say(word(follower.number))
                follower.said()
                said = now
            why = ""
            for message in commander.hear(min(said + every, end, now + LOOK_S)):
                if why := follower.take(message):
                    break
            if why or (why := over()):
                return self._reason(commander, follower, why)
            if follower.state is not None and clock.now() - shown >= 1.0:
                shown = clock.now()
                self.say(line(follower.state, plant, shown - began))
        return ""

    def _reason(self, commander: Commander, follower: Follower, why: str) -> str:
        """Why, as the plant says it where it is the one who ended it: that comes with its next health."""
        from node_runtime.realtime import clock

        if follower.mine:
            for message in commander.hear(clock.now() + HEALTH_S):
                follower.take(message)
                if follower.told:
                    return follower.told
        return why

    def _limits(self) -> None:
        if self.seconds is not None:
            terminal.limited("--seconds", self.seconds, 0.0, LONGEST_S)


@dataclass(frozen=True, kw_only=True)
class Manual(ByHand):
    """Drive the plant's input by hand until Ctrl-C, while the plant stays in X.

    The controller goes on learning, and takes over where the plant would leave X. Needs the commander's certificate
    where links have them.
    """

    inputs: Annotated[Positional[list[str]], arg(metavar="INPUT=VALUE")]
    """u=1.2, in the plant's own units; inputs that are not named stay what they are."""
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint="(default: until Ctrl-C)")] = None
    """For how long."""

    def run(self) -> int:
        config, plant = self.resolve_with_plant()
        self._limits()
        named = assignments(self.inputs, plant)
        from node_runtime.realtime import clock
        from protocol.messages import Override
        from tandem.commander import commanding, lease_of

        with commanding(config) as commander:
            patience = max(HEARD_S, HEARD_PERIODS * config.period)
            follower = Follower(commander.run_id)
            for message in commander.hear(clock.now() + patience):
                follower.take(message)
                if follower.state is not None:
                    break
            if follower.state is None:
                raise terminal.Refused(f"no plant said anything for {patience:g} s at {config.bus.endpoint}")
            u = completed(named, plant, acting(follower.state))
            began = clock.now()

            def word(number: int) -> Override:
                lease = lease_of(config.period)
                return Override(run_id=commander.run_id, seq=number, mode="manual", u=u.tolist(), lease=lease)

            def over() -> str:
                waits = clock.now() - began < patience
                return "" if waits or follower.begun else "the plant did not take it"

            self.say(f"by hand: {figures(plant.inputs, u)}; Ctrl-C gives it back")
            why = self._stay(commander, plant, word, over, follower)
            if not (why and follower.begun):
                last = Override(run_id=commander.run_id, seq=follower.number + 1, mode="auto")
                commander.say_last(last)
            return self._ended(why)

    def _ended(self, why: str) -> int:
        self.say(f"no longer by hand: {why}" if why else "given back", style="yellow" if why else None)
        self.emit({"ended": why or "given back"})
        return ENDED if why else 0


@dataclass(frozen=True, kw_only=True)
class Pause(ByHand):
    """Hold the plant where it is, as far as it can rest there, until Ctrl-C; the controller does it."""

    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint="(default: until Ctrl-C)")] = None
    """For how long."""

    def run(self) -> int:
        config, plant = self.resolve_with_plant()
        self._limits()
        from protocol.messages import Reference
        from tandem.commander import commanding, lease_of

        with commanding(config) as commander:

            def word(number: int) -> Reference:
                lease = lease_of(config.period)
                return Reference(run_id=commander.run_id, seq=number, kind="hold", lease=lease)

            self.say("paused; Ctrl-C goes on")
            follower = Follower(commander.run_id, "reference")
            why = self._stay(commander, plant, word, lambda: "", follower)
            # `auto` ends a pause too; where another has said where to go, that counts.
            if not follower.elsewhere:
                last = Reference(run_id=commander.run_id, seq=follower.number + 1, kind="configured")
                commander.say_last(last)
            self.say(f"no longer paused: {why}" if why else "goes on", style="yellow" if why else None)
            self.emit({"ended": why or "given back"})
            return ENDED if why else 0


@dataclass(frozen=True, kw_only=True)
class Auto(Configured):
    """Give a plant that is driven by hand, or paused, back to its controller, from wherever that is done."""

    def run(self) -> int:
        config, _plant = self.resolve_with_plant()
        from node_runtime.realtime import clock
        from protocol.messages import Override
        from tandem.commander import commanding

        with commanding(config) as commander:
            commander.say_last(Override(run_id=commander.run_id, seq=0, mode="auto"))
            follower, source = Follower(commander.run_id), ""
            for message in commander.hear(clock.now() + max(HEARD_S, HEARD_PERIODS * config.period)):
                follower.take(message)
                source = "" if follower.state is None else follower.state.source
                if source not in ("", "manual"):
                    break
        if source in ("", "manual"):
            why = "no plant says anything" if not source else "the plant is still driven by hand"
            terminal.complain(why, self.json)
            return ENDED
        self.say(f"driven by: {source}")
        self.emit({"source": source})
        return 0


class Follower:
    """What others say while a person commands; pure.

    Args:
        run_id: of that person's words.
        of: what they say.
    """

    def __init__(self, run_id: str, of: str = "override"):
        self._run_id, self._of = run_id, of
        self.state: PlantState | None = None
        self.begun = False
        """Whether the plant took it."""
        self.mine = True
        """Whether nobody else has ended it."""
        self.elsewhere = False
        """Whether another reference came."""
        self._number = 0
        self._said_at: tuple[str, int] | None = None
        self.told = ""
        """Why nobody drives it by hand any more, as the plant says."""

    @property
    def number(self) -> int:
        """Of the next word. 0 begins an intention, and is said until it is taken: what is behind it only renews."""
        return self._number

    def said(self) -> None:
        """The word of this number was sent."""
        if self._said_at is None:
            self._said_at = ("", -1) if self.state is None else (self.state.run_id, self.state.seq)
        if self.begun or self._of == "reference":
            self._number += 1

    def take(self, message: object) -> str:
        """Take note; why the intention is over, or ""."""
        from plant_sim.hand import NO_LONGER
        from protocol import messages as m

        match message:
            case m.PlantState():
                return self._take_state(message)
            case m.Health():
                self.told = message.note.partition(NO_LONGER)[2]
            case m.Override(seq=0) if self._said_at is not None:
                if message.mode == "auto":
                    return self._not_mine(f"{message.run_id} gave it back to the controller")
                if self._of == "override":
                    return self._not_mine(f"{message.run_id} took over")
            case m.Reference() if self._said_at is not None and self._of == "reference":
                self.elsewhere = True
                return self._not_mine(f"{message.run_id} said where to go")
        return ""

    def _not_mine(self, why: str) -> str:
        self.mine = False
        return why

    def _take_state(self, state: PlantState) -> str:
        self.state = state
        if self._said_at is None:
            return ""
        run_id, seq = self._said_at
        if self.begun and state.run_id != run_id:
            return "the gateway was started again"
        by_hand = state.source == "manual"
        if self.begun and not by_hand:
            return "the plant is not driven by hand any more"
        # The sample after the next one is the first whose whole period it may have acted in.
        self.begun = self.begun or (by_hand and state.seq > seq + 1)
        return ""


def assignments(texts: list[str], plant: Description) -> dict[str, float]:
    """`u=1.2` and so on, by input. Raises `Refused`."""
    given: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in plant.inputs:
            raise terminal.Refused(
                f"{text}: {plant.name} has no input {name!r}; it has {', '.join(plant.inputs)}"
            )
        try:
            given[name] = float(value)
        except ValueError:
            raise terminal.Refused(f"{text}: write {name}=VALUE, with a number") from None
        if not math.isfinite(given[name]):
            raise terminal.Refused(f"{text}: a finite number is needed")
    if not given:
        raise terminal.Refused(f"name an input: {' '.join(f'{name}=VALUE' for name in plant.inputs)}")
    return given


def acting(state: PlantState) -> list[float] | None:
    """The input that acts at a sample, (m,); None where that is not known."""
    return state.pieces[-1].u if state.pieces else state.applied


def completed(named: dict[str, float], plant: Description, acts: list[float] | None) -> np.ndarray:
    """The whole input, (m,), with those that are not named as they are. Raises `Refused`: that is not known."""
    import numpy as np

    others = [name for name in plant.inputs if name not in named]
    if others and acts is None:
        raise terminal.Refused(f"it is not known what acts now: name {', '.join(others)} too")
    values = [named[name] if name in named else acts[i] for i, name in enumerate(plant.inputs)]  # type: ignore[index]
    return np.clip(np.array(values), plant.u_min, plant.u_max)


def figures(names: tuple[str, ...], values: object) -> str:
    """z 0.5000  y 1.6070"""
    return "  ".join(f"{name} {value:.4f}" for name, value in zip(names, values, strict=True))  # type: ignore[call-overload]


def line(state: PlantState, plant: Description, seconds: float) -> str:
    """What acts and where the plant is: once a second, for a person."""
    import numpy as np

    x = np.array(state.x)
    room = np.minimum(x - plant.x_min, plant.x_max - x) / plant.x_scale
    least = int(np.argmin(room))
    acts = acting(state)
    u = "not known" if acts is None else figures(plant.inputs, acts)
    where = f"margin {room[least]:.3f} of {plant.states[least]}"
    return f"{seconds:6.1f} s  {state.source:8}{figures(plant.states, x)}  |  {u}  |  {where}"
