"""Who may do what on the bus: the one table behind the router's rules and `tandem keys show`.

What a role may publish follows from the writers in `protocol.topics`; what it may read, ask and answer is stated
here. Whatever is not stated is denied.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocol import topics
from protocol.topics import COMMANDER, Topic

VIEWER = "viewer"
"""The role of `tandem health` and `tandem live`: it reads everything and publishes nothing."""
USER = topics.USER
"""The role of a publisher of own topics: it publishes below `user/` and nowhere else, and reads nothing."""
ROLES = (*topics.PROCESSES, VIEWER, COMMANDER, USER)
READS_ALL = ("recorder", VIEWER, COMMANDER)
QUERIES = (topics.OUTBOX_QUERY, topics.HIDDEN_QUERY)

_READS: dict[str, tuple[Topic, ...]] = {
    "controller": (topics.PLANT_STATE, topics.HIDDEN_WEIGHTS, topics.REFERENCE),
    "plant": (topics.COMMAND, topics.BACKUP, topics.OVERRIDE),
    "trainer": (topics.SAMPLES, topics.OUTPUT_WEIGHTS),
}
_ASKS: dict[str, tuple[str, ...]] = {"trainer": QUERIES}
_ANSWERS: dict[str, tuple[str, ...]] = {"controller": QUERIES}


@dataclass(frozen=True)
class Rights:
    """What one role may do, for the plant of its certificate alone."""

    role: str
    publishes: tuple[Topic, ...]
    reads: tuple[Topic, ...]
    """Empty for who reads everything."""
    reads_all: bool
    asks: tuple[str, ...]
    answers: tuple[str, ...]

    def publish_keys(self, plant: str) -> list[str]:
        """Every key that it may publish at."""
        own = [topics.user_keys(plant)] if self.role == USER else []
        return [*_keys(self.publishes, plant), *own]

    def read_keys(self, plant: str) -> list[str]:
        """Key expressions that it may subscribe to; what it hears is covered by them."""
        return [topics.everything(plant)] if self.reads_all else _keys(self.reads, plant)

    def ask_keys(self, plant: str) -> list[str]:
        return [topics.below(plant, name) for name in self.asks]

    def answer_keys(self, plant: str) -> list[str]:
        return [topics.below(plant, name) for name in self.answers]


def rights_of(role: str) -> Rights:
    """The rights of one of `ROLES`. Raises `KeyError` for another word."""
    if role not in ROLES:
        raise KeyError(f"{role!r} is no role; one of {', '.join(ROLES)}")
    return Rights(
        role,
        publishes=tuple(topic for topic in topics.ALL if topic.writer == role),
        reads=_READS.get(role, ()),
        reads_all=role in READS_ALL,
        asks=_ASKS.get(role, ()),
        answers=_ANSWERS.get(role, ()),
    )


def role_of(process: str) -> str:
    """The role in which a process of this name speaks: its own, or the viewer's."""
    return process if process in (*topics.PROCESSES, COMMANDER, USER) else VIEWER


def common_name(role: str, plant: str) -> str:
    """The name in a certificate: `trainer.jet1`."""
    return f"{role}.{plant}"


def _keys(of: tuple[Topic, ...], plant: str) -> list[str]:
    return [key for topic in of for key in topic.keys(plant)]
