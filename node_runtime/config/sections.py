"""The sections of the configuration: typed and strict, one tree for all processes. `loading` reads and checks it.

A misspelt key, a wrong type or a value out of range raises `ConfigError`, which names the key, the file, and the
nearest known key or the allowed values. The defaults are those of the paper's experiment, with values found by
experiment where the paper gives none.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from network_model.description import LAYERS, Width
from network_model.operations import Activation
from node_runtime.config import literals


def unit(name: str) -> msgspec.Meta:
    """Return the mark that gives a key's unit: the reference of the documentation shows it."""
    return msgspec.Meta(extra={"unit": name})


PLANT_UNITS = unit("plant units")
HALF_WIDTHS = unit("half-widths")
Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
# Upper limits are far above any useful value. A log contains its configuration, which then costs memory and time.
Count = Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]
"""A number of things that take memory or time each."""
Milliseconds = Annotated[int, msgspec.Meta(ge=1, le=3_600_000), unit("ms")]
Seconds = Annotated[float, msgspec.Meta(gt=0, le=1e6), unit("s")]
LONGEST_PERIOD = 1e6
Variance = Annotated[float, msgspec.Meta(ge=1e-6, le=1e3)]
"""Limited so that rounding leaves a covariance of two of them positive."""
LONGEST_HORIZON = 1000
DEAD_TIME = "dead_time"
"""The key of the dead time in `plant.truth`, beside the parameters of the equations."""
MOST_DEAD_PERIODS = 50
"""Largest dead time of a simulated plant, in periods. `lbmpc.model` has the same limit for a controller."""
Unit = Annotated[float, msgspec.Meta(gt=0, lt=1)]
PLANT_NAME = r"^[A-Za-z0-9_-]{1,40}$"
"""Pattern of a name that is part of a key on the bus."""
Name = Annotated[str, msgspec.Meta(pattern=PLANT_NAME)]


AWAKE_BELOW = 0.01
"""Seconds. Below this period, cores are kept awake. Waking a core takes up to a few tenths of a millisecond, which is
small compared with a longer period, and keeping it awake costs power all the time."""


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the configuration file."""


Bounds = Annotated[list[float | None], msgspec.Meta(min_length=2, max_length=2)]
"""Lower and upper bound; None for no bound. In TOML, no bound is written -inf or inf."""


Share = Annotated[float, msgspec.Meta(ge=0, le=1e3), HALF_WIDTHS]
Instant = Annotated[float, msgspec.Meta(ge=0, le=1e6), unit("s")]
"""Seconds, 0 included."""
Shares = Share | dict[str, Share]
"""Shares of half-widths: one for every state, or a table by state in which states that are not named have 0."""


class SensorsConfig(Section, frozen=True):
    """Errors of the simulated plant's sensors."""

    noise: Shares = 0.0
    """Standard deviation of the measurement noise: one number for all states, or a table by state."""
    correlation: Instant = 0.0
    """Time in which the noise's correlation falls by a factor of e. 0: white noise."""
    quantisation: Shares = 0.0
    """Step between two values that can be measured."""
    bias: dict[str, Annotated[float, msgspec.Meta(ge=-1e3, le=1e3), HALF_WIDTHS]] = msgspec.field(
        default_factory=dict
    )
    """Offset added to the measurement of a state."""
    bias_at: Instant = 0.0
    """Time after the first sample from which on the bias acts."""
    stuck: dict[str, Instant] = msgspec.field(default_factory=dict)
    """Time after the first sample from which on a state's sensor repeats the value it showed then."""
    dead: dict[str, Instant] = msgspec.field(default_factory=dict)
    """Time after the first sample from which on a state's sensor gives no number, while the others do."""
    dropouts: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0
    """Share of the samples that are lost, at random."""

    @property
    def random(self) -> bool:
        """Whether measurements depend on the seed."""
        return bool(self.noise or self.dropouts)


