"""`tandem identify`: A, B and W of a plant from the samples of its logs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from tandem.commands.base import Command
from tandem.terminal import Refused

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from lbmpc.identification import Identified, Quality
    from lbmpc.model import Model
    from lbmpc.plants import Known
    from run_log.reading.transitions import Observed

SAME_PERIOD = 1e-9
LEARNING = {"dnn", "l2nw", "perfect"}
"""Oracles whose h_hat is a function of x and u."""


@dataclass(frozen=True, kw_only=True)
class Identify(Command):
    """Fit A, B and W to the samples of logs by least squares, and check them on samples that were not fitted."""

    EXTRAS = "log"

    files: Annotated[Positional[list[Path]], arg(metavar="LOG...", help_behavior_hint="(required)")]
    """Logs of one plant at one rate."""
    out: Annotated[Path | None, arg(metavar="FILE.py", help_behavior_hint="(default: none is written)")] = (
        None
    )
    """Write a plant file, for plant.model=FILE.py:PLANT."""
    plant: Annotated[
        str | None, arg(metavar="FILE:NAME", help_behavior_hint="(default: the logs' numbers)")
    ] = None
    """The plant file of the logs, if they do not carry its numbers."""

    def run(self) -> int:
        """Return 0, or 2 if the logs do not determine A and B."""
        import numpy as np

        from lbmpc.identification import NotIdentifiable, Quality, Variables, identify
        from tandem.plant_file import require_new, write_new

        if self.out is not None:
            require_new(self.out)
        known, period, logs = self._read()
        transitions = logs[0].transitions
        for log in logs[1:]:
            transitions = transitions.then(log.transitions)
        scales = known.x_scale, known.u_scale
        variables = Variables(known.states, known.inputs, *scales, known.x_e, known.u_e)
        try:
            found = identify(transitions, period, variables)
        except NotIdentifiable as error:
            raise Refused(f"{self._named}: {error}") from error
        own = Quality.of(np.vstack([log.missed for log in logs]), known.x_scale, period)
        self._show(known, found, own)
        result = _result(known, found, own)
        if self.out is not None:
            write_new(self.out, _source(known, found, self._named))
            result["file"] = str(self.out)
            rate = f"--set rate={1.0 / period:.10g}"
            self.say(f"written: {self.out}", f"run it:  tandem run --set plant.model={self.out}:PLANT {rate}")
        self.emit(result)
        return 0

    @property
    def _named(self) -> str:
        return ", ".join(file.name for file in self.files)

    def _read(self) -> tuple[Known, float, list[Observed]]:
        """Return the plant of the first log, the period, and the samples of each log."""
        from run_log.named_plant import name_plant
        from run_log.reading.reader import read_run
        from run_log.reading.transitions import observed

        first: Model | None = None
        logs: list[Observed] = []
        oracles: set[str] = set()
        for file in self.files:
            ran = read_run(file)
            notes = [] if self.plant is None else name_plant(ran, self.plant)
            model = _model_of(ran)
            if first is None:
                first = model
            elif (model.plant.states, model.plant.inputs) != (first.plant.states, first.plant.inputs):
                raise Refused(f"{file}: its plant ({model.plant.name}) is not that of {self.files[0]}")
            elif abs(model.period - first.period) > SAME_PERIOD * first.period:
                raise Refused(
                    f"{file}: sampled every {model.period:g} s, and {self.files[0]} every {first.period:g} s; the "
                    "logs need the same period"
                )
            logs.append(observed(ran, model))
            self.say(*notes, *([ran.note] if ran.note else []), style="yellow")
            oracles.add(ran.config.controller.oracle)
        if first is None:
            raise Refused("no log is given")
        if learned := sorted(oracles & LEARNING):
            self.say(
                f"with the oracle {' and '.join(learned)} u depends on the error of the linear model, which may "
                "bias A and B; logs with controller.oracle=linear avoid this",
                style="yellow",
            )
        return first.plant, first.period, logs

    def _show(self, known: Known, found: Identified, own: Quality) -> None:
        import numpy as np

        from lbmpc.analysis import poles
        from tandem.model_tables import matrix_tables, percent, poles_text

        self.say(
            f"{known.name}: {found.samples} samples, one every {found.period:g} s",
            "x+ = A x + B u + c, in deviations from x_e and u_e; the standard error is below each entry",
            "",
        )
        tables = matrix_tables(
            self.console.width,
            known.states,
            (*known.states, *known.inputs, "c"),
            np.column_stack([found.A, found.B, found.offset]),
            (known.x_scale, np.concatenate([known.x_scale, known.u_scale, [1.0]])),
            np.column_stack([found.A_error, found.B_error, found.offset_error]),
        )
        for table in tables:
            self.console.print(table)
        self.say(
            "",
            "error one step ahead, RMS and largest, in half-widths per second; held-out samples are not fitted",
        )
        self.console.print(_quality_table(known, found, own))
        self.say(
            "",
            f"poles, 1/s: {poles_text(poles(found.A, found.period))}",
            f"smallest excitation of any direction: {percent(float(found.excitation[-1]))} of a half-width (RMS)",
        )
        worse = [s for s, a, b in zip(known.states, found.held_out.rms, own.rms, strict=True) if a > b]
        if worse:
            self.say(
                f"the log's model predicts the held-out samples of {', '.join(worse)} at least as well: keep it, or "
                "record more motion",
                style="yellow",
            )


def _model_of(ran: Any) -> Model:
    """Return the model of the log's plant. Raises `LogError`."""
    from lbmpc.model import ModelError, build_model
    from run_log.errors import LogError
    from run_log.run import plant_of

    try:
        return build_model(plant_of(ran), ran.config.period)
    except ModelError as error:
        raise LogError(f"{ran.path}: {error}") from error


