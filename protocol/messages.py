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
"""Largest number: memories, logs and other programs hold signed 64-bit integers."""
Count = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
Sequence = Annotated[int, msgspec.Meta(ge=-1, le=LARGEST)]
"""A sequence number; -1 means "none yet"."""
RunId = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
Digest = Annotated[str, msgspec.Meta(max_length=64)]

InputSource = Literal["hold", "command", "plan", "safe", "manual"]
"""Source of the input: held at x0, a fresh command, the backup policy or else the last plan, the local safe input, or
manual control."""
CommandMode = Literal["solver", "shifted_plan", "feedback"]
StateVerdict = Literal["fresh", "stale", "missing"]
WeightsOutcome = Literal["none", "adopted", "refused"]
TargetStatus = Literal["none", "reached", "nearest", "no rest"]
ReferenceKind = Literal["set", "hold", "configured"]
"""set: outputs go to values; hold: the plant stays at the nearest equilibrium; configured: the reference of the
configuration."""
ProcessStatus = Literal["starting", "ready", "running", "stopping", "failed"]
BAD = "bad_"
"""Prefix of the counters of messages that are not obeyed."""


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Fields of every message: its writer, and its number within that run."""

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
        # A shape with a 0 in it has no data, whatever its other numbers; numpy refuses those it cannot hold.
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
        """Return a new writable copy, in this machine's byte order."""
        return np.frombuffer(self.data, dtype=self.dtype).reshape(self.shape).astype(self.dtype[1:])