class PlantConfig(Section, frozen=True):
    """The plant, as the controller knows it and as it is simulated."""

    model: str = "moore_greitzer"
    """A plant that comes with Tandem, or a reference to a plant of your own: "tanks.py:TANKS", "mypackage:PLANT"."""
    x0: Annotated[list[float] | None, PLANT_UNITS] = None
    """Initial state. Without it the plant's own."""
    x_e: Annotated[list[float] | None, PLANT_UNITS] = None
    """State about which the model is linear. Equations are linearised there. Without it the plant's own."""
    u_e: Annotated[list[float] | None, PLANT_UNITS] = None
    """Input that belongs to `x_e`. Without it the plant's own."""
    bounds: Annotated[dict[str, Bounds], PLANT_UNITS] = msgspec.field(default_factory=dict)
    """Lower and upper bound of a state or input, by its name, instead of the plant's own. -inf or inf: no bound."""
    dead_time: Instant | None = None
    """Time from when the gateway writes an input until the plant begins to answer. It is part of the model.
    `controller.input_delay_ms` is another delay, which ends at the gateway. Without it the plant's own."""
    input_rate_max: Annotated[dict[str, Positive], unit("plant units per second")] = msgspec.field(
        default_factory=dict
    )
    """How fast an input may change, by its name, instead of the plant's own limit."""
    rows: Annotated[dict[str, dict[str, float]], PLANT_UNITS] = msgspec.field(default_factory=dict)
    """Constraints on several states or several inputs, by their own names: coefficients by name, with `min`, `max` or
    both. A row of states may have a `priority`: 0 is that of the bounds, and rows with a higher number are violated
    first. Rows of the plant that are not named here stay."""
    truth: dict[str, float] | str = msgspec.field(default_factory=dict)
    """How the true plant differs from the model: parameters of its equations by name, `dead_time` among them. Or a
    reference to another plant, or to an object with `step(x, u, dt)`."""
    plan_patience: Annotated[float, msgspec.Meta(gt=0, le=1e6), unit("periods")] = 1.25
    """Time without a fresh command after which the plant follows the next entry of the last plan."""
    sensors: SensorsConfig = SensorsConfig()
    """Measurement errors of the simulated plant."""


class SolverConfig(Section, frozen=True):
    """The solver of the optimisation problem."""

    mode: literals.SolverMode = "converged"
    """"converged" solves every tick to its tolerance. "real_time" takes one prepared Gauss-Newton step."""
    compile: literals.CompileMode = "auto"
    """"auto" compiles the solver's functions once, where there is a C compiler. "never" does not."""
    max_iterations: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 10
    """Gauss-Newton iterations of one solve at most."""
    tolerance: Annotated[Positive, HALF_WIDTHS] = 1e-6
    """The solver has converged when no input of the plan moves by more than this."""
    penalty: Positive = 100.0
    """Exact-penalty weight on soft state constraints: the cost of a violation of one half-width, in units of the
    cost to go x'Px with every state at its half-width."""


class BackupConfig(Section, frozen=True):
    """The policy that the plant follows when commands stop."""

    enabled: bool = True
    """Send the plant a backup policy. There is one up to 100 Hz, and where every state is measured. Otherwise the
    plant follows the plan."""
    margin: Annotated[float, msgspec.Meta(ge=0, lt=0.5), HALF_WIDTHS] = 0.0075
    """How much the backup policy shrinks X. It shrinks X less where the full margin would leave no way back."""


class ControllerConfig(Section, frozen=True):
    """The controller: its problem, its weights and its timing."""

    horizon: Annotated[int, msgspec.Meta(ge=1, le=LONGEST_HORIZON), unit("steps")] = 60
    """N, the number of predicted steps."""
    horizon_seconds: Seconds | None = None
    """The horizon in seconds, instead of `horizon`. It is converted when the configuration is read."""
    oracle: literals.OracleName = "dnn"
    """Estimate of h: "linear" (none), "constant" (filtered offset), "l2nw" (kernel regression), "dnn" (neural network)
    or "perfect" (the true h, for experiments)."""
    tightening: literals.TighteningName = "first_step"
    """How W tightens the nominal constraints. "none": not at all. "first_step": the next predicted state stays in
    X - W. "tube": every step of the plan is tightened, and its sets may be empty. "invariant": the next state stays in
    certified sets."""
    sets: str | None = None
    """File of certified sets for "invariant". Without it those that `tandem sets compute` left in the cache."""
    W: Annotated[list[NonNegative] | None, unit("plant units per second")] = None
    """Half-widths of the disturbance box for tightening, as h per second of period. Without it the plant's own."""
    Q: Annotated[list[NonNegative] | None, unit("per second")] = None
    """Diagonal state weights: a stage has Q / rate. Without it ones."""
    R: Annotated[list[Positive] | None, unit("per second")] = None
    """Diagonal input weights: a stage has R / rate. Without it ones."""
    S: list[NonNegative] | None = None
    """Diagonal weights of the input's rate of change, on (du/dt)^2: a stage has S rate |u_i - u_{i-1}|^2. Without it
    zeros."""
    terminal: literals.TerminalName = "riccati"
    """P of the terminal cost: of the LQR with the stage weights ("riccati"), of the feedback K ("lyapunov"), or that
    of Aswani et al. ("published"; see `lbmpc.terminal_cost`)."""
    keyframe_every: Annotated[Count, unit("ticks")] = 100
    """Interval between keyframes in the log. A replay can start at a keyframe."""
    late_fraction: Annotated[Unit, unit("periods")] = 0.2
    """A tick is late when it starts later than this after its slot."""
    phase_ms: Annotated[float, msgspec.Meta(ge=0, le=3.6e6), unit("ms")] | None = None
    """Time from when a plant sample is due until the controller's slot. Without it 1 ms, and at most a quarter of a
    period."""
    input_delay_ms: Annotated[float, msgspec.Meta(ge=0, le=500.0 * LONGEST_PERIOD), unit("ms")] | None = None
    """First value of the time from a sample until its command acts; the samples of the plant then show the real one.
    Without it 0 in lock-step, and live the phase plus the usual time of an answer."""
    checkpoint: str = ""
    """File from which a controller that starts again takes its memory. "": none."""
    solver: SolverConfig = SolverConfig()
    """The solver."""
    backup: BackupConfig = BackupConfig()
    """The backup policy."""


