"""The sections of the configuration: typed, strict, one tree for all processes. `loading` reads and checks it.

A misspelt key, a wrong type or a value out of range raises `ConfigError`, which names the key, the file and
the nearest right key or the allowed values. Defaults are the paper's experiment, with settled values for what
the paper leaves out.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from network_model.description import LAYERS, Width
from network_model.operations import Activation
from node_runtime.config import literals

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
# Upper limits are far above every honest use. A log brings its configuration along: memory and time are taken by it.
Count = Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]
"""How many of something, each of which takes memory or time."""
Milliseconds = Annotated[int, msgspec.Meta(ge=1, le=3_600_000)]
Seconds = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
LONGEST_PERIOD = 1e6
Variance = Annotated[float, msgspec.Meta(ge=1e-6, le=1e3)]
"""Two of them differ by so little that rounding leaves a covariance positive."""
LONGEST_HORIZON = 1000
DEAD_TIME = "dead_time"
"""In `plant.truth`, beside the parameters of the equations."""
MOST_DEAD_PERIODS = 50
"""Of a simulated plant, as `lbmpc.model` has it for a controller."""
Unit = Annotated[float, msgspec.Meta(gt=0, lt=1)]
PLANT_NAME = r"^[A-Za-z0-9_-]{1,40}$"
"""What may be part of a key on the bus."""
Name = Annotated[str, msgspec.Meta(pattern=PLANT_NAME)]


AWAKE_BELOW = 0.01
"""Seconds. Waking a sleeping core takes up to a few tenths of a millisecond: little of a longer period, but power all
the time if it is avoided."""


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the configuration file."""


Bounds = Annotated[list[float | None], msgspec.Meta(min_length=2, max_length=2)]
"""Lower and upper; None: there is none. In TOML that is -inf or inf."""


Share = Annotated[float, msgspec.Meta(ge=0, le=1e3)]
Instant = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
"""Seconds from a beginning, or 0."""
Shares = Share | dict[str, Share]
"""Shares of half-widths: one for every state, or by the state's name, and then 0 for those that are not named."""


class SensorsConfig(Section, frozen=True):
    """How the simulated plant is measured: what the true state is not."""

    noise: Shares = 0.0
    """Standard deviation, in half-widths."""
    correlation: Instant = 0.0
    """Seconds in which the noise forgets itself, by a factor of e; 0: it is white."""
    quantisation: Shares = 0.0
    """Step between two values that can be measured, in half-widths."""
    bias: dict[str, Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)]] = msgspec.field(default_factory=dict)
    """Added to what is measured of a state, in half-widths, by its name."""
    bias_at: Instant = 0.0
    """Seconds after the first sample from which on there is a bias."""
    stuck: dict[str, Instant] = msgspec.field(default_factory=dict)
    """Seconds after the first sample from which on a state's sensor shows what it showed then, by name."""
    dead: dict[str, Instant] = msgspec.field(default_factory=dict)
    """Seconds after the first sample from which on no number comes of a state, by name, while those of others do."""
    dropouts: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0
    """Share of samples that are lost, at random."""

    @property
    def random(self) -> bool:
        """Whether two seeds are two different measurements."""
        return bool(self.noise or self.dropouts)


class PlantConfig(Section, frozen=True):
    model: str = "moore_greitzer"
    """A plant that comes with Tandem, or a reference to one's own: "tanks.py:TANKS", "mypackage:PLANT"."""
    x0: list[float] | None = None
    """Initial state in the plant's own units; None: the plant's own (the paper's) x0."""
    x_e: list[float] | None = None
    """State about which the model is linear; None: the plant's own. Equations are linearised there."""
    u_e: list[float] | None = None
    """Input that goes with it."""
    bounds: dict[str, Bounds] = msgspec.field(default_factory=dict)
    """Of X and U, by the name of a state or input, where they are not the plant's own."""
    dead_time: Annotated[float, msgspec.Meta(ge=0, le=1e6)] | None = None
    """Seconds from when the gateway writes an input until the plant begins to answer; None: the plant's own. It is
    part of the model, and another thing than `controller.input_delay_ms`, which ends at the gateway."""
    input_rate_max: dict[str, Positive] = msgspec.field(default_factory=dict)
    """How fast an input may change, in its unit per second, by its name, where that is not the plant's own."""
    rows: dict[str, dict[str, float]] = msgspec.field(default_factory=dict)
    """Constraints beside the bounds, by a name of their own: coefficients by the name of states, or of inputs, in plant
    units, with `min`, `max` or both. Of states a `priority`: 0 is that of the bounds, and what has the higher number
    gives way first. Those of the plant that are not named here stay."""
    truth: dict[str, float] | str = msgspec.field(default_factory=dict)
    """Parameters of the true plant where they differ from the model's, by name, `dead_time` among them: a model that is
    wrong. Or a reference to what moves in the plant's place: other equations, or an object with `step`."""
    plan_patience: Annotated[float, msgspec.Meta(gt=0, le=1e6)] = 1.25
    """Periods without a fresh command after which the plant follows the last plan's next entry."""
    sensors: SensorsConfig = SensorsConfig()


