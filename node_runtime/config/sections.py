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

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
# Upper limits are far above any useful value. A log contains its configuration, which then costs memory and time.
Count = Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]
"""A number of items, each of which takes memory or time."""
Milliseconds = Annotated[int, msgspec.Meta(ge=1, le=3_600_000)]
Seconds = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
LONGEST_PERIOD = 1e6
Variance = Annotated[float, msgspec.Meta(ge=1e-6, le=1e3)]
"""Limits keep the ratio of two variances small enough for a covariance to stay positive under rounding."""
LONGEST_HORIZON = 1000
DEAD_TIME = "dead_time"
"""Key in `plant.truth`, besides the parameters of the equations."""
MOST_DEAD_PERIODS = 50
"""Largest dead time of a simulated plant in periods, the same as for a controller in `lbmpc.model`."""
Unit = Annotated[float, msgspec.Meta(gt=0, lt=1)]
PLANT_NAME = r"^[A-Za-z0-9_-]{1,40}$"
"""Characters that may be part of a key on the bus."""
Name = Annotated[str, msgspec.Meta(pattern=PLANT_NAME)]


AWAKE_BELOW = 0.01
"""Seconds. Below this period, cores are kept awake. Waking a core takes up to a few tenths of a millisecond, which is
small compared with a longer period, and keeping it awake costs power all the time."""


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the configuration file."""


Bounds = Annotated[list[float | None], msgspec.Meta(min_length=2, max_length=2)]
"""Lower and upper bound; None for no bound. In TOML, no bound is written -inf or inf."""


Share = Annotated[float, msgspec.Meta(ge=0, le=1e3)]
Instant = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
"""Seconds since a start, at least 0."""
Shares = Share | dict[str, Share]
"""Shares of half-widths: one number for all states, or numbers by state name with 0 for the others."""


class SensorsConfig(Section, frozen=True):
    """Measurement errors of the simulated plant. By default a sample is the true state."""

    noise: Shares = 0.0
    """Standard deviation of the noise, in half-widths."""
    correlation: Instant = 0.0
    """Seconds after which the noise's correlation has dropped by a factor of e; 0 for white noise."""
    quantisation: Shares = 0.0
    """Step between two adjacent readings, in half-widths; 0 for no quantisation."""
    bias: dict[str, Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)]] = msgspec.field(default_factory=dict)
    """Offsets added to the measurements, in half-widths, by the state's name."""
    bias_at: Instant = 0.0
    """Seconds after the first sample at which `bias` begins."""
    stuck: dict[str, Instant] = msgspec.field(default_factory=dict)
    """Seconds after the first sample at which a sensor gets stuck at its present reading, by the state's name."""
    dead: dict[str, Instant] = msgspec.field(default_factory=dict)
    """Seconds after the first sample at which a sensor stops giving numbers, by the state's name."""
    dropouts: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0
    """Share of samples that are lost at random."""

    @property
    def random(self) -> bool:
        """Whether measurements depend on the seed."""
        return bool(self.noise or self.dropouts)