class EstimatorConfig(Section, frozen=True):
    """Estimation of the state from measurements."""

    kind: literals.EstimatorName = "none"
    """"none": a sample is the state. "kalman": a filter of the nominal model with a disturbance of each state."""
    measured: list[str] | None = None
    """States that a sample measures. The numbers of the others are ignored. Without it all."""
    noise: Shares | Literal["innovations"] = 0.01
    """Standard deviation of the measurements. "innovations": estimated from the first 100 samples."""
    process: Shares | None = None
    """Standard deviation of h, per second of period. Without it `controller.W`, or else the plant's own W."""
    correlation: Seconds | None = None
    """Time in which the correlation of h along the motion falls by a factor of e. Without it the plant's time
    scale."""


class ReferenceConfig(Section, frozen=True):
    """The reference: the equilibrium, or a rest of the plant according to the learned model."""

    outputs: list[str] | None = None
    """States with set-points. []: no set-points, plans lead to the rest of least cost. Without it plans lead to the
    equilibrium, even where the true plant cannot rest there."""
    values: Annotated[list[float] | None, PLANT_UNITS] = None
    """The set-points, one for each output. Without it the equilibrium's values."""


class NetworkConfig(Section, frozen=True):
    """The network of the oracle `dnn`."""

    architecture: str = "mlp"
    """How the hidden layers act on the window: mlp, rnn, cnn, or a file of your own, "gru.py:GRU"."""
    window: Annotated[int, msgspec.Meta(ge=1, le=64), unit("pairs")] | None = None
    """k, the number of pairs (x, u) that the network sees, the present one included. Without it the architecture's
    own."""
    options: dict[str, int] = msgspec.field(default_factory=dict)
    """Settings of the architecture that differ from its defaults."""
    hidden: Annotated[list[Width], msgspec.Meta(max_length=LAYERS)] = msgspec.field(
        default_factory=lambda: [64, 64]
    )
    """Number of neurons of each hidden layer."""
    activation: Activation = "tanh"
    """Activation of every hidden layer. It must be bounded."""
    output_scale: Annotated[Positive, unit("half-widths per time scale")] = 0.4
    """h that counts as 1 for the network. The time scale is `lbmpc.model.Model.time_scale`, 1 s for the compressor."""
    max_layer_norm: Positive = 100.0
    """The controller refuses hidden weights with a layer above this norm."""


class RefitConfig(Section, frozen=True):
    """The fit of K at an adoption, with `adaptation.at_adoption = "refit"`."""

    window: Annotated[int, msgspec.Meta(ge=1, le=100_000), unit("samples")] = 200
    """Newest samples that the controller keeps for the fit."""
    ridge: Positive = 1e-4
    """Weight of the previous K in the refit."""


