"""`tandem model check`: the content of a plant file, its properties for control, and all of its faults."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import FROM_CONFIG, Configured

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from lbmpc.analysis import SampledDisturbance
    from lbmpc.model import Model
    from lbmpc.plants import Known, Plant
    from node_runtime.config.sections import Config
    from tandem.commands.model.findings import Finding

SAMPLES = 500
ROUNDING = 1e-9
"""Half-widths."""
MARKS = {"ok": ("ok", "green"), "note": ("look", "yellow"), "fault": ("wrong", "bold red")}


@dataclass(frozen=True, kw_only=True)
class ModelCheck(Configured):
    """Check a plant: A and B, poles, reach of the inputs, horizon, W, safe input; and list all faults."""

    KEYS = (("plant", "plant.model"), ("rate", "rate"))

    plant: Annotated[Positional[str | None], arg(metavar="FILE:NAME", help_behavior_hint=FROM_CONFIG)] = None
    """A plant file and the name in it, which may be left out if the file has one plant; or a shipped plant."""
    rate: Annotated[float | None, arg(metavar="HZ", help_behavior_hint=FROM_CONFIG)] = None
    """Samples a second."""
    prove: bool = False
    """Also bound h over X and U rigorously, if there are equations; that may take a minute."""

    def run(self) -> int:
        """Return 0, or 2 if there is a fault."""
        import numpy as np

        from controller_node.build import build_estimator
        from lbmpc.model import ModelError, build_model
        from lbmpc.plants import Known, PlantDefinitionError, get_plant
        from node_runtime.config.plant import plant_of
        from node_runtime.config.strict import ConfigError

        config, tree = self.resolve()
        try:
            plant = plant_of(config, get_plant)
        except ConfigError as error:
            # A plant file may refuse its own plant while it is read.
            cause = error.__cause__
            while cause is not None and not isinstance(cause, PlantDefinitionError):
                cause = cause.__cause__
            if cause is None:
                raise
            return self._refuse(config, str(cause.args[0]))
        if isinstance(plant, Known) and plant.period is not None and "rate" not in tree:
            config, _ = replace(self, rate=1.0 / plant.period).resolve()
        settings = config.controller
        try:
            Q, R = (None if weights is None else np.array(weights) for weights in (settings.Q, settings.R))
            model = build_model(plant, config.period, Q, R, settings.terminal)
            build_estimator(config, model)
        except (ModelError, ConfigError) as error:
            return self._refuse(config, str(error))
        return self._look(config, model, plant)

    def _refuse(self, config: Config, text: str) -> int:
        terminal.complain(text, as_json=False)
        faults = [line.removeprefix("  - ") for line in text.splitlines()]
        self.emit({"plant": config.plant.model, "faults": faults[1:] or faults})
        return 2

    def _look(self, config: Config, model: Model, plant: Known | Plant) -> int:
        import numpy as np

        from lbmpc.analysis import advised_horizon, poles, reach, sample_disturbance
        from lbmpc.plants import Known, get_plant, get_truth, true_motion
        from node_runtime.config.plant import initial_state, true_plant_of
        from tandem.commands.model.findings import (
            disturbance_finding,
            findings,
            weights_finding,
        )
        from tandem.model_tables import matrix_tables

        known, horizon, x0 = model.plant, config.controller.horizon, initial_state(config, plant)
        true = true_plant_of(config, get_plant, get_truth)
        step = true_motion(true).step
        W = known.W if config.controller.W is None else np.array(config.controller.W)
        self.say(f"{known.name}: {_kind(plant)}; a sample every {model.period:.6g} s", "")
        self.say("x+ = A x + B u, in deviations from x_e and u_e")
        scales = known.x_scale, np.concatenate([known.x_scale, known.u_scale])
        names = (*known.states, *known.inputs)
        matrices = np.hstack([model.A, model.B])
        for table in matrix_tables(self.console.width, known.states, names, matrices, scales):
            self.console.print(table)
        sampled = bound = None
        # For matrices that are their own truth, h is zero.
        if not isinstance(true, Known):
            with self.console.status("sampling h of the true motion"):
                rng = np.random.default_rng(0)
                sampled = sample_disturbance(model, step, SAMPLES, rng)
        if self.prove:
            bound = self._proved(model, own_truth=not config.plant.truth)
        moved = reach(model, horizon)
        self.say(
            "",
            f"moved: half-widths that full inputs move a state within the horizon ({horizon * model.period:.3g} s)",
            "W and h: per second",
        )
        self.console.print(_state_table(known, x0, moved, W, sampled, bound))
        self.console.print(_input_table(known))
        said = list(findings(model, horizon, x0, step))
        if sampled is not None:
            said.append(disturbance_finding(known, W, sampled))
        if (weights := weights_finding(model)) is not None:
            said.append(weights)
        self.say("")
        self.console.print(_findings_table(said))
        faults = [finding.text for finding in said if finding.verdict == "fault"]
        self.emit(
            {
                "plant": known.name,
                "faults": faults,
                "notes": {f.subject: f.text for f in said if f.verdict == "note"},
                "states": known.states,
                "inputs": known.inputs,
                "period": model.period,
                **{key: getattr(model, key) for key in ("A", "B", "K")},
                "poles": [[p.real, p.imag] for p in poles(model.A, model.period).tolist()],
                "closed_loop_poles": [
                    [p.real, p.imag] for p in poles(model.closed_loop, model.period).tolist()
                ],
                "x_scale": known.x_scale,
                "u_scale": known.u_scale,
                "moved": moved,
                "horizon": horizon,
                "advised_horizon": advised_horizon(model),
                "W": W,
                "h_sampled": None if sampled is None else sampled.largest,
                "h_bound": bound,
            }
        )
        return 2 if faults else 0

    def _proved(self, model: Model, own_truth: bool) -> np.ndarray | None:
        """Return a rigorous bound of |h| over X and U, (d,) per second; or None and the reason."""
        import numpy as np

        from lbmpc.sets.enclosures.disturbance import DisturbanceError, Region, bound_box

        if model.equations is None or not own_truth:
            why = (
                "there are no equations" if own_truth else "plant.truth says that the equations are not true"
            )
            self.say(f"h cannot be bounded: {why}", style="yellow")
            return None
        plant = model.plant
        bounds = (plant.x_min, plant.x_max), (plant.u_min, plant.u_max)
        sides = [
            side - rest for pair, rest in zip(bounds, (plant.x_e, plant.u_e), strict=True) for side in pair
        ]
        try:
            with terminal.share_bar(self.console) as bar:
                task = bar.add_task("bounding h", total=1.0)
                box = bound_box(model, Region(*sides), progress=lambda done: bar.update(task, completed=done))
        except DisturbanceError as error:
            self.console.print(f"h cannot be bounded: {error}", style="yellow")
            return None
        return np.abs(box.vertices).max(axis=0) / model.period


def _kind(plant: Known | Plant) -> str:
    from lbmpc.plants import Known

    if not isinstance(plant, Known):
        return "equations, linearised at (x_e, u_e)"
    return "A and B in continuous time" if plant.period is None else "A and B in discrete time"


def _with_unit(known: Known, name: str, value: float) -> str:
    unit = known.units[name]
    return f"{value:.3g}" if unit == "1" else f"{value:.3g} {unit}"


def _rounded(value: float, scale: float) -> str:
    """Four digits; a value within rounding of the half-width is 0."""
    return f"{0.0 if abs(value) < ROUNDING * scale else value:.4g}"


def _state_table(
    known: Known,
    x0: np.ndarray,
    moved: np.ndarray,
    W: np.ndarray,
    sampled: SampledDisturbance | None,
    bound: np.ndarray | None,
) -> Table:
    from rich.table import Column

    from tandem.model_tables import plain

    names = ["half-width", "x_e", "x0", "moved", "W"]
    names += ["largest h found"] * (sampled is not None) + ["h bound"] * (bound is not None)
    shown = plain(Column("", style="bold"), *(Column(name, justify="right") for name in names))
    for i, state in enumerate(known.states):
        scale = known.x_scale[i]
        row = [_with_unit(known, state, scale), _rounded(known.x_e[i], scale), _rounded(x0[i], scale)]
        row += [f"{moved[i]:.3g}", f"{W[i]:.3g}"]
        row += [] if sampled is None else [f"{sampled.largest[i]:.3g}"]
        row += [] if bound is None else [f"{bound[i]:.3g}"]
        shown.add_row(state, *row)
    return shown


def _input_table(known: Known) -> Table:
    import numpy as np
    from rich.table import Column

    from tandem.model_tables import plain

    limited = bool(np.isfinite(known.input_rates).any())
    names = ("half-width", "u_e", "u_min", "u_max", "safe input", *("max per second",) * limited)
    shown = plain(Column("", style="bold"), *(Column(name, justify="right") for name in names))
    for i, name in enumerate(known.inputs):
        values, scale = (known.u_e[i], known.u_min[i], known.u_max[i], known.safe_input[i]), known.u_scale[i]
        values += (known.input_rates[i],) * limited
        shown.add_row(name, _with_unit(known, name, scale), *(_rounded(value, scale) for value in values))
    return shown


def _findings_table(said: list[Finding]) -> Table:
    from rich.table import Column
    from rich.text import Text

    from tandem.model_tables import plain

    shown = plain(Column("", no_wrap=True), Column("", style="bold", no_wrap=True), Column(""))
    shown.show_header = False
    for finding in said:
        word, style = MARKS[finding.verdict]
        shown.add_row(Text(word, style), finding.subject, finding.text)
    return shown