class PlantConfig(Section, frozen=True):
    """The plant: its model, changes of its properties, and the truth of a simulation."""

    model: str = "moore_greitzer"
    """A plant that comes with Tandem, or a reference to your own: "tanks.py:TANKS" or "mypackage:PLANT"."""
    x0: list[float] | None = None
    """Initial state of a simulation in the plant's units; None for the plant's own x0, which is the paper's."""
    x_e: list[float] | None = None
    """Equilibrium state in the plant's units, at which equations are linearised; None for the plant's own."""
    u_e: list[float] | None = None
    """Equilibrium input, in the plant's units; None for the plant's own, or for the one that holds `x_e`."""
    bounds: dict[str, Bounds] = msgspec.field(default_factory=dict)
    """Bounds of X and U in the plant's units, by the name of a state or input; the plant's own for all others."""
    dead_time: Annotated[float, msgspec.Meta(ge=0, le=1e6)] | None = None
    """Seconds between the gateway's write of an input and the plant's response; None for the plant's own. It is part
    of the model. `controller.input_delay_ms` is a different delay, which ends at the gateway."""
    input_rate_max: dict[str, Positive] = msgspec.field(default_factory=dict)
    """Rate limits of inputs, in their unit per second, by name; the plant's own for all others."""
    rows: dict[str, dict[str, float]] = msgspec.field(default_factory=dict)
    """Constraints in addition to the bounds, each with a name of its own: coefficients by the names of states or of
    inputs, in plant units, and `min`, `max` or both. A row of states can have a `priority`: the bounds have 0, and if
    constraints conflict, the one with the higher number is violated first. The plant's own rows stay unless they are
    named here."""
    truth: dict[str, float] | str = msgspec.field(default_factory=dict)
    """Parameters of the true plant that differ from the model's, by name, including `dead_time`; they make the model
    wrong. Alternatively a reference to another plant, or to an object with a method `step`, that is simulated
    instead."""
    plan_patience: Annotated[float, msgspec.Meta(gt=0, le=1e6)] = 1.25
    """Periods without a fresh command after which the plant applies the next entry of the last plan."""
    sensors: SensorsConfig = SensorsConfig()
    """Measurement errors of the simulated plant."""


class SolverConfig(Section, frozen=True):
    """The solver of the optimisation problem."""

    mode: literals.SolverMode = "converged"
    """"converged" solves to `tolerance` in every tick; "real_time" takes one prepared Gauss-Newton step per tick,
    which is faster and less exact."""
    compile: literals.CompileMode = "auto"
    """"auto" compiles the solver's functions once if there is a C compiler; "never" interprets them."""
    max_iterations: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 10
    """Largest number of Gauss-Newton steps per tick in the mode "converged"."""
    tolerance: Positive = 1e-6
    """The solver has converged when no input of the plan moves by more than this share of its half-width."""
    penalty: Positive = 100.0
    """Exact-penalty weight of soft state constraints: the cost of a violation of one half-width, in units of the cost
    to go x'Px with every state at its half-width."""


class BackupConfig(Section, frozen=True):
    """The backup policy, which the plant follows while no commands arrive."""

    enabled: bool = True
    """Whether backup policies are computed. They need a rate of up to 100 Hz and measurements of all states, because a
    faster loop has no time for them and they feed back all states. Otherwise the plant follows the plan."""
    margin: Annotated[float, msgspec.Meta(ge=0, lt=0.5)] = 0.0075
    """Amount by which X shrinks for the policy, as a share of its half-widths. It is reduced if it would prevent the
    return to the target."""


class ControllerConfig(Section, frozen=True):
    """The controller: problem, weights, oracle and timing."""

    horizon: Annotated[int, msgspec.Meta(ge=1, le=LONGEST_HORIZON)] = 60
    """N, the number of steps of the prediction."""
    horizon_seconds: Seconds | None = None
    """The horizon in seconds, as an alternative to `horizon`. It is converted when the configuration is read, and is
    None afterwards."""
    oracle: literals.OracleName = "dnn"
    """The estimate of the unknown h: "linear" (none, plain MPC), "constant" (one number per state), "l2nw" (kernel
    regression), "dnn" (the paper's network), or "perfect" (the true h, in simulations)."""
    tightening: literals.TighteningName = "first_step"
    """The tightening of the constraints: "none", "first_step" (by W at the first step), "tube" (by the disturbance
    tube), or "invariant" (certified sets)."""
    sets: str | None = None
    """File of certified sets for "invariant"; None for the sets that `tandem sets compute` stored in the cache."""
    W: list[NonNegative] | None = None
    """Half-widths of the disturbance box for the tightening, per second of the period; None for the plant's own."""
    Q: list[NonNegative] | None = None
    """Diagonal of the state weights, per second: a stage has Q / rate. None for ones."""
    R: list[Positive] | None = None
    """Diagonal of the input weights, per second: a stage has R / rate. None for ones."""
    S: list[NonNegative] | None = None
    """Diagonal of the weights on (du/dt)^2, per second: a stage has S rate |u_i - u_{i-1}|^2. None for zeros."""
    terminal: literals.TerminalName = "riccati"
    """P of the terminal cost: "riccati" for the LQR with the stage weights, "lyapunov" for the feedback K, or
    "published" for the reimplementation of Aswani et al.; see `lbmpc.terminal_cost`."""
    keyframe_every: Count = 100
    """Number of ticks between keyframes in the log. A replay can start at a keyframe."""
    late_fraction: Unit = 0.2
    """A tick counts as late if it starts later than this share of a period after its slot."""
    phase_ms: Annotated[float, msgspec.Meta(ge=0, le=3.6e6)] | None = None
    """Milliseconds between the due time of a plant sample and the controller's slot; None for 1 ms, limited to a
    quarter of a period."""
    input_delay_ms: Annotated[float, msgspec.Meta(ge=0, le=500.0 * LONGEST_PERIOD)] | None = None
    """Milliseconds from a sample until its command acts, used until the plant reports the delay. None for 0 in
    lock-step, and for the phase plus the usual computing time in a live run."""
    checkpoint: str = ""
    """File from which a restarted controller restores its memory; "" for none."""
    solver: SolverConfig = SolverConfig()
    """The solver."""
    backup: BackupConfig = BackupConfig()
    """The backup policy."""