def _quality_table(known: Known, found: Identified, own: Quality) -> Table:
    from rich.table import Column

    from tandem.model_tables import percent, plain

    right = [Column(name, justify="right") for name in ("held out", "the log's model", "nothing changes")]
    shown = plain(Column("", style="bold"), *right, Column("W per second", justify="right"))
    for i, state in enumerate(known.states):
        pairs = [f"{percent(q.rms[i])}, {percent(q.largest[i])}" for q in (found.held_out, own)]
        nothing = f"{percent(found.nothing_changes.rms[i])}, {percent(found.nothing_changes.largest[i])}"
        shown.add_row(state, *pairs, nothing, f"{found.W[i]:.2g}")
    return shown


def _result(known: Known, found: Identified, own: Quality) -> dict[str, Any]:
    """Return what `--json` prints; matrices in the plant's units, residuals in half-widths per second."""

    def of(quality: Quality) -> dict[str, np.ndarray]:
        return {"rms": quality.rms, "largest": quality.largest}

    return {
        "plant": known.name,
        "states": known.states,
        "inputs": known.inputs,
        "period": found.period,
        "samples": found.samples,
        **{
            key: getattr(found, key)
            for key in ("A", "B", "offset", "A_error", "B_error", "offset_error", "W")
        },
        "held_out": of(found.held_out),
        "log_model": of(own),
        "nothing_changes": of(found.nothing_changes),
        "excitation": found.excitation,
    }


def _source(known: Known, found: Identified, logs: str) -> str:
    """The plant file."""
    from lbmpc.identification import MARGIN
    from tandem.plant_file import shared_fields, source

    found_here = {key: getattr(found, key) for key in ("A", "B", "offset", "period", "W")}
    fields = {**found_here, **shared_fields(known)}
    about = [
        f"{known.name} identified from {found.samples} samples, one every {found.period:g} s ({logs}).",
        "",
        f"W is {MARGIN:g} times the largest residual of samples that were held out of the fit.",
        "",
    ]
    return source(fields, about)
