"""`tandem sets plot`: plot a file of certified sets, with a run over it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import NO_SETS, Configured, require
from tandem.terminal import Refused

if TYPE_CHECKING:
    from controller_node.certified_sets import CertifiedSets
    from lbmpc.plants import Known, Plant


@dataclass(frozen=True, kw_only=True)
class SetsPlot(Configured):
    """Plot sets: projections and slices with X, W, the tube, x0, and a run if one is given.

    The plant is the run's, or the configuration's; without both the one that the file names, of those that come with
    Tandem.
    """

    EXTRAS = "log"

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A file of certified sets."""
    log: Annotated[Path | None, arg(name="run", metavar="LOG", help_behavior_hint="(default: none)")] = None
    """A log whose states are plotted over the sets."""
    out: Annotated[Path | None, arg(metavar="PNG", help_behavior_hint="(default: FILE with .png)")] = None
    """File of the picture."""

    def run(self) -> int:
        """Return 0 if it is drawn, 3 if the file is refused."""
        import numpy as np

        from controller_node.certified_sets import read_sets
        from lbmpc.model import ModelError, build_model
        from lbmpc.sets.certificate import CertificateError, require_match
        from run_log.reading.reader import read_run
        from run_log.reporting.canvas import drawing, save
        from run_log.reporting.motion import trajectory
        from run_log.run import plant_of as plant_of_run

        require("matplotlib")
        file, log = self.file, self.log
        out = file.with_suffix("").with_suffix(".png") if self.out is None else self.out
        try:
            sets = read_sets(file)
            ran = None if log is None else read_run(log)
            plant = self._plant(sets.certificate.model.plant) if ran is None else plant_of_run(ran)
            if plant.name != sets.certificate.model.plant:
                whose = self.config or "this configuration" if log is None else log
                raise Refused(
                    f"{whose}: has the plant {plant.name}, and the sets belong to {sets.certificate.model.plant}"
                )
            model = build_model(plant, sets.certificate.model.period)
            require_match(sets.certificate, model)
        except (CertificateError, ModelError) as error:
            terminal.complain(f"refused: {error}", self.json)
            return NO_SETS
        except LookupError as error:
            raise Refused(f"{file}: {error.args[0]}") from error
        states, x0 = None, plant.x0
        if ran is not None:
            states = trajectory(ran, plant).x
            x0 = states[0]
        with drawing(out):
            from tandem.commands.sets.picture import Drawn, picture
        drawn = Drawn(sets.certificate, model, np.asarray(x0), states)
        save(lambda: picture(drawn, _title(sets)), out, dpi=120)
        self.say(f"picture {out}")
        self.emit({"picture": str(out), "sha256": sets.sha256})
        return 0

    def _plant(self, name: str) -> Known | Plant:
        """The configuration's plant, if there is one. Raises `LookupError`."""
        from lbmpc.plants import get_plant
        from node_runtime.config.plant import plant_of

        if self.config is None and not self.set:
            return get_plant(name)
        return plant_of(self.resolve()[0], get_plant)


def _title(sets: CertifiedSets) -> str:
    model, found = sets.certificate.model, sets.found
    count = len(sets.certificate.pieces)
    return (
        f"{model.plant} at {1 / model.period:g} Hz: {count} certified {'set' if count == 1 else 'sets'} "
        f"({sets.certificate.kind}), {100 * found.volume_fraction:.1f} % of X"
    )