class EstimatorConfig(Section, frozen=True):
    """The estimation of the state from measurements."""

    kind: literals.EstimatorName = "none"
    """"none" takes each sample as the state; "kalman" filters with the nominal model and a disturbance per state."""
    measured: list[str] | None = None
    """Names of the measured states; the numbers of other states in a sample are ignored. None for all states."""
    noise: Shares | Literal["innovations"] = 0.01
    """Standard deviation of the measurements, in half-widths; "innovations" estimates it from the first 100 samples."""
    process: Shares | None = None
    """Standard deviation of h, in half-widths per second of the period; None for `controller.W` or the plant's W."""
    correlation: Seconds | None = None
    """Seconds after which the correlation of h along the motion has dropped by a factor of e; None for the plant's time
    scale, that of its slowest mode under K."""


class ReferenceConfig(Section, frozen=True):
    """The reference: the equilibrium, or a rest of the plant according to the learned model."""

    outputs: list[str] | None = None
    """Names of the states that are to reach `values`. [] selects the rest of least cost; None selects the plant's
    equilibrium, even if the true plant does not rest there."""
    values: list[float] | None = None
    """Desired value of each output, in the plant's units; None for the values of the equilibrium."""


class NetworkConfig(Section, frozen=True):
    """The network of the oracle "dnn"."""

    architecture: str = "mlp"
    """The action of the hidden layers on the window: "mlp", "rnn", "cnn", or your own file such as "gru.py:GRU"."""
    window: Annotated[int, msgspec.Meta(ge=1, le=64)] | None = None
    """k, the number of pairs (x, u) in the window, including the present one; None for the architecture's own."""
    options: dict[str, int] = msgspec.field(default_factory=dict)
    """Options of the architecture that differ from its defaults."""
    hidden: Annotated[list[Width], msgspec.Meta(max_length=LAYERS)] = msgspec.field(
        default_factory=lambda: [64, 64]
    )
    """Number of neurons of each hidden layer, input side first."""
    activation: Activation = "tanh"
    """Activation of every hidden layer. It must be bounded, because the last layer's is."""
    output_scale: Positive = 0.4
    """Unit of the network's output: h in half-widths of each state per time scale of the plant. The time scale is that
    of the slowest mode under K (`lbmpc.model.Model.time_scale`), 1 s for the compressor."""
    max_layer_norm: Positive = 100.0
    """Largest Frobenius norm of a hidden layer that the controller accepts."""


class RefitConfig(Section, frozen=True):
    """The refit of K at an adoption, used if `adaptation.at_adoption` is "refit"."""

    window: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 200
    """Number of newest samples that the controller stores for the refit."""
    ridge: Positive = 1e-4
    """Weight of the previous K in the refit."""


