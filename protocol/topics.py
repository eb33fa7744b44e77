"""The table of topics: messages, lanes and sizes.

`control` is dropped rather than queued, sent at once, and never waits behind anything. `bulk` blocks, on a
session and a thread of its own. Everything that travels is logged; what a fast loop leaves out of a topic, and out
of the log's views for people, is stated here as a rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from protocol import messages as m

Lane = Literal["control", "bulk"]
PREFIX = "tandem"
DIRECT = "@direct"
PROCESSES = ("router", "plant", "controller", "trainer", "recorder")
COMMANDER = "commander"
"""The role that gives set-points and drives the plant manually."""


@dataclass(frozen=True)
class Topic:
    """One topic; `name` is its key below `tandem/<plant>/`."""

    name: str
    type: type[m.Message]
    lane: Lane
    writer: str
    max_bytes: int = 64 * 1024
    max_hz: float = math.inf
    """A faster loop publishes it at every n-th tick only, and when its content changes."""
    view_hz: float = math.inf
    """Messages a second that have a view in the log; the log has the bytes of all messages, whatever the rate."""
    batched: bool = False
    """In a fast loop the log and the viewers get many of its messages in one `Batch`; see `batched_at`."""

    @property
    def shared(self) -> bool:
        """Whether several clients may write it at a time, and the newest message counts."""
        return self.writer == COMMANDER

    def every(self, period: float) -> int:
        """Return the number of ticks from one message to the next in a loop of this period, in seconds."""
        return max(1, math.ceil(1.0 / (period * self.max_hz) - 1e-9))

    def batched_at(self, rate: float) -> bool:
        """Return whether its messages are logged from a `Batch` at this sampling rate, in Hz."""
        return self.batched and rate > BATCH_ABOVE_HZ

    def key(self, plant: str) -> str:
        return below(plant, self.name)

    def direct_key(self, plant: str) -> str:
        """Key of a fast loop's control messages: no wildcard matches it, so only its subscribers are woken."""
        return below(plant, f"{DIRECT}/{self.name}")

    def keys(self, plant: str) -> list[str]:
        """Return every key at which its messages may travel, whatever the rate."""
        direct = [self.direct_key(plant)] if self.batched and self.lane == "control" else []
        return [self.key(plant), *direct]


WEIGHTS_LIMIT = 16 * 1024 * 1024

# Above this rate, in Hz, messages for log and viewers travel together; up to it every message travels alone.
BATCH_ABOVE_HZ = 100.0
# Seconds for which messages of a batch wait, and bytes above which they do not.
BATCH_S = 0.02
BATCH_BYTES = 1024 * 1024

# No plot shows more points a second, and each costs as much as the logging itself.
VIEW_HZ = 100.0

PLANT_STATE = Topic("plant/state", m.PlantState, "control", "plant", view_hz=VIEW_HZ, batched=True)
COMMAND = Topic(
    "controller/command", m.Command, "control", "controller", 256 * 1024, view_hz=VIEW_HZ, batched=True
)
BACKUP = Topic("controller/backup", m.Backup, "control", "controller", 256 * 1024)
TICK = Topic("controller/tick", m.Tick, "bulk", "controller", WEIGHTS_LIMIT, view_hz=VIEW_HZ, batched=True)
RESULT = Topic("controller/result", m.TickResult, "bulk", "controller", view_hz=VIEW_HZ, batched=True)
TIMING = Topic("controller/timing", m.TickTiming, "bulk", "controller", view_hz=VIEW_HZ, batched=True)
SAMPLES = Topic("controller/samples", m.Samples, "bulk", "controller", 1024 * 1024)
OUTPUT_WEIGHTS = Topic(
    "controller/output_weights", m.OutputWeights, "bulk", "controller", WEIGHTS_LIMIT, max_hz=50.0
)
KEYFRAME = Topic("controller/keyframe", m.Keyframe, "bulk", "controller", 4 * WEIGHTS_LIMIT)
SETS = Topic("controller/sets", m.CertifiedSets, "bulk", "controller", WEIGHTS_LIMIT)
HIDDEN_WEIGHTS = Topic("trainer/hidden_weights", m.HiddenWeights, "bulk", "trainer", WEIGHTS_LIMIT)
REFERENCE = Topic("operator/reference", m.Reference, "control", COMMANDER, 256 * 1024)
OVERRIDE = Topic("operator/override", m.Override, "control", COMMANDER)
BATCH = {
    name: Topic(f"{name}/batch", m.Batch, "bulk", name, 4 * WEIGHTS_LIMIT) for name in ("plant", "controller")
}
RUN_INFO = {name: Topic(f"{name}/run_info", m.RunInfo, "bulk", name) for name in PROCESSES}
HEALTH = {name: Topic(f"{name}/health", m.Health, "bulk", name) for name in PROCESSES}

ALL: tuple[Topic, ...] = (
    PLANT_STATE,
    COMMAND,
    BACKUP,
    TICK,
    RESULT,
    TIMING,
    SAMPLES,
    OUTPUT_WEIGHTS,
    KEYFRAME,
    SETS,
    HIDDEN_WEIGHTS,
    REFERENCE,
    OVERRIDE,
    *BATCH.values(),
    *RUN_INFO.values(),
    *HEALTH.values(),
)
BY_NAME = {topic.name: topic for topic in ALL}
LARGEST_MESSAGE = max(topic.max_bytes for topic in ALL)


OUTBOX_QUERY = "controller/outbox"
"""Queryable: `?run=RUN;since=SEQ;last=K` answers with `Samples` batches."""
HIDDEN_QUERY = "controller/hidden"
"""Queryable: answers with the controller's current `HiddenSnapshot`."""
USER = "user"
"""Keys below `tandem/<plant>/user/` are free for topics of users, which are recorded and never obeyed."""
USER_MAX_BYTES = 256 * 1024
"""Largest message on such a topic: as large as a command may be."""
LARGEST_QUESTION = 4096
"""Characters of the parameters of a query."""


def below(plant: str, name: str) -> str:
    """Return the full key of a topic, or of a queryable, of one plant."""
    return f"{PREFIX}/{plant}/{name}"


def is_user(name: str) -> bool:
    """Return whether a key below `tandem/<plant>/` belongs to a user's topic."""
    return name.startswith(f"{USER}/")


def user_keys(plant: str) -> str:
    """Return the key expression that covers all topics of users."""
    return below(plant, f"{USER}/**")


def everything(plant: str) -> str:
    """Return the key expression that covers all of a plant's topics."""
    return below(plant, "**")


def topic_of(key: str) -> Topic | None:
    """Return the topic of a full key, or None for an unknown key."""
    parts = key.split("/", 2)
    if len(parts) != 3 or parts[0] != PREFIX:
        return None
    return BY_NAME.get(parts[2])