class TrialConfig(Section, frozen=True):
    """The trial of new hidden weights, before they are adopted and for a while after."""

    enabled: bool = True
    """Try new hidden weights before they are adopted."""
    seconds: Seconds | None = None
    """Time that the samples cover on which an offered set is tried. Without it four time scales of the plant."""
    samples: Annotated[int, msgspec.Meta(ge=10, le=1000)] = 80
    """Number of these samples. A fast loop takes one of every few ticks. A slow loop covers more time with them."""
    confirm: Seconds | None = None
    """Time after an adoption in which a set that predicts worse than the one before is rolled back. Without it one
    time scale, and at least 20 samples."""
    margin: NonNegative = 0.2
    """Share by which the mean squared error of a new set may exceed the old one's."""
    floor: Annotated[NonNegative, unit("output scale")] = 0.003
    """RMS error below which an offered set is accepted, whatever the error of the set in use."""
    floor_after: Annotated[NonNegative, unit("output scale")] = 0.1
    """The same for an adopted set. It is larger, because K needs samples until it fits the new layers."""


class KalmanConfig(Section, frozen=True):
    """The Kalman filter of the last layer and, with an estimator, of the constant beside the network."""

    prior_variance: Annotated[Variance, unit("output scale squared")] = 0.02
    """Variance of each entry of K before the first sample."""
    label_variance: Annotated[Variance, unit("output scale squared")] = 1e-3
    """Variance of each entry of a label: measurement noise, and what the features cannot explain."""
    memory: Seconds | None = None
    """Time in which knowledge fades towards the prior, by a factor of e. Without it two time scales of the plant, ten
    with an estimator, and at least 20 samples."""


class AdaptationConfig(Section, frozen=True):
    """Adaptation of the last layer at every sample."""

    enabled: bool = True
    """Adapt the last layer. false: it stays at K_0, and only the hidden layers learn."""
    law: literals.LawName | None = None
    """How a sample moves the last layer: the paper's projected gradient, or a projected Kalman filter. Without it
    kalman with an estimator, and gradient otherwise."""
    gamma: Unit = 0.8
    """Learning rate of the gradient law."""
    column_bound: Annotated[Positive, unit("half-widths per time scale")] = 2.0
    """Bound on the norm of each column of K, as h."""
    initial_scale: Annotated[NonNegative, unit("half-widths per time scale")] = 1.2e-2
    """Standard deviation of the entries of K_0, as h."""
    start: literals.StartName = "random"
    """K_0: "random"; "zero"; or "pretrained", random and then fitted to h = 0 over X x U."""
    at_adoption: literals.AdoptionName = "keep"
    """K when hidden layers are adopted: kept, as in the paper, or fitted to the newest samples."""
    kalman: KalmanConfig = KalmanConfig()
    """The Kalman filter of the last layer."""
    refit: RefitConfig = RefitConfig()
    """The refit of K."""
    trial: TrialConfig = TrialConfig()
    """The trial of hidden weights."""


class ConstantConfig(Section, frozen=True):
    """The oracle `constant`."""

    gain: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.5
    """Share of a new label in the filtered one. 1: the last label alone."""


class L2nwConfig(Section, frozen=True):
    """The oracle `l2nw`, kernel regression."""

    window: Annotated[int, msgspec.Meta(ge=1, le=10_000), unit("samples")] = 100
    """Newest samples that are kept."""
    bandwidth: Annotated[Positive, HALF_WIDTHS] = 1.0
    """Bandwidth of the Gaussian kernel, in half-widths of each of its variables."""
    regularisation: Positive = 1e-3
    """Regularisation of the regression, lambda."""
    variables: list[str] | None = None
    """Names of the states and inputs that the kernel sees. Without it the plant's own choice."""


class PlantPlace(Section, frozen=True):
    """A plant with a router of its own, for a trainer of many plants."""

    name: Name
    """The plant's name, as in its own configuration."""
    endpoint: str
    """Endpoint of the plant's router: tls/10.0.0.5:7448."""
    keys: str | None = None
    """Folder of the trainer's certificate for this plant. Without it `bus.tls.keys`."""


class TrainerConfig(Section, frozen=True):
    """The trainer of the hidden layers."""

    enabled: bool = True
    """Train the hidden layers. false: only the last layer learns."""
    capacity: Annotated[Count, unit("samples")] = 2000
    """p_max, the capacity of the replay buffer."""
    strategy: literals.Strategy = "fifo"
    """Which sample a full buffer drops. "fifo": the oldest. "reservoir": a random one, so that all samples so far
    are kept with the same probability. "novelty": the younger of the two closest samples, which suits a plant that does
    not change."""
    train_every: Annotated[Count, unit("samples")] = 10
    """New samples between two trainings."""
    min_samples: Annotated[Count, unit("samples")] = 20
    """Samples in the buffer before the first training."""
    batch: Annotated[Count, unit("samples")] = 512
    """M, the samples drawn at random from the buffer for one training."""
    steps: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 300
    """Number of Adam steps in one training, each on all M samples."""
    learning_rate: Positive = 1e-3
    """Learning rate of Adam."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the training. auto: a GPU where there is one."""
    fleet: list[PlantPlace] = msgspec.field(default_factory=list)
    """Plants with a router each, trained by one `tandem trainer` (docs/tutorials/fleet.md). Empty: the one plant at
    `bus.endpoint`."""


