"""Builds the objects of `lbmpc` from a configuration."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from lbmpc.controller.backup_policy import BackupPlanner
from lbmpc.controller.step import Controller
from lbmpc.estimator.base import Estimator
from lbmpc.estimator.kalman import KalmanEstimator, unobservable
from lbmpc.estimator.supervision import SupervisedEstimator
from lbmpc.model import Model, ModelError, require_horizon
from lbmpc.model import build_model as nominal_model
from lbmpc.oracles import ConstantOracle, DnnOracle, L2nwOracle, LinearOracle, Oracle, PerfectOracle
from lbmpc.oracles.base import Realise
from lbmpc.oracles.dnn.adoption import Refit
from lbmpc.oracles.dnn.kalman_law import Kalman
from lbmpc.oracles.dnn.trial import Trial
from lbmpc.plants import Description, Known, Plant, PlantError, TrueMotion, get_plant, get_truth
from lbmpc.problem import Problem, build_problem
from lbmpc.references import Reference
from lbmpc.sets.certificate import Certificate, CertificateError
from lbmpc.sets.geometry.polytope import EmptySetError
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Solution
from lbmpc.targets import TargetSelector
from network_model.description import NetworkDescription
from network_model.registry import get_architecture, name_of
from node_runtime.config.plant import in_half_widths, plant_of, true_plant_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from protocol.topics import WEIGHTS_LIMIT

WEIGHTS = WEIGHTS_LIMIT // 4
"""Largest number of hidden weights, float32 each."""
FILTERED = 512
"""Largest number of features with a filter in the last layer, whose covariance is in every state and keyframe."""
COARSE = 0.05
"""Share of a time scale. It limits the scale of K_0 for long periods, because K_0 is random and must not dominate."""
MEMORY, NOISY_MEMORY, REACH, WATCH = 2.0, 10.0, 4.0, 1.0
"""Time scales of the plant: memory of the last layer's filter for exact and for noisy labels, time covered by the
samples of a trial, and time for which adopted weights are observed."""
FEWEST = 20
"""Smallest number of samples in a memory or an observation, because a slow loop has few samples in a time scale."""
SHORTEST_WATCH = 8
"""Smallest number of samples of an observation for any configuration."""


@dataclass(frozen=True)
class GivenPlant:
    """A plant that replaces the configured one, for example from a log, which loads no files."""

    known: Known | Plant
    """The plant as the controller knew it."""
    equations: Plant | None = None
    """The equations that `known` was linearised from, if the reader of the log has them."""
    truth: Known | Plant | TrueMotion | None = None
    """The true motion, if the reader of the log has it."""


def build_plant(config: Config) -> Known | Plant:
    """Return the configured plant as the model knows it, with checked lengths. Raises `ConfigError`."""
    return plant_of(config, get_plant)


def describe_network(config: Config, model: Model) -> NetworkDescription:
    """Return the configured network for this model. Inputs and h are scaled by the half-widths.

    Raises:
        ValueError: sizes or options do not fit the architecture, the architecture is unknown, or the network is too
            large for a message.
    """
    network, plant = config.network, model.plant
    name = name_of(network.architecture)
    architecture = get_architecture(name)
    description = NetworkDescription(
        states=plant.d,
        inputs=plant.m,
        hidden=network.hidden,
        activations=[network.activation] * len(network.hidden),
        input_scale=[*plant.x_scale.tolist(), *plant.u_scale.tolist()],
        output_scale=(network.output_scale * model.period / model.time_scale * plant.x_scale).tolist(),
        max_layer_norm=network.max_layer_norm,
        architecture=name,
        window=architecture.window if network.window is None else network.window,
        options={**architecture.options, **network.options},
    )
    weights = sum(rows * columns for rows, columns in description.layer_shapes)
    if weights > WEIGHTS:
        raise ValueError(f"{weights} hidden weights; at most {WEIGHTS} fit into one message")
    return description


def build_oracle(config: Config, model: Model, given: GivenPlant | None = None) -> Oracle:
    """Return the configured oracle. Raises `ConfigError`."""
    plant = model.plant
    if config.controller.oracle == "linear":
        return LinearOracle(plant.d, plant.m)
    if config.controller.oracle == "constant":
        return ConstantOracle(plant.d, plant.m, config.constant.gain)
    if config.controller.oracle == "perfect":
        truth = true_plant_of(config, get_plant, get_truth) if given is None else given.truth
        if not isinstance(truth, Plant):
            raise ConfigError(
                "controller.oracle = 'perfect': it needs the equations of the true plant, but there are none"
            )
        try:
            return PerfectOracle(model, truth)
        except PlantError as error:
            raise ConfigError(f"controller.oracle = 'perfect': {error}") from error
    if config.controller.oracle == "l2nw":
        names = (*plant.states, *plant.inputs)
        chosen = config.l2nw.variables if config.l2nw.variables is not None else list(plant.kernel)
        if not chosen:
            raise ConfigError(f"l2nw.variables: empty; choose from {', '.join(names)}")
        indices = tuple(names.index(name) for name in chosen)
        settings = config.l2nw
        bandwidth = settings.bandwidth * np.concatenate([plant.x_scale, plant.u_scale])[list(indices)]
        return L2nwOracle(plant.d, plant.m, indices, settings.window, bandwidth, settings.regularisation)
    return build_network_oracle(config, model)


def build_network_oracle(config: Config, model: Model) -> DnnOracle:
    """Return the network oracle of the configuration, whatever oracle is configured. Raises `ConfigError`."""
    try:
        description = describe_network(config, model)
    except ValueError as error:
        raise ConfigError(f"network: {error}") from error
    adaptation, share = config.adaptation, model.period / model.time_scale
    again = Refit(adaptation.refit.window, adaptation.refit.ridge)
    chosen, noisy = describe_filter(config, model.time_scale), config.estimator.kind != "none"
    filtered = adaptation.enabled and (adaptation.law == "kalman" or (adaptation.law is None and noisy))
    if filtered and description.features > FILTERED:
        raise ConfigError(
            f"the filter of the last layer keeps a covariance of {description.features} x {description.features} "
            f"numbers: use at most {FILTERED - 1} neurons in the last layer of network.hidden, or set "
            f'adaptation.law = "gradient"'
        )
    return DnnOracle(
        description,
        adaptation.gamma if adaptation.enabled else 0.0,
        adaptation.column_bound * (share * model.plant.x_scale),
        adaptation.initial_scale * (min(share, COARSE) * model.plant.x_scale),
        adaptation.start,
        again if adaptation.at_adoption == "refit" else None,
        describe_trial(config, model.time_scale),
        chosen if filtered else None,
        chosen if noisy else None,
    )


def describe_filter(config: Config, time_scale: float) -> Kalman:
    """Return the filter of the last layer, and of the constant beside it, at the configured rate.

    time_scale: the plant's, in seconds.
    """
    settings = config.adaptation.kalman
    scales = MEMORY if config.estimator.kind == "none" else NOISY_MEMORY
    memory = settings.memory
    if memory is None:
        memory = max(scales * time_scale, FEWEST * config.period)
    return Kalman(settings.prior_variance, settings.label_variance, math.exp(-config.period / memory))


def describe_trial(config: Config, time_scale: float) -> Trial | None:
    """Return the trial of hidden weights at the configured rate, for a plant with this time scale in seconds.

    The result is None if trials are disabled.
    """
    settings = config.adaptation.trial
    if not settings.enabled:
        return None
    least = FEWEST * config.period
    reach = REACH * time_scale if settings.seconds is None else settings.seconds
    confirm = max(WATCH * time_scale, least) if settings.confirm is None else settings.confirm
    return Trial(
        capacity=settings.samples,
        stride=max(1, round(reach * config.rate / settings.samples)),
        window=max(SHORTEST_WATCH, math.ceil(confirm * config.rate - 1e-9)),
        margin=settings.margin,
        floor=settings.floor,
        floor_after=settings.floor_after,
    )


def build_model(config: Config, given: GivenPlant | None = None) -> Model:
    """Return the nominal model of the configured plant. Raises `ConfigError`, also for a horizon that is too long."""
    settings = config.controller
    Q = None if settings.Q is None else np.array(settings.Q, dtype=float)
    R = None if settings.R is None else np.array(settings.R, dtype=float)
    S = None if settings.S is None else np.array(settings.S, dtype=float)
    try:
        plant = build_plant(config) if given is None else given.known
        model = nominal_model(plant, config.period, Q, R, settings.terminal, S)
        require_horizon(model, settings.horizon)
        if given is None or given.equations is None:
            return model
        return replace(model, equations=given.equations)
    except ModelError as error:
        raise ConfigError(f"controller: {error}") from error


def given_disturbance(config: Config) -> np.ndarray | None:
    """Return the configured half-widths of W, (d,), as bounds of h over one period; None if there are none."""
    W = config.controller.W
    return None if W is None else np.array(W, dtype=float) * config.period


class TimedSolver(Solver):
    """A solver that measures its last solve. The time is only logged and never influences a decision."""

    seconds = 0.0

    def solve(self, *args: Any, **options: Any) -> Solution:
        before = time.perf_counter()
        solution = super().solve(*args, **options)
        self.seconds = time.perf_counter() - before
        return solution

    def feedback(self, *args: Any, **options: Any) -> Solution:
        before = time.perf_counter()
        solution = super().feedback(*args, **options)
        self.seconds = time.perf_counter() - before
        return solution


def build_controller(
    config: Config,
    model: Model,
    realise: Realise | None = None,
    certificate: Certificate | None = None,
    given: GivenPlant | None = None,
) -> tuple[Controller, TimedSolver]:
    """Return a controller and its solver.

    Args:
        config: the resolved configuration.
        model: the nominal model of that configuration.
        realise: may compile the solver's functions.
        certificate: the sets of the tightening `invariant`.
        given: as for `build_model`.

    Raises:
        ConfigError: the configuration allows no controller, or the sets belong to another model.
    """
    settings, realise = config.controller, realise or _as_it_is
    try:
        problem = build_problem(
            model,
            build_oracle(config, model, given),
            settings.horizon,
            settings.tightening,
            given_disturbance(config),
            settings.solver.penalty,
            certificate,
        )
    except (CertificateError, EmptySetError) as error:
        raise ConfigError(f"controller: {error}") from error
    chosen = settings.solver
    solver = TimedSolver(problem, chosen.max_iterations, chosen.tolerance, realise)
    problem.oracle.compile(realise)
    seconds = 1e-3 * (settings.input_delay_ms or 0.0)
    try:
        controller = Controller(
            problem,
            solver,
            real_time=chosen.mode == "real_time",
            input_delay=seconds,
            targets=TargetSelector(problem, realise),
            reference=configured_reference(config, model.plant),
            estimator=build_estimator(config, model),
        )
    except ModelError as error:
        raise ConfigError(f"controller: {error}") from error
    _warm_up(controller, solver, config.seed)
    return controller, solver


def build_estimator(config: Config, model: Model) -> Estimator | None:
    """Return the configured estimator; None if a sample is the state.

    Raises:
        ConfigError: the measurements do not determine a state.
    """
    settings, plant = config.estimator, model.plant
    if settings.kind == "none":
        return None
    names = plant.states if settings.measured is None else settings.measured
    measured = np.array(sorted({plant.states.index(name) for name in names}))
    if unseen := unobservable(model, measured):
        raise ConfigError(
            f"estimator.measured = {', '.join(names)}: these measurements do not determine "
            f"{', '.join(plant.states[i] for i in unseen)}; measure them too"
        )
    given = given_disturbance(config)
    process = plant.W * config.period if given is None else given
    if settings.process is not None:
        process = in_half_widths(settings.process, plant) * plant.x_scale * config.period
    told = settings.noise
    noise = None if told == "innovations" else in_half_widths(told, plant) * plant.x_scale
    correlation = model.time_scale if settings.correlation is None else settings.correlation
    kalman = KalmanEstimator(model, measured, noise, process, correlation)
    return SupervisedEstimator(kalman, model, measured)


def configured_reference(config: Config, plant: Description) -> Reference | None:
    """Return the configured reference; None without one, when plans lead to (x_e, u_e)."""
    outputs = config.reference.outputs
    if outputs is None:
        return None
    indices = [plant.states.index(name) for name in outputs]
    at_equilibrium = plant.x_e[indices]
    values = at_equilibrium if config.reference.values is None else np.array(config.reference.values)
    return Reference((*indices,), np.zeros(1), (values - at_equilibrium)[None, :])


def build_backup(config: Config, problem: Problem, realise: Realise | None = None) -> BackupPlanner:
    """Return the planner of backup policies; arguments as for `build_controller`."""
    return BackupPlanner(problem, config.controller.backup.margin, realise or _as_it_is)


def _warm_up(controller: Controller, solver: TimedSolver, seed: int) -> None:
    """Run everything once that is slow at the first call. It changes no result."""
    state = controller.initial_state(seed)
    d, m = controller.model.d, controller.model.m
    controller.oracle.learn(state.oracle, np.zeros(d), np.zeros(m), np.zeros(d))
    controller.oracle.estimate(state.oracle, np.zeros(d), np.zeros(m))
    x = np.zeros_like(state.predicted)
    theta = controller.oracle.theta(state.oracle)
    # This state is far enough out to need the QP too.
    edge = x.copy()
    edge[:d] = 0.5 * (controller.model.plant.x0 - controller.model.plant.x_e)
    for start in (x, edge):
        solver.solve(start, theta, state.plan.c)
        if controller.real_time:
            solver.prepare(start, theta, state.plan.c)
            solver.feedback(start)


def _as_it_is(function: ca.Function) -> ca.Function:
    return function
