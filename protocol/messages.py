"""Every message that travels, as strict msgspec Structs carried in msgpack.

Each message names the process incarnation that wrote it (`run_id`) and counts up from there (`seq`), because
a restarted process counts from zero again. Vectors are lists of floats, so that a generic tool can plot them;
weights are `Array`s of bytes. Lengths are not checked here but by `protocol.codec.check_dimensions`, since
only the configuration knows how many states and inputs the plant has.

Units are those of the plant's own equations (for the compressor: dimensionless flow, pressure and throttle,
seconds for time), and are listed by name in `RunInfo.units`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec
import numpy as np

LARGEST = 2**63 - 1
"""Memories, logs and third parties' readers hold numbers in 64 bits with a sign."""
Count = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
Sequence = Annotated[int, msgspec.Meta(ge=-1, le=LARGEST)]
"""A sequence number; -1 stands for "none yet"."""
RunId = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
Digest = Annotated[str, msgspec.Meta(max_length=64)]

InputSource = Literal["hold", "command", "plan", "safe", "manual"]
"""What drove the plant: held at x0, a fresh command, the backup policy or else the last plan, the local safe input, a
person."""
CommandMode = Literal["solver", "shifted_plan", "feedback"]
StateVerdict = Literal["fresh", "stale", "missing"]
WeightsOutcome = Literal["none", "adopted", "refused"]
TargetStatus = Literal["none", "reached", "nearest", "no rest"]
ReferenceKind = Literal["set", "hold", "configured"]
"""set: outputs go to values; hold: the plant stays where it is, as far as it can rest there; configured: what the
configuration says."""
ProcessStatus = Literal["starting", "ready", "running", "stopping", "failed"]
BAD = "bad_"
"""What the counters of messages that are not obeyed begin with."""


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What every message carries: who wrote it, and its place in that writer's sequence."""

    run_id: RunId
    seq: Sequence


LONGEST = 2**40
DIMENSIONS = 8


