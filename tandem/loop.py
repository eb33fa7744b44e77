"""The closed loop in Python: the controller, its trainer and a plant, possibly your own, one step at a time.

The same lock-step as `tandem simulate`: equal settings and seeds give equal bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from controller_node.asked import change_of
from controller_node.build import GivenPlant, build_plant
from lbmpc.plants import (
    PLANTS,
    Description,
    Known,
    Plant,
    PlantDefinitionError,
    PlantError,
    TrueMotion,
    get_plant,
    get_truth,
)
from node_runtime.config import strict
from node_runtime.config.loading import from_tree, to_tree
from node_runtime.config.plant import plant_of, true_plant_of
from node_runtime.config.sections import Config, Section
from node_runtime.config.shipped import config_file
from node_runtime.config.strict import ConfigError
from node_runtime.realtime.scheduling import one_blas_thread
from protocol.messages import Reference, TickResult
from run_log.reporting.summary import Summary, summarise
from run_log.reporting.traces import Traces, traces
from run_log.run import Run
from tandem.experiments.simulation.lockstep import LockStep
from tandem.operating import set_points

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Step(NamedTuple):
    """One period."""

    t: float
    """Seconds since the beginning."""
    x: np.ndarray
    """The plant's state at that time, (d,), in its own units."""
    u: np.ndarray
    """The input from then on, (m,)."""
    result: TickResult
    """The controller's result: status, iterations, h and h_hat, verdict on hidden weights, and more."""