class SolverConfig(Section, frozen=True):
    mode: literals.SolverMode = "converged"
    """"converged" solves every tick to its tolerance; "real_time" takes one prepared Gauss-Newton step."""
    compile: literals.CompileMode = "auto"
    """"auto" compiles the solver's functions where there is a C compiler, once; "never" does not."""
    max_iterations: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 10
    tolerance: Positive = 1e-6
    """Converged when no input of the plan moves by more than this share of its half-width."""
    penalty: Positive = 100.0
    """Exact-penalty weight on soft state constraints: what a violation of one half-width costs, in units of the cost to
    go x'Px with every state at its half-width."""


class BackupConfig(Section, frozen=True):
    """Of the policy that the plant follows when its controller falls silent."""

    enabled: bool = True
    """Up to 100 Hz, and where every state is measured: in a faster loop there is no time for it, and it feeds back all
    states. Elsewhere the plan is what the plant follows."""
    margin: Annotated[float, msgspec.Meta(ge=0, lt=0.5)] = 0.0075
    """By how much X shrinks for it, as a share of its half-widths; less where that would cost the way back."""


class ControllerConfig(Section, frozen=True):
    horizon: Annotated[int, msgspec.Meta(ge=1, le=LONGEST_HORIZON)] = 60
    """N, steps of the prediction."""
    horizon_seconds: Seconds | None = None
    """The horizon in seconds instead. Where a configuration is read it becomes `horizon`, and is None ever after."""
    oracle: literals.OracleName = "dnn"
    tightening: literals.TighteningName = "first_step"
    sets: str | None = None
    """File of certified sets for "invariant"; None: those that `tandem sets compute` left in the cache."""
    W: list[NonNegative] | None = None
    """Half-widths of the disturbance box used for tightening, as h per second of period; None: the plant's own."""
    Q: list[NonNegative] | None = None
    """Diagonal state weights, per second: a stage has Q / rate; None: ones."""
    R: list[Positive] | None = None
    """Diagonal input weights, per second; None: ones."""
    S: list[NonNegative] | None = None
    """Diagonal weights of how fast the inputs change, on (du/dt)^2, per second: a stage has S rate |u_i - u_{i-1}|^2.
    None: zeros."""
    terminal: literals.TerminalName = "riccati"
    """P of the terminal cost: of the LQR with the stage weights, of the feedback K ("lyapunov"), or the one of the
    reimplementation of Aswani et al. (`lbmpc.terminal_cost`)."""
    keyframe_every: Count = 100
    """Ticks between keyframes in the log."""
    late_fraction: Unit = 0.2
    """A tick is late when it starts later than this share of a period after its slot."""
    phase_ms: Annotated[float, msgspec.Meta(ge=0, le=3.6e6)] | None = None
    """How long after a plant sample is due the controller's slot lies; None: 1 ms, at most a quarter of a period."""
    input_delay_ms: Annotated[float, msgspec.Meta(ge=0, le=500.0 * LONGEST_PERIOD)] | None = None
    """From a sample until the command that answers it acts, until the plant has shown it; None: in lock-step 0, live
    the phase and what an answer usually takes."""
    checkpoint: str = ""
    """File from which the controller takes its memory when it is started again; "": none."""
    solver: SolverConfig = SolverConfig()
    backup: BackupConfig = BackupConfig()


class EstimatorConfig(Section, frozen=True):
    """Of the state, from what is measured."""

    kind: literals.EstimatorName = "none"
    """"none": a sample is the state; "kalman": a filter of the nominal model and a disturbance of each state."""
    measured: list[str] | None = None
    """States that a sample measures; of the others its numbers count nothing. None: all."""
    noise: Shares | Literal["innovations"] = 0.01
    """Standard deviation of what is measured, in half-widths; "innovations": found in the first 100 samples."""
    process: Shares | None = None
    """Standard deviation of h, in half-widths per second of period; None: `controller.W`, or else the plant's own."""
    correlation: Seconds | None = None
    """Seconds in which h becomes another along the motion, by a factor of e; None: the plant's time scale, that of its
    slowest mode under K."""