class Array(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A dense array: little-endian, row-major. No object dtypes, no pickle."""

    dtype: Literal["<f4", "<f8", "<i8", "|u1"]
    shape: list[Count]
    data: bytes

    def __post_init__(self) -> None:
        # A shape with a 0 in it fits no data at all, whatever its other numbers; numpy refuses those it cannot hold.
        if len(self.shape) > DIMENSIONS or math.prod(max(1, length) for length in self.shape) > LONGEST:
            raise ValueError(f"no array has the shape {str(self.shape)[:80]}")
        expected = math.prod(self.shape) * np.dtype(self.dtype).itemsize
        if expected != len(self.data):
            raise ValueError(
                f"array of shape {self.shape} and dtype {self.dtype} needs {expected} bytes, has {len(self.data)}"
            )

    @classmethod
    def of(cls, values: np.ndarray, dtype: Literal["<f4", "<f8", "<i8", "|u1"] = "<f8") -> Array:
        packed = np.asarray(values).astype(dtype, order="C", copy=False)
        return cls(dtype, list(packed.shape), packed.tobytes())

    def numpy(self) -> np.ndarray:
        """A fresh writable copy, in this machine's byte order."""
        return np.frombuffer(self.data, dtype=self.dtype).reshape(self.shape).astype(self.dtype[1:])


class Piece(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A stretch of time under one input."""

    seconds: Annotated[float, msgspec.Meta(ge=0)]
    u: list[float]


class PlantState(Message, frozen=True, kw_only=True):
    """One sample of the plant, x(t), and the input that really acted since the sample before."""

    t: float
    """Seconds on the plant's own monotonic clock."""
    x: list[float]
    applied: list[float] | None
    """Time average of the input over the last period; None where that period was not a whole one."""
    pieces: list[Piece] = msgspec.field(default_factory=list)
    """The inputs that made up that period, in order, where there was more than one; else empty. Where it was not a
    whole one, those that acted in it: the last still acts."""
    source: InputSource
    command_seq: Sequence
    """Tick of the last command received, -1 before the first."""
    missing: list[str] | msgspec.UnsetType = msgspec.UNSET
    """States of which no number came, by name; their entries of x count nothing. Unset, and no byte, where all did."""

    @property
    def acting(self) -> list[float] | None:
        """The input that acts at this sample, (m,); None where that is not known."""
        return self.pieces[-1].u if self.pieces else self.applied


class Command(Message, frozen=True):
    """The input for now and the whole remaining plan; `seq` is the tick."""

    state_run_id: str
    state_seq: Sequence
    """The `PlantState` that this command answers; -1 when it answers none (follows the shifted plan)."""
    period: float
    """Seconds between the entries of `plan`."""
    mode: CommandMode
    u: list[float]
    plan: list[list[float]]
    """Inputs for this period and the following ones; plan[0] is u."""


class Backup(Message, frozen=True):
    """What to follow when no command comes any more, from one period after command `seq` began to act.

    In the i-th period from then on u = inputs[i] + gain x, with x as the plant's own sensors have it at that period's
    beginning; plant units.
    """

    period: float
    """Seconds between the entries of `inputs`."""
    gain: list[list[float]]
    """(m, d)."""
    inputs: list[list[float]]
    """(N, m)."""


class HiddenWeights(Message, frozen=True):
    """W_1..W_{L-1} after one training; `seq` is the version and rises within a trainer's run."""

    for_run: RunId
    """The controller run whose samples and output weights this was trained on."""
    trained_on: Sequence
    """T_k: the tick of the output weights K_{T_k} held fixed in this training."""
    base_sha256: Digest
    """Hash of the hidden weights that the controller held at T_k."""
    samples: Count
    loss_before: float
    """On what it was trained on; where labels have a variance on what was held out, in units of that variance."""
    loss_after: float
    network_sha256: Digest
    sha256: Digest
    layers: list[Array]
    """Hidden layer i as (1 + n_{i-1}, n_i); the first row is the bias."""
    newest: Sequence | msgspec.UnsetType = msgspec.UNSET
    """The last sample of that run that had a part in it, -1: none; unset, and no byte, where labels are exact."""


MOST_POINTS = 1000
Lease = Annotated[float, msgspec.Meta(gt=0, le=60)]
"""Seconds for which a person's word counts that is not said again."""


class Reference(Message, frozen=True):
    """Where the plant shall go, from the tick on that latches it.

    From where the reference is then it leads in a straight line to the first point, and from point to point. It stays
    at the last. Two points of one time are a jump. To say it again in time is a lease; it is not followed from its
    beginning again then.
    """

    kind: ReferenceKind = "set"
    outputs: list[str] = []
    """Names of the states that are outputs; with `set` only."""
    times: Annotated[list[float], msgspec.Meta(max_length=MOST_POINTS)] = []
    """Of the points, seconds from that tick on, none of them less than the one before."""
    values: Annotated[list[list[float]], msgspec.Meta(max_length=MOST_POINTS)] = []
    """(points, outputs), plant units."""
    lease: Lease | None = None
    """After so long without a repetition the configured reference is back; None: it stays."""


class Override(Message, frozen=True):
    """A hand on the plant's input. It counts until `auto`, or until its lease is over."""

    mode: Literal["manual", "auto"]
    u: list[float] = []
    """(m,), plant units; with `manual` only."""
    lease: Lease = 1.0


class Tick(Message, frozen=True):
    """All that one control step depends on: the latched inputs and every verdict that depended on time."""

    slot: Count
    """Slots since the loop began; seq + the slots skipped so far."""
    t: float
    """Planned time of the slot, seconds since the loop began."""
    skipped: Count
    """Slots missed immediately before this one."""
    lateness: float
    """Seconds between the planned and the real start."""
    late: bool
    state_verdict: StateVerdict
    state: PlantState | None
    weights: HiddenWeights | None
    """Hidden weights that arrived since the tick before; adopted or refused within this tick."""
    truth: dict[str, float] = msgspec.field(default_factory=dict)
    """Parameters of the true plant that are others from this tick on: what an experiment tells the oracle `perfect`."""
    reference: Reference | msgspec.UnsetType = msgspec.UNSET
    """That arrived since the tick before, the last of several; unset, and no byte, where there was none."""

    @classmethod
    def punctual(
        cls,
        run_id: str,
        seq: int,
        period: float,
        state: PlantState | None,
        weights: HiddenWeights | None = None,
        truth: Mapping[str, float] | None = None,
        reference: Reference | msgspec.UnsetType = msgspec.UNSET,
    ) -> Tick:
        """Of a loop that never skips a slot; a state that is there is fresh."""
        return cls(
            run_id=run_id,
            seq=seq,
            slot=seq,
            t=seq * period,
            skipped=0,
            lateness=0.0,
            late=False,
            state_verdict="missing" if state is None else "fresh",
            state=state,
            weights=weights,
            truth=dict(truth or {}),
            reference=reference,
        )


class TickResult(Message, frozen=True):
    """What one control step concluded; a pure function of the ticks up to this one."""

    x: list[float]
    u: list[float]
    mode: CommandMode
    status: str
    iterations: Count
    slack: float
    """Largest state-constraint violation of the nominal plan, as a share of that state's half-width."""
    slack_row: str
    """Which row that is, as "y at step 3"; empty when none."""
    h: list[float] | None
    """Measured h(x_{t-1}, u_{t-1}) = x_t - A x_{t-1} - B u_{t-1}, in deviation coordinates."""
    h_hat: list[float] | None
    """The oracle's estimate of the same, from before this tick's adaptation."""
    prediction_error: float | None
    """|h_hat - h|, Euclidean."""
    oracle_norms: list[float]
    """Norm of each column of K_t (dnn), else empty."""
    hidden_version: Sequence
    hidden_sha256: Digest
    tick_crc32: Count
    """Of the tick's bytes: a replay of a tick that was changed in any bit cannot reproduce this result."""
    input_delay: float
    """Seconds for which the state was predicted ahead before the problem was solved."""
    weights_verdict: str
    """"none", "adopted", or "refused: <reason>"."""
    set_margin: float | None = None
    """Distance of the state to the boundary of the certified sets, as a share of X's half-widths, negative outside;
    None where there are no such sets, or no state."""
    set_piece: int = -1
    """Which of the certified sets the state is in; -1: none."""
    weights_rolled_back: str = ""
    """Why the hidden weights and K from before came back in this tick; empty where they did not."""
    target_status: TargetStatus = "none"
    """Of the target: whether its outputs are where they should be, as near as a rest allows, or no rest was found.
    none: the configuration has no reference, and the plan aims at the equilibrium."""
    target_x: list[float] = []
    """x of the target; empty where there is none."""
    target_u: list[float] = []
    target_distance: float | None = None
    """How far its outputs are from where they should be: the largest, as a share of the output's half-width."""
    sensor_faults: dict[str, str] = msgspec.field(default_factory=dict)
    """Sensors that are not believed, by the names of their states: what is wrong, and what is known of these states."""
    reference: dict[str, float] = {}
    """Where the outputs should be in this tick, by name, plant units; empty where there are none."""
    reference_verdict: str = "none"
    """Of the tick's reference: "none", "taken", or "refused: <reason>"."""
    reference_from: str = ""
    """run_id of who sent that; empty without one."""
    weight: list[float] = []
    """What of the network counts in the prediction of each state, 0 to 1; empty where nothing weighs it."""
    constant_weight: list[float] = []
    """What counts of a constant beside it, that of `lbmpc.oracles.dnn.evidence`, likewise."""
    deviation: list[float] = []
    """Standard deviation of each state as it is estimated, its own units; empty where a sample is the state."""
    noise: list[float] = []
    """Standard deviation of what is measured of each state as the estimator found it, its own units, 0 of those that
    are not measured; empty where it was told."""

    def noise_of(self, states: tuple[str, ...]) -> dict[str, float] | None:
        """`noise` by the names of those that are measured; None where none was found."""
        return {name: one for name, one in zip(states, self.noise, strict=False) if one > 0.0} or None

    @property
    def weights_outcome(self) -> WeightsOutcome:
        """What became of the hidden weights on offer."""
        outcome = self.weights_verdict.partition(": ")[0]
        return "adopted" if outcome == "adopted" else "refused" if outcome == "refused" else "none"


def counter_name(*words: str) -> str:
    """Return a counter's name in snake_case: "bad plant/state: not finite" becomes "bad_plant_state_not_finite"."""
    return re.sub("[^a-z0-9]+", "_", " ".join(words).lower()).strip("_")


def words_of_fault(state: str, fault: str, since: float) -> str:
    """One entry of `TickResult.sensor_faults` that is there since so many seconds, for a person."""
    kind, _, known = fault.partition("; ")
    return f"sensor {state} is {kind} since {since:.1f} s; {known}"


def weights_verdict(outcome: WeightsOutcome, reason: str = "") -> str:
    """The text of `TickResult.weights_verdict`."""
    return f"{outcome}: {reason}" if reason else outcome


class TickTiming(Message, frozen=True):
    """What one control step cost on this machine; never part of a replay comparison."""

    solve_ms: float
    tick_ms: float
    lateness_ms: float
    state_age_ms: float


class Sample(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One labelled pair: x_t, the input applied from t to t+1, and h(x_t, u_t); deviation coordinates."""

    seq: Count
    x: list[float]
    u: list[float]
    h: list[float]
    past: list[list[float]] = msgspec.field(default_factory=list)
    """The k - 1 pairs (x, u) before this one, oldest first, as the controller's network saw them; empty for k = 1."""
    variance: list[float] = msgspec.field(default_factory=list)
    """Of h; empty where the label is exact, as what was measured is taken to be."""


class Samples(Message, frozen=True):
    """A batch of samples in ascending order; `seq` is that of the last one."""

    samples: list[Sample]


class OutputWeights(Message, frozen=True):
    """K_t after the adaptation of tick `seq`, and which hidden weights it belongs to."""

    hidden_version: Sequence
    """Highest that was adopted so far: what is trained next needs a higher one. After a rollback the hash says more."""
    hidden_sha256: Digest
    K: Array
    """(1 + n_L, d), first row the bias; scaled outputs."""


class HiddenSnapshot(Message, frozen=True):
    """The hidden weights that the controller holds, for a trainer that joins late or hears nothing of what it sent.

    `run_id` is the controller's.
    """

    hidden_version: Sequence
    """Highest that was adopted so far."""
    hidden_sha256: Digest
    description: str
    """The `NetworkDescription`, as JSON."""
    layers: list[Array]
    judged_version: Sequence = -1
    """Of the hidden weights that this run adopted or refused last, as their sender numbered them; -1: none yet."""
    judged_sha256: Digest = ""
    """As their sender gave it."""


class Keyframe(Message, frozen=True):
    """The controller's whole memory after tick `seq` (-1: before the first)."""

    arrays: dict[str, Array]
    resumed: str = ""
    """Before the first tick: the run whose memory this one goes on from, from a checkpoint; empty: it began afresh."""


class CertifiedSets(Message, frozen=True):
    """The certified sets that a controller keeps its plant in, whole: a replay needs no other file."""

    kind: str
    sha256: Digest
    content: bytes
    """The file of `tandem sets compute`."""


class RunInfo(Message, frozen=True):
    """What a log needs to be understood and replayed on its own."""

    process: str
    config: str
    """The resolved configuration, as JSON."""
    versions: dict[str, str]
    seed: int
    units: dict[str, str]
    unix_time: float


class Gathered(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One message as it would have travelled alone."""

    topic: str
    ago_ns: Count
    """How long before the `Batch` was sent it was published."""
    payload: bytes


class Batch(Message, frozen=True):
    """Messages of a fast loop that nobody waits for, in the order in which they were published."""

    messages: list[Gathered]


class Health(Message, frozen=True):
    """How one process is, about twice a second and at every change."""

    process: str
    status: ProcessStatus
    counters: dict[str, int]
    """By names of `counter_name`."""
    note: str