class TrialConfig(Section, frozen=True):
    """The trial of new hidden weights, before their adoption and for some time after it."""

    enabled: bool = True
    """Whether hidden weights are tried."""
    seconds: Seconds | None = None
    """Seconds of the controller's own samples on which an offered set is tried; None for four time scales of the
    plant, as in `network.output_scale`."""
    samples: Annotated[int, msgspec.Meta(ge=10, le=1000)] = 80
    """Number of samples of the trial. A fast loop stores one every few ticks; a slow loop's samples reach back longer
    than `seconds`."""
    confirm: Seconds | None = None
    """Seconds after an adoption within which a set that predicts worse than its predecessor is rolled back; None for
    one time scale and at least 20 samples."""
    margin: NonNegative = 0.2
    """Share by which the mean squared error of a new set may exceed that of the old set."""
    floor: NonNegative = 0.003
    """RMS error, as a share of `network.output_scale`, below which an offered set is always accepted."""
    floor_after: NonNegative = 0.1
    """The same for an adopted set. It is larger, because K adapts to the new layers only after the adoption."""


class KalmanConfig(Section, frozen=True):
    """The filter of the last layer for the law "kalman", and of the constant beside the network with an estimator.
    Variances are in units of (output scale)^2."""

    prior_variance: Variance = 0.02
    """Variance of each entry of K before the first sample."""
    label_variance: Variance = 1e-3
    """Variance of each entry of a label: measurement noise and the error of the features."""
    memory: Seconds | None = None
    """Seconds after which past information has decayed by a factor of e; None for two time scales of the plant, ten
    with an estimator, and at least 20 samples."""


class AdaptationConfig(Section, frozen=True):
    """The adaptation of the network's last layer at every sample."""

    enabled: bool = True
    """False keeps the last layer at K_0, so that only hidden layers are trained."""
    law: literals.LawName | None = None
    """The adaptation law: "gradient" is the paper's projected gradient, "kalman" a projected Kalman filter. None
    selects "kalman" with an estimator, which provides the variance of labels, and "gradient" otherwise."""
    gamma: Unit = 0.8
    """Learning rate of the gradient law, 0 < gamma < 1."""
    column_bound: Positive = 2.0
    """Bound on the norm of each column of K, as h in half-widths of its state per time scale of the plant."""
    initial_scale: NonNegative = 1.2e-2
    """Standard deviation of the entries of K_0, in the same unit."""
    start: literals.StartName = "random"
    """K_0: "random", "zero", or "pretrained", which is random and then fitted to h = 0 over X x U."""
    at_adoption: literals.AdoptionName = "keep"
    """K at an adoption of hidden layers: "keep" as in the paper, or "refit" to the newest samples."""
    kalman: KalmanConfig = KalmanConfig()
    """The Kalman filter of the last layer."""
    refit: RefitConfig = RefitConfig()
    """The refit of K."""
    trial: TrialConfig = TrialConfig()
    """The trial of hidden weights."""


class ConstantConfig(Section, frozen=True):
    """The oracle "constant"."""

    gain: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.5
    """Share of a new label in the filtered label; with 1 the last label alone is used."""


class L2nwConfig(Section, frozen=True):
    """The oracle "l2nw", the kernel regression of Aswani et al. (2013)."""

    window: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 100
    """Number of newest samples that are used."""
    bandwidth: Positive = 1.0
    """Bandwidth of the Gaussian kernel, in half-widths of each of its variables."""
    regularisation: Positive = 1e-3
    """lambda, which draws the estimate towards zero far from samples."""
    variables: list[str] | None = None
    """Names of the states and inputs in the kernel; None for the plant's own choice."""


class PlantPlace(Section, frozen=True):
    """A plant with a router of its own, for a trainer of several plants."""

    name: Name
    """Name of the plant, as in its own configuration."""
    endpoint: str
    """Endpoint of its router, such as tls/10.0.0.5:7448."""
    keys: str | None = None
    """Folder of the trainer's certificate for this plant; None for `bus.tls.keys`."""