class ReferenceConfig(Section, frozen=True):
    """Where the plans lead: to the equilibrium, or to a rest of the plant as it has been learned."""

    outputs: list[str] | None = None
    """States that shall be at `values`; []: the rest that costs least; None: the plant's equilibrium, rest or not."""
    values: list[float] | None = None
    """One for each output, in the plant's own units; None: those of the equilibrium."""


class NetworkConfig(Section, frozen=True):
    architecture: str = "mlp"
    """How the hidden layers act on the window: mlp, rnn, cnn, or a file of your own, "gru.py:GRU"."""
    window: Annotated[int, msgspec.Meta(ge=1, le=64)] | None = None
    """k, the pairs (x, u) that the network sees, the present one included; None: the architecture's own."""
    options: dict[str, int] = msgspec.field(default_factory=dict)
    """The architecture's own settings, where they are not its defaults."""
    hidden: Annotated[list[Width], msgspec.Meta(max_length=LAYERS)] = msgspec.field(
        default_factory=lambda: [64, 64]
    )
    activation: Activation = "tanh"
    """Of every hidden layer; must be bounded, since the last one is."""
    output_scale: Positive = 0.4
    """h that counts as 1 for the network, in half-widths of each state per time scale of the plant: that of the slowest
    mode under K, `lbmpc.model.Model.time_scale`, 1 s for the compressor."""
    max_layer_norm: Positive = 100.0


class RefitConfig(Section, frozen=True):
    """Of K at an adoption; used where `adaptation.at_adoption` is "refit"."""

    window: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 200
    """Newest samples that the controller remembers for it."""
    ridge: Positive = 1e-4
    """Weight that holds K where it was."""


class TrialConfig(Section, frozen=True):
    """Of new hidden weights, before they are adopted and for a while after."""

    enabled: bool = True
    seconds: Seconds | None = None
    """How far the controller's own samples reach back, on which a set on offer is tried; None: four time scales of the
    plant, those of `network.output_scale`."""
    samples: Annotated[int, msgspec.Meta(ge=10, le=1000)] = 80
    """How many there are of them; a fast loop takes one every few ticks, a slow one reaches further back."""
    confirm: Seconds | None = None
    """Seconds after its adoption in which a set that predicts worse than the one before is rolled back; None: one time
    scale, but 20 samples at least."""
    margin: NonNegative = 0.2
    """Share by which the mean squared error of a new set may be larger than the old one's."""
    floor: NonNegative = 0.003
    """RMS error, as a share of `network.output_scale`, below which a set on offer is good enough in any case."""
    floor_after: NonNegative = 0.1
    """The same for a set that was adopted: what K has not learned yet is no reason to roll back."""


class KalmanConfig(Section, frozen=True):
    """Of the last layer's filter, where that is its law, and of the constant that is learned beside the network where
    there is an estimator. Variances in (output scale)^2."""

    prior_variance: Variance = 0.02
    """Of each entry of K, before the first sample."""
    label_variance: Variance = 1e-3
    """Of each entry of a label: measuring noise, and what the features cannot explain."""
    memory: Seconds | None = None
    """Seconds in which what is known fades towards the prior, by a factor of e; None: two time scales of the plant, ten
    where there is an estimator, but 20 samples at least."""


class AdaptationConfig(Section, frozen=True):
    enabled: bool = True
    """False: the last layer stays at K_0 (hidden layers only)."""
    law: literals.LawName | None = None
    """How a sample moves the last layer: the paper's projected gradient, or a projected Kalman filter. None: kalman
    where there is an estimator, which says how noisy labels are, and gradient where a sample is the state."""
    gamma: Unit = 0.8
    """Learning rate of the gradient law, 0 < gamma < 1."""
    column_bound: Positive = 2.0
    """Bound on the norm of each column of K, as h, in half-widths of its state per time scale of the plant."""
    initial_scale: NonNegative = 1.2e-2
    """Standard deviation of the entries of K_0, likewise."""
    start: literals.StartName = "random"
    """K_0: "random"; "zero"; "pretrained": random, then fitted to h = 0, the middle of W, all over X x U."""
    at_adoption: literals.AdoptionName = "keep"
    """K when hidden layers are adopted: kept, as the paper does, or fitted to the newest samples."""
    kalman: KalmanConfig = KalmanConfig()
    refit: RefitConfig = RefitConfig()
    trial: TrialConfig = TrialConfig()


class ConstantConfig(Section, frozen=True):
    gain: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.5
    """Share of a new label in the filtered one; 1: the last label alone."""


class L2nwConfig(Section, frozen=True):
    window: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 100
    bandwidth: Positive = 1.0
    """Of the Gaussian kernel, in half-widths of each of its variables."""
    regularisation: Positive = 1e-3
    variables: list[str] | None = None
    """Names of the states and inputs the kernel sees; None: the plant's own choice."""


