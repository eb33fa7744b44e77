"""`tandem manual`, `tandem pause` and `tandem auto`: manual control of a running plant."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import Configured

if TYPE_CHECKING:
    import threading

    from lbmpc.plants import Description
    from node_runtime.config.sections import Config
    from protocol.messages import Message
    from tandem.operating.commander import Commander, Word
    from tandem.operating.hand_session import Follower

RENEWALS = 3
"""Share of a lease: two messages may be lost."""
HEARD_S, HEARD_PERIODS = 2.0, 4.0
HEALTH_S = 0.7
"""Seconds: a little more than the interval of health messages."""
LOOK_S = 0.1
LONGEST_S = 1e8
ENDED = 1


@contextmanager
def on_the_bus(config: Config) -> Iterator[tuple[Commander, threading.Event]]:
    """A commander, and the event that Ctrl-C sets. Raises as `tandem.operating.commander.commanding`."""
    from node_runtime.lifecycle import stopped_by_signals
    from protocol import topics
    from tandem.operating.commander import commanding

    heard = (
        *(topics.PLANT_STATE, topics.RESULT, topics.HEALTH["plant"]),
        *(topics.OVERRIDE, topics.REFERENCE),
    )
    with stopped_by_signals() as stopping, commanding(config, *heard) as commander:
        yield commander, stopping


def patience(config: Config) -> float:
    """Seconds in which a plant publishes its state."""
    return max(HEARD_S, HEARD_PERIODS * config.period)


@dataclass(frozen=True, kw_only=True)
class ByHand(Configured):
    """A command that stays in the foreground while its message counts."""

    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint="(default: until Ctrl-C)")] = None
    """Duration in seconds."""

    def run(self) -> int:
        config, plant = self.resolve_with_plant()
        if self.seconds is not None:
            terminal.limited("--seconds", self.seconds, 0.0, LONGEST_S)
        self._check(plant)
        with on_the_bus(config) as (commander, stopping):
            return self._command(config, plant, commander, stopping)

    def _check(self, plant: Description) -> None:
        """Raise `Refused` for a mistake that needs no bus to be found."""

    def _command(
        self, config: Config, plant: Description, commander: Commander, stopping: threading.Event
    ) -> int:
        raise NotImplementedError

    def _stay(
        self,
        config: Config,
        plant: Description,
        commander: Commander,
        stopping: threading.Event,
        word: Word,
        follower: Follower,
    ) -> str:
        """Repeat the message until something ends it; return the reason, or "" if the person ended it."""
        from node_runtime.realtime import clock
        from tandem.operating.hand_session import lease_of, line

        began = clock.now()
        every, limit = lease_of(config.period) / RENEWALS, patience(config)
        end = math.inf if self.seconds is None else began + self.seconds
        said = shown = -math.inf
        while not stopping.is_set() and (now := clock.now()) < end:
            if now - said >= every:
                # Number 0 begins the session and is repeated until it is accepted; later numbers renew it.
                commander.say(word, again=not follower.begun)
                follower.said()
                said = now
            heard = commander.hear(min(said + every - now, end - now, LOOK_S))
            why = "" if heard is None else follower.take(heard)
            if not why and not follower.begun and now - began > limit:
                why = "neither the plant nor a controller accepted it"
            if why:
                return self._reason(commander, follower, why)
            if follower.state is not None and now - shown >= 1.0:
                self.say(line(follower.state, plant, now - began))
                shown = now
        return ""

    def _reason(self, commander: Commander, follower: Follower, why: str) -> str:
        """The reason as the plant reports it in its next health, if the plant ended the session."""

        def told(heard: Message) -> bool:
            follower.take(heard)
            return bool(follower.told) or not follower.mine

        if follower.mine and not follower.told:
            commander.hear_until(told, HEALTH_S)
        return follower.told or why if follower.mine else why

    def _ended(self, why: str, what: str) -> int:
        self.say(f"{what} ended: {why}" if why else f"{what} ended", style="yellow" if why else None)
        self.emit({"ended": why or "given back"})
        return ENDED if why else 0


@dataclass(frozen=True, kw_only=True)
class Manual(ByHand):
    """Drive a running plant manually, until Ctrl-C or until it would leave X. The controller continues to learn, and
    takes over at the end. With certificates it needs the commander's."""

    inputs: Annotated[Positional[list[str]], arg(metavar="INPUT=VALUE...")]
    """u=1.2, in the plant's own units; inputs that are not named keep their value."""

    def _check(self, plant: Description) -> None:
        from tandem.operating.hand_session import assignments

        assignments(self.inputs, plant)

    def _command(
        self, config: Config, plant: Description, commander: Commander, stopping: threading.Event
    ) -> int:
        from protocol.messages import Override
        from tandem.operating.hand_session import (
            Follower,
            assignments,
            clipped,
            completed,
            figures,
            lease_of,
        )

        named = assignments(self.inputs, plant)
        follower = Follower(commander.run_id, Override)

        def seen(heard: Message) -> bool:
            follower.take(heard)
            return follower.state is not None

        commander.hear_until(seen, patience(config))
        if follower.state is None:
            raise terminal.Refused(f"no messages of a plant {config.name} at {config.bus.endpoint}")
        u = completed(named, plant, follower.state.acting)
        word = Override(
            run_id=commander.run_id, seq=0, mode="manual", u=u.tolist(), lease=lease_of(config.period)
        )
        self.say(f"manual control: {figures(plant.inputs, u)}{clipped(u, plant)}; Ctrl-C ends it")
        follower.told = ""
        why = self._stay(config, plant, commander, stopping, word, follower)
        if not (why and follower.begun):
            commander.say_last(Override(run_id=commander.run_id, seq=0, mode="auto"))
        return self._ended(why, "manual control")