class Loop:
    """A controller with its trainer and its plant, in this process.

    Args:
        known: what the controller knows: `Known` (matrices), `Plant` (equations, which are linearised), the name of a
            plant of Tandem, or a reference, "tanks.py:TANKS". None: the configuration's.
        truth: how the plant moves: a `Plant`, an object with `step(x, u, dt) -> x` (your simulator), a reference to
            either, or other parameters of the same equations, {"leak": 0.02}. None: the configuration's, or equal to
            `known`.
        oracle: the estimate of h: linear (none), constant, l2nw, dnn or perfect.
        train: whether the hidden layers of dnn are trained; needs torch.
        config: a configuration: its file, the name of a shipped one, or a `Config`. None: defaults.
        settings: changes of the configuration, as in the file: `rate=50, controller={"horizon": 40}`.

    Raises:
        ConfigError: the arguments do not give a controller; the message gives the reason and a remedy.
    """

    def __init__(
        self,
        known: str | Known | Plant | None = None,
        *,
        truth: str | Mapping[str, float] | Known | Plant | TrueMotion | None = None,
        oracle: str | None = None,
        train: bool | None = None,
        config: str | Path | Config | None = None,
        **settings: Any,
    ):
        moving = None if isinstance(truth, str | Mapping) else truth
        arguments = {
            "known": ("plant.model", _name_of(known)),
            "truth": (
                "plant.truth",
                dict(truth) if isinstance(truth, Mapping) else _name_of(truth, moves=True),
            ),
            "oracle": ("controller.oracle", oracle),
            "train": ("trainer.enabled", train),
        }
        self.config = _resolved(config, settings, arguments)
        given = _given(self.config, known, moving)
        with one_blas_thread():
            self._lockstep = LockStep(self.config, given=given)
        self._lost: str | None = None

    @property
    def plant(self) -> Description:
        """What the controller knows: names, units, bounds, equilibrium."""
        return self._lockstep.core.plant

    def step(self) -> Step:
        """Run one period; return the plant's state, and the controller's input to it.

        Raises:
            PlantError: the true plant left every state from which its motion can be followed.
        """
        return self._step(None)

    def control(self, x: ArrayLike) -> np.ndarray:
        """Return the input, (m,), for an external plant: in your simulator, or your own loop.

        One call is one period. The input acts from now until the next call, and the label h of this
        period is computed from it.

        Args:
            x: its state now, (d,), in its own units.

        Raises:
            ValueError: not d finite numbers; nothing has changed then.
        """
        state, d = np.array(x, dtype=float), self.plant.d
        if state.shape != (d,) or not np.isfinite(state).all():
            raise ValueError(
                f"x = {np.array2string(state, threshold=20)} is not a state of {self.plant.name}: give {d} "
                f"finite numbers ({', '.join(self.plant.states)})"
            )
        return self._step(state).u

    def manual(self, u: ArrayLike | Mapping[str, float]) -> None:
        """Let this input act manually from the next step on, until `auto`; the controller continues to learn.

        It is clipped to U. If the plant would leave X, its controller takes over before that and stays in control.

        Args:
            u: (m,), in the plant's own units; or some of the inputs, by name; the others stay unchanged.

        Raises:
            ValueError: not m finite numbers, or no input of that name.
        """
        plant = self.plant
        if isinstance(u, Mapping):
            given = self._lockstep.acting.copy()
            for name, value in u.items():
                if name not in plant.inputs:
                    raise ValueError(f"{plant.name} has no input {name!r}; it has {', '.join(plant.inputs)}")
                given[plant.inputs.index(name)] = value
        else:
            given = np.array(u, dtype=float)
        if given.shape != (plant.m,) or not np.isfinite(given).all():
            raise ValueError(
                f"u = {np.array2string(given, threshold=20)} is not an input of {plant.name}: give {plant.m} "
                f"finite numbers ({', '.join(plant.inputs)})"
            )
        self._lockstep.manual(given)

    def auto(self) -> None:
        """Let the controller's commands act again from the next step on."""
        self._lockstep.auto()

    @property
    def by_hand(self) -> bool:
        """Whether the input acts manually, now or from the next step on."""
        return self._lockstep.plant.hand.acts

    def set_point(self, values: Mapping[str, float], over: float = 0.0, lease: float | None = None) -> None:
        """Give set-points of outputs from the next period on: {"y": 1.8}.

        Args:
            values: by the name of a state, plant units.
            over: seconds of a straight line to the values; 0: at once.
            lease: seconds after which the configured reference returns; None: never.

        Raises:
            ValueError: no such state, or a value outside X; nothing has changed then.
        """
        self.reference(set_points.set_point(values, over, lease))

    def reference(self, reference: Reference | None) -> None:
        """Give a reference from the next period on; None: the configured one.

        Args:
            reference: for instance of `tandem.operating.set_points.trajectory`, or `from_file`.

        Raises:
            ValueError: the reference does not fit this plant; nothing has changed then.
        """
        asked = reference or Reference(run_id=set_points.UNSAID, seq=0, kind="configured")
        change_of(asked, self.plant, self.config.period)
        self._lockstep.ask(asked)

    def start_again(self) -> None:
        """Begin another episode: the plant is put back, the memory is kept, and no label spans both episodes.

        With `control` the next x is its first state.
        """
        with one_blas_thread():
            try:
                self._lockstep.start_again()
            except PlantError:
                self._lockstep.start_again(lost=True)
        self._lost = None

    def run(self, steps: int) -> Result:
        """Run `steps` more periods, or fewer if the plant is lost; return the result of all periods so far."""
        if steps < 1:
            raise ValueError(f"steps = {steps}: must be at least 1")
        with one_blas_thread():
            try:
                for _ in range(steps):
                    self._lockstep.step()
            except PlantError as error:
                self._lose(error)
        return self.result

    @property
    def result(self) -> Result:
        """All steps so far."""
        if self._lost is None:
            try:
                return Result(self._lockstep.so_far())
            except PlantError as error:
                self._lose(error)
        return Result(self._lockstep.so_far(lost=True), self._lost)

    def _lose(self, error: PlantError) -> None:
        self._lost = f"at step {self._lockstep.taken}: {error}"

    def _step(self, x: np.ndarray | None) -> Step:
        with one_blas_thread():
            state, outputs = self._lockstep.step(x)
        self._lost = None
        return Step(state.t, np.array(state.x), self._lockstep.acting, outputs.result)