class PlantPlace(Section, frozen=True):
    """Where a trainer of many plants finds one that has a router of its own."""

    name: Name
    """The plant's, as in its own configuration."""
    endpoint: str
    """Its router's: tls/10.0.0.5:7448."""
    keys: str | None = None
    """Folder of the trainer's certificate for this plant; None: `bus.tls.keys`."""


class TrainerConfig(Section, frozen=True):
    enabled: bool = True
    """False: hidden layers are never trained (last layer only)."""
    capacity: Count = 2000
    """p_max of the replay buffer."""
    strategy: literals.Strategy = "fifo"
    train_every: Count = 10
    """New samples between two trainings."""
    min_samples: Count = 20
    batch: Count = 512
    """M, the samples drawn at random from the buffer for one training."""
    steps: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 300
    """Adam steps in one training, each on all M samples."""
    learning_rate: Positive = 1e-3
    device: Literal["auto", "cpu", "cuda"] = "auto"
    fleet: list[PlantPlace] = msgspec.field(default_factory=list)
    """Plants with a router each, trained by one `tandem trainer` (docs/tutorials/fleet.md).

    Empty: the one plant at `bus.endpoint`."""


class TlsConfig(Section, frozen=True):
    keys: str | None = None
    """Folder of this process's own certificate, as `tandem keys create` makes one for each role."""


class BusConfig(Section, frozen=True):
    endpoint: str = "tcp/127.0.0.1:7447"
    """Where the router listens; nodes are its clients. tls/HOST:PORT needs `tls.keys` (docs/tutorials/remote.md)."""
    remote: str | None = None
    """Where the router listens for other machines as well: tls/0.0.0.0:7448. Only the router reads it."""
    insecure: bool = False
    """True: no warning that everybody who reaches a tcp/ endpoint beyond this machine may command the plant."""
    tls: TlsConfig = TlsConfig()
    lease_ms: Milliseconds = 1500
    follow_silence: Seconds = 1.0
    """Seconds of silence after which another process incarnation may take over a topic."""


class LogConfig(Section, frozen=True):
    path: str = "run.mcap"
    chunk_bytes: Annotated[int, msgspec.Meta(ge=1, le=64 * 1024 * 1024)] = 256 * 1024
    flush_ms: Milliseconds = 500
    split_minutes: Annotated[float, msgspec.Meta(ge=0, le=1e6)] = 60.0
    """A new file, NAME.part2.mcap, after so long: the index of a file is in memory until it ends. 0: never."""
    keep: Annotated[int, msgspec.Meta(ge=0, le=1_000_000)] = 0
    """How many of a run's files stay, the one being written included; older ones are removed. 0: all."""


class RealtimeConfig(Section, frozen=True):
    priority: Annotated[int, msgspec.Meta(ge=0, le=99)] = 50
    """SCHED_FIFO priority of router, controller and plant; 0: leave the scheduler alone."""
    awake: literals.AwakeMode = "auto"
    """Keep the cores from sleeping between slots; "auto": where there is a priority and the period is below 10 ms."""
    cores: Literal["auto", "any"] | list[Annotated[int, msgspec.Meta(ge=0, le=8191)]] = "auto"
    """Core of the controller's loop and core of the plant's; "auto": two of their own where `awake` would be needed."""


class Config(Section, frozen=True):
    """The whole tree; `rate` is the one sampling rate of plant, model and controller."""

    name: Name = "jet1"
    """The plant's name, part of every key."""
    rate: Annotated[float, msgspec.Meta(gt=0, le=1e5)] = 20.0
    """Samples a second (Hz)."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0
    plant: PlantConfig = PlantConfig()
    controller: ControllerConfig = ControllerConfig()
    reference: ReferenceConfig = ReferenceConfig()
    estimator: EstimatorConfig = EstimatorConfig()
    network: NetworkConfig = NetworkConfig()
    adaptation: AdaptationConfig = AdaptationConfig()
    constant: ConstantConfig = ConstantConfig()
    l2nw: L2nwConfig = L2nwConfig()
    trainer: TrainerConfig = TrainerConfig()
    bus: BusConfig = BusConfig()
    log: LogConfig = LogConfig()
    realtime: RealtimeConfig = RealtimeConfig()

    @property
    def period(self) -> float:
        """Seconds between samples."""
        return 1.0 / self.rate

    @property
    def awake(self) -> bool:
        """Whether `realtime.awake` keeps the cores from sleeping at this rate."""
        mode = self.realtime.awake
        return mode == "always" or (mode == "auto" and self.fast)

    @property
    def fast(self) -> bool:
        """Whether the loops have a priority and so little time that their cores matter."""
        return self.realtime.priority > 0 and self.period < AWAKE_BELOW