@dataclass(frozen=True, kw_only=True)
class Pause(ByHand):
    """Let the controller hold a running plant at the equilibrium nearest to its state, until Ctrl-C. With certificates
    it needs the commander's."""

    def _command(
        self, config: Config, plant: Description, commander: Commander, stopping: threading.Event
    ) -> int:
        from protocol.messages import Reference
        from tandem.operating.hand_session import Follower, lease_of

        word = Reference(run_id=commander.run_id, seq=0, kind="hold", lease=lease_of(config.period))
        follower = Follower(commander.run_id, Reference)
        self.say("paused; Ctrl-C ends the pause")
        why = self._stay(config, plant, commander, stopping, word, follower)
        # If another person gives a reference, that counts; `auto` is handled here.
        if not follower.elsewhere:
            commander.say_last(Reference(run_id=commander.run_id, seq=0, kind="configured"))
        return self._ended(why, "pause")


@dataclass(frozen=True, kw_only=True)
class Auto(Configured):
    """Return a plant from manual control or from a pause to its controller. With certificates it needs the
    commander's."""

    def run(self) -> int:
        config, _plant = self.resolve_with_plant()
        from node_runtime.realtime import clock
        from protocol.messages import Override
        from tandem.operating.hand_session import Follower

        with on_the_bus(config) as (commander, stopping):
            commander.say_last(Override(run_id=commander.run_id, seq=0, mode="auto"))
            follower, source = Follower(commander.run_id, Override), ""
            end = clock.now() + patience(config)
            while source in ("", "manual") and not stopping.is_set() and (left := end - clock.now()) > 0.0:
                heard = commander.hear(min(left, LOOK_S))
                if heard is not None:
                    follower.take(heard)
                    source = "" if follower.state is None else follower.state.source
        if source in ("", "manual"):
            why = "the plant is still under manual control" if source else "no messages of a plant"
            terminal.complain(f"{why} at {config.bus.endpoint}", self.json)
            return ENDED
        self.say(f"driven by: {source}")
        self.emit({"source": source})
        return 0