class Piece(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A stretch of time under one input."""

    seconds: Annotated[float, msgspec.Meta(ge=0)]
    u: list[float]


class PlantState(Message, frozen=True, kw_only=True):
    """One sample of the plant, x(t), and the input that acted since the previous sample."""

    t: float
    """Seconds on the plant's own monotonic clock."""
    x: list[float]
    applied: list[float] | None
    """Time average of the input over the last period; None if that period was incomplete."""
    pieces: list[Piece] = msgspec.field(default_factory=list)
    """The inputs of that period, in order, if there were several; else empty. In an incomplete period, those that acted
    in it: the last still acts."""
    source: InputSource
    command_seq: Sequence
    """Tick of the last command received, -1 before the first."""
    missing: list[str] | msgspec.UnsetType = msgspec.UNSET
    """Names of the states without a reading; their entries of x are ignored. Unset, and no byte, if there are none."""

    @property
    def acting(self) -> list[float] | None:
        """The input that acts at this sample, (m,); None if it is not known."""
        return self.pieces[-1].u if self.pieces else self.applied


class Command(Message, frozen=True):
    """The input for now and the whole remaining plan; `seq` is the tick."""

    state_run_id: str
    state_seq: Sequence
    """Number of the `PlantState` that this command answers; -1 if it answers none (it follows the shifted plan)."""
    period: float
    """Seconds between the entries of `plan`."""
    mode: CommandMode
    u: list[float]
    plan: list[list[float]]
    """Inputs for this period and the following ones; plan[0] is u."""


class Backup(Message, frozen=True):
    """What to follow if no further command comes, from one period after command `seq` began to act.

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
    """Loss on the training data; if labels have a variance, on held-out data in units of that variance."""
    loss_after: float
    network_sha256: Digest
    sha256: Digest
    layers: list[Array]
    """Hidden layer i as (1 + n_{i-1}, n_i); the first row is the bias."""
    newest: Sequence | msgspec.UnsetType = msgspec.UNSET
    """The last sample of that run in the training data, -1: none; unset, and no byte, if labels are exact."""


MOST_POINTS = 1000
Lease = Annotated[float, msgspec.Meta(gt=0, le=60)]
"""Seconds for which a person's message counts without a repetition."""


class Reference(Message, frozen=True):
    """A reference for the plant, from the tick on that latches it.

    It leads in a straight line from the present reference to the first point, and from point to point. It stays at the
    last one. Two points of one time are a step. A repetition renews the lease and does not start the reference again.
    """

    kind: ReferenceKind = "set"
    outputs: list[str] = []
    """Names of the states that are outputs; with `set` only."""
    times: Annotated[list[float], msgspec.Meta(max_length=MOST_POINTS)] = []
    """Times of the points, seconds from that tick on, in ascending order."""
    values: Annotated[list[list[float]], msgspec.Meta(max_length=MOST_POINTS)] = []
    """(points, outputs), plant units."""
    lease: Lease | None = None
    """Seconds without a repetition until the configured reference returns; None: it does not."""


class Override(Message, frozen=True):
    """Manual control of the plant's input. It counts until `auto`, or until its lease ends."""

    mode: Literal["manual", "auto"]
    u: list[float] = []
    """(m,), plant units; with `manual` only."""
    lease: Lease = 1.0


class Tick(Message, frozen=True):
    """Everything on which one control step depends: the latched inputs and every verdict that depended on time."""

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
    """Hidden weights that arrived since the previous tick; adopted or refused within this tick."""
    truth: dict[str, float] = msgspec.field(default_factory=dict)
    """Parameters of the true plant that change in this tick: an experiment tells them to the oracle `perfect`."""
    reference: Reference | msgspec.UnsetType = msgspec.UNSET
    """The last one that arrived since the previous tick; unset, and no byte, if there was none."""

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
        """A tick of a loop that never skips a slot; a state, if there is one, is fresh."""
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
    """The result of one control step; a pure function of the ticks up to this one."""

    x: list[float]
    u: list[float]
    mode: CommandMode
    status: str
    iterations: Count
    slack: float
    """Largest state-constraint violation of the nominal plan, as a share of that state's half-width."""
    slack_row: str
    """That row, as "y at step 3"; empty if none."""
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
    """Hash of the tick's bytes: a replay of a tick with any changed bit cannot reproduce this result."""
    input_delay: float
    """Seconds for which the state was predicted ahead before the problem was solved."""
    weights_verdict: str
    """"none", "adopted", or "refused: <reason>"."""
    set_margin: float | None = None
    """Distance of the state to the boundary of the certified sets, as a share of X's half-widths, negative outside;
    None without such sets, or without a state."""
    set_piece: int = -1
    """Number of the certified set that holds the state; -1: none."""
    weights_rolled_back: str = ""
    """Why the previous hidden weights and K came back in this tick; empty if they did not."""
    target_status: TargetStatus = "none"
    """reached: the target's outputs are at their reference; nearest: as near as an equilibrium allows; no rest: no
    equilibrium was found; none: there is no reference, and the plan aims at x_e."""
    target_x: list[float] = []
    """x of the target; empty if there is none."""
    target_u: list[float] = []
    target_distance: float | None = None
    """Largest distance of its outputs from their reference, as a share of the output's half-width."""
    sensor_faults: dict[str, str] = msgspec.field(default_factory=dict)
    """Sensor faults, by the names of their states: the fault, and what is known of these states."""
    reference: dict[str, float] = {}
    """Reference of the outputs in this tick, by name, plant units; empty if there is none."""
    reference_verdict: str = "none"
    """Verdict on the tick's reference: "none", "taken", or "refused: <reason>"."""
    reference_from: str = ""
    """run_id of its sender; empty without one."""
    weight: list[float] = []
    """Weight of the network in the prediction of each state, 0 to 1; empty if nothing weighs it."""
    constant_weight: list[float] = []
    """Weight of the constant beside it, that of `lbmpc.oracles.dnn.evidence`, likewise."""
    deviation: list[float] = []
    """Standard deviation of each estimated state, its own units; empty if the sample is the state."""
    noise: list[float] = []
    """Standard deviation of each state's measurement noise as found by the estimator, its own units, 0 for unmeasured
    states; empty if the noise is configured."""

    def noise_of(self, states: tuple[str, ...]) -> dict[str, float] | None:
        """`noise` by the names of the measured states; None if none was found."""
        return {name: one for name, one in zip(states, self.noise, strict=False) if one > 0.0} or None

    @property
    def weights_outcome(self) -> WeightsOutcome:
        """Verdict on the hidden weights of a tick."""
        outcome = self.weights_verdict.partition(": ")[0]
        return "adopted" if outcome == "adopted" else "refused" if outcome == "refused" else "none"


def counter_name(*words: str) -> str:
    """Return a counter's name in snake_case: "bad plant/state: not finite" becomes "bad_plant_state_not_finite"."""
    return re.sub("[^a-z0-9]+", "_", " ".join(words).lower()).strip("_")


def words_of_fault(state: str, fault: str, since: float) -> str:
    """Return one entry of `TickResult.sensor_faults` that exists since so many seconds, as text for a person."""
    kind, _, known = fault.partition("; ")
    return f"sensor {state} is {kind} since {since:.1f} s; {known}"


def weights_verdict(outcome: WeightsOutcome, reason: str = "") -> str:
    """Return the text of `TickResult.weights_verdict`."""
    return f"{outcome}: {reason}" if reason else outcome


class TickTiming(Message, frozen=True):
    """Durations of one control step on this machine; never part of a replay comparison."""

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
    """Variance of h; empty if the label is exact."""


class Samples(Message, frozen=True):
    """A batch of samples in ascending order; `seq` is that of the last one."""

    samples: list[Sample]


class OutputWeights(Message, frozen=True):
    """K_t after the adaptation of tick `seq`, and the hidden weights to which it belongs."""

    hidden_version: Sequence
    """Highest version adopted so far: new weights need a higher one. After a rollback the hash names the weights."""
    hidden_sha256: Digest
    K: Array
    """(1 + n_L, d), first row the bias; scaled outputs."""


class HiddenSnapshot(Message, frozen=True):
    """The hidden weights that the controller holds, for a trainer that joins late or hears nothing of what it sent.

    `run_id` is the controller's.
    """

    hidden_version: Sequence
    """Highest version adopted so far."""
    hidden_sha256: Digest
    description: str
    """The `NetworkDescription`, as JSON."""
    layers: list[Array]
    judged_version: Sequence = -1
    """Version of the hidden weights that this run judged last, as numbered by their sender; -1: none yet."""
    judged_sha256: Digest = ""
    """Hash of those, as given by their sender."""


class Keyframe(Message, frozen=True):
    """The controller's whole memory after tick `seq` (-1: before the first)."""

    arrays: dict[str, Array]
    resumed: str = ""
    """Before the first tick: the run whose memory continues here, from a checkpoint; empty: a new memory."""


class CertifiedSets(Message, frozen=True):
    """The certified sets of a controller, complete: a replay needs no other file."""

    kind: str
    sha256: Digest
    content: bytes
    """The file of `tandem sets compute`."""


class RunInfo(Message, frozen=True):
    """Information with which a log can be understood and replayed on its own."""

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
    """Nanoseconds between its publication and that of the `Batch`."""
    payload: bytes


class Batch(Message, frozen=True):
    """Messages of a fast loop that no process waits for, in the order of their publication."""

    messages: list[Gathered]


class Health(Message, frozen=True):
    """State of one process, about twice a second and at every change."""

    process: str
    status: ProcessStatus
    counters: dict[str, int]
    """By names of `counter_name`."""
    note: str