class TlsConfig(Section, frozen=True):
    """Certificates."""

    keys: str | None = None
    """Folder of this process's certificate. `tandem keys create` makes one for each role."""


class BusConfig(Section, frozen=True):
    """The bus, Zenoh."""

    endpoint: str = "tcp/127.0.0.1:7447"
    """Address of the router. All other processes connect to it as clients. tls/HOST:PORT needs `tls.keys`
    (docs/tutorials/remote.md). `tandem run` picks a free port if the key is not given."""
    remote: str | None = None
    """Additional address of the router for other machines, such as tls/0.0.0.0:7448. Only the router uses it."""
    insecure: bool = False
    """true: do not warn of a tcp/ endpoint that other machines can reach. Any program that connects to such an endpoint
    can command the plant."""
    tls: TlsConfig = TlsConfig()
    """The certificate."""
    lease_ms: Milliseconds = 1500
    """A controller or plant that sends nothing for this time counts as disconnected. For all other processes the time
    is at least 10 s."""
    follow_silence: Seconds = 1.0
    """Silence after which another run of a process may take over its topics."""


class LogConfig(Section, frozen=True):
    """The log that the recorder writes."""

    path: str = "run.mcap"
    """The log's file."""
    chunk_bytes: Annotated[int, msgspec.Meta(ge=1, le=64 * 1024 * 1024), unit("bytes")] = 256 * 1024
    """Size of a chunk of the MCAP file, before compression."""
    flush_ms: Milliseconds = 500
    """Interval at which the recorder writes to disk: at most this much is lost when it is killed."""
    split_minutes: Annotated[float, msgspec.Meta(ge=0, le=1e6), unit("min")] = 60.0
    """Length of a file, after which the log continues in NAME.part2.mcap. The index of a file is in memory until the
    file ends. 0: never."""
    keep: Annotated[int, msgspec.Meta(ge=0, le=1_000_000), unit("files")] = 0
    """How many of a run's files stay, the one being written included. Older ones are removed. 0: all."""


class LiveConfig(Section, frozen=True):
    """The view in a browser (`tandem live`)."""

    port: Annotated[int, msgspec.Meta(ge=1, le=65535)] = 8765
    """Port on 127.0.0.1 of the page and of the Foxglove WebSocket."""


class RealtimeConfig(Section, frozen=True):
    """Scheduling of the processes, where it is permitted."""

    priority: Annotated[int, msgspec.Meta(ge=0, le=99)] = 50
    """SCHED_FIFO priority of router, controller and plant, where it is permitted. 0: none."""
    awake: literals.AwakeMode = "auto"
    """Keep the cores from sleeping between slots. "auto": with a priority and a period below 10 ms."""
    cores: Literal["auto", "any"] | list[Annotated[int, msgspec.Meta(ge=0, le=8191)]] = "auto"
    """Cores of the controller's loop and of the plant's, in this order. "auto": one core for each loop where `awake`
    would be needed and the process may use two. "any": the scheduler chooses."""


class Config(Section, frozen=True):
    """The whole configuration."""

    name: Name = "jet1"
    """The plant's name, part of every key on the bus."""
    rate: Annotated[float, msgspec.Meta(gt=0, le=1e5), unit("Hz")] = 20.0
    """Sampling rate of plant, model and controller."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0
    """Seed of everything random."""
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
    live: LiveConfig = LiveConfig()
    realtime: RealtimeConfig = RealtimeConfig()

    @property
    def period(self) -> float:
        """Seconds between samples."""
        return 1.0 / self.rate

    @property
    def awake(self) -> bool:
        """Whether `realtime.awake` keeps cores from sleeping at this rate."""
        mode = self.realtime.awake
        return mode == "always" or (mode == "auto" and self.fast)

    @property
    def fast(self) -> bool:
        """Whether the loops have a priority and a period so short that their cores matter."""
        return self.realtime.priority > 0 and self.period < AWAKE_BELOW