class TrainerConfig(Section, frozen=True):
    """The trainer of the hidden layers."""

    enabled: bool = True
    """False never trains the hidden layers, so that only the last layer adapts."""
    capacity: Count = 2000
    """p_max, the capacity of the replay buffer in samples."""
    strategy: literals.Strategy = "fifo"
    """Replacement in a full buffer: "fifo" drops the oldest sample, "reservoir" keeps a uniform random selection, and
    "novelty" prefers samples that differ from the stored ones."""
    train_every: Count = 10
    """Number of new samples between two trainings."""
    min_samples: Count = 20
    """Number of samples before the first training."""
    batch: Count = 512
    """M, the number of samples drawn at random from the buffer for one training."""
    steps: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 300
    """Number of Adam steps in one training, each on all M samples."""
    learning_rate: Positive = 1e-3
    """Learning rate of Adam."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the training; "auto" uses a GPU if there is one."""
    fleet: list[PlantPlace] = msgspec.field(default_factory=list)
    """Plants with routers of their own that one `tandem trainer` trains (docs/fleet.md); empty for the plants at
    `bus.endpoint`."""


class TlsConfig(Section, frozen=True):
    """The certificate of this process."""

    keys: str | None = None
    """Folder of this process's certificate, as created by `tandem keys create` for each role."""


class BusConfig(Section, frozen=True):
    """The message bus."""

    endpoint: str = "tcp/127.0.0.1:7447"
    """Address at which the router listens and to which the processes connect. tls/HOST:PORT needs `tls.keys`
    (docs/remote.md)."""
    remote: str | None = None
    """Additional address of the router for other machines, such as tls/0.0.0.0:7448. Only the router uses it."""
    insecure: bool = False
    """True suppresses the warning about a tcp/ endpoint that other machines can reach, and so command the plant."""
    tls: TlsConfig = TlsConfig()
    """The certificate."""
    lease_ms: Milliseconds = 1500
    """Milliseconds of silence after which a link of controller or plant counts as cut; at least 10 s for others."""
    follow_silence: Seconds = 1.0
    """Seconds of silence after which another process incarnation may take over a topic."""


class LogConfig(Section, frozen=True):
    """The recorder's log."""

    path: str = "run.mcap"
    """File of the log."""
    chunk_bytes: Annotated[int, msgspec.Meta(ge=1, le=64 * 1024 * 1024)] = 256 * 1024
    """Size of an MCAP chunk in bytes."""
    flush_ms: Milliseconds = 500
    """Milliseconds after which buffered messages are written to the file."""
    split_minutes: Annotated[float, msgspec.Meta(ge=0, le=1e6)] = 60.0
    """Minutes after which a new file, NAME.part2.mcap, begins; 0 for a single file. A file's index is in memory until
    the file ends."""
    keep: Annotated[int, msgspec.Meta(ge=0, le=1_000_000)] = 0
    """Number of files of a run that are kept, including the present one; older files are removed. 0 keeps all."""


class RealtimeConfig(Section, frozen=True):
    """Real-time scheduling."""

    priority: Annotated[int, msgspec.Meta(ge=0, le=99)] = 50
    """SCHED_FIFO priority of router, controller and plant; 0 keeps ordinary scheduling."""
    awake: literals.AwakeMode = "auto"
    """Whether cores are kept from sleeping between slots; "auto" does so with a priority and a period below 10 ms."""
    cores: Literal["auto", "any"] | list[Annotated[int, msgspec.Meta(ge=0, le=8191)]] = "auto"
    """[core of the controller's loop, core of the plant's loop]; "auto" chooses two cores in the cases in which `awake`
    applies; "any" leaves the choice to the scheduler."""


class Config(Section, frozen=True):
    """The whole configuration."""

    name: Name = "jet1"
    """Name of the plant, which is part of every key on the bus."""
    rate: Annotated[float, msgspec.Meta(gt=0, le=1e5)] = 20.0
    """Sampling rate of plant, model and controller, in Hz."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0
    """Seed of the random numbers: initial weights, training, and measurement noise."""
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
        """Whether `realtime.awake` keeps cores from sleeping at this rate."""
        mode = self.realtime.awake
        return mode == "always" or (mode == "auto" and self.fast)

    @property
    def fast(self) -> bool:
        """Whether the loops have a priority and a period so short that their cores matter."""
        return self.realtime.priority > 0 and self.period < AWAKE_BELOW