class Result:
    """Result of the steps of a loop. n steps, d states, m inputs; NaN where a step has no such figure."""

    def __init__(self, run: Run, lost: str | None = None):
        self.run = run
        """Every message, as a log has it."""
        self.lost = lost
        """Why the true motion ended; None: it did not."""

    @cached_property
    def traces(self) -> Traces:
        """The arrays below, and the data of the pictures."""
        return traces(self.run)

    @property
    def t(self) -> np.ndarray:
        """(n,) seconds, of the steps."""
        return self.traces.t

    @property
    def x(self) -> np.ndarray:
        """(n + 1, d) the plant's states, the last one after the last step; (n, d) for an external plant."""
        return self.traces.motion.x

    @property
    def u(self) -> np.ndarray:
        """(n, m) the inputs."""
        return self.traces.u

    @property
    def h(self) -> np.ndarray:
        """(n, d) x - A x_before - B u_before: the model's error in the period before each step."""
        return self.traces.h

    @property
    def h_hat(self) -> np.ndarray:
        """(n, d) the oracle's estimate of it."""
        return self.traces.h_hat

    @property
    def solve_ms(self) -> np.ndarray:
        """(n,) duration of each solve in milliseconds."""
        return self.traces.solve_ms

    @cached_property
    def summary(self) -> Summary:
        """Cost, overshoot, constraint violations and more, as `tandem simulate` prints them."""
        return summarise(self.run)

    def plot(self) -> Figure:
        """Plot all of it on one page. Needs matplotlib."""
        from run_log.reporting import plots
        from run_log.reporting.report import title

        return plots.overview(self.traces, title(self.run))

    def save(self, path: str | Path) -> Path:
        """Write the log, for `tandem replay` and `tandem report`. Needs mcap.

        Raises:
            LogError: the file exists already, or it cannot be written.
        """
        from run_log.writing.save import save

        save(self.run, path)
        return Path(path)


def _resolved(
    config: str | Path | Config | None,
    settings: Mapping[str, Any],
    arguments: Mapping[str, tuple[str, Any]],
) -> Config:
    """Return the configuration with the settings and with the arguments that are not None, (key, value) by name."""
    folder, where = None, "Loop"
    names = (*arguments, "config", *Config.__struct_fields__)
    for name in settings:
        if name not in names:
            known = f"known: {', '.join(names)}"
            raise ConfigError(f"Loop: unknown argument {name!r}; {strict.did_you_mean(name, names, known)}")
    if isinstance(config, Config):
        tree = to_tree(config)
    elif config is None:
        tree = {}
    else:
        file = config_file(config)
        tree, folder, where = strict.load_tree(file), file.parent, str(config)
    origins: dict[str, str] = {}
    _merge(tree, settings, Config(), "", origins)
    for name, (key, value) in arguments.items():
        if value is not None:
            table, last = key.split(".")
            _merge(tree, {table: {last: value}}, Config(), "", {})
            origins[key] = f"Loop({name}=)"
    return from_tree(tree, where, origins, folder)


def _name_of(given: object, moves: bool = False) -> object:
    """Name of a plant in a configuration; for an object, a name that no plant of Tandem has.

    A truth that is an object has such a name too: without it a log would say that the plant moved as known.
    """
    if given is None or isinstance(given, str):
        return given
    name = given.name if isinstance(given, Description) else type(given).__name__
    if PLANTS.get(name) is given or not (moves or name in PLANTS):
        return name
    return f"Loop:{name}"


def _merge(
    tree: dict[str, Any], changes: Mapping[str, Any], section: Section, above: str, origins: dict[str, str]
) -> None:
    """Merge `changes` into the tree of `section`. A table that is no section replaces the old one."""
    for name, value in changes.items():
        key = f"{above}{name}"
        inner = getattr(section, name, None)
        if isinstance(value, Mapping) and isinstance(inner, Section):
            below = tree.setdefault(name, {})
            if not isinstance(below, dict):
                raise ConfigError(f"{key} is a value, not a table")
            _merge(below, value, inner, f"{key}.", origins)
        else:
            tree[name] = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
            origins[key] = "Loop"


def _given(config: Config, known: object, truth: Known | Plant | TrueMotion | None) -> GivenPlant | None:
    """Return the objects that replace names of the configuration. Raises `ConfigError`."""
    if not isinstance(known, Known | Plant) and truth is None:
        return None
    own = known if isinstance(known, Known | Plant) else None
    model = build_plant(config) if own is None else plant_of(config, get_plant, own)
    if truth is None:
        return GivenPlant(model, truth=true_plant_of(config, get_plant, get_truth, own))
    if isinstance(truth, Description):
        try:
            get_truth(truth)
        except PlantDefinitionError as error:
            raise ConfigError(f"truth: {error}") from error
        if (truth.states, truth.inputs) != (model.states, model.inputs):
            raise ConfigError(
                f"truth: its states and inputs are {', '.join((*truth.states, *truth.inputs))}, and those of known "
                f"{', '.join((*model.states, *model.inputs))}; the same names in the same order are needed"
            )
    elif not callable(getattr(truth, "step", None)):
        raise ConfigError(
            f"truth: {type(truth).__name__} is neither a plant nor an object with step(x, u, dt) that returns the "
            "state dt seconds later"
        )
    return GivenPlant(model, truth=truth)
