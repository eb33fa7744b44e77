"""`tandem sets plot`: a file of certified sets as a picture, with a run laid over it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from controller_node.certified_sets import CertifiedSets, read_sets
from lbmpc.model import ModelError, build_model
from lbmpc.plants import get_plant
from lbmpc.sets.certificate import CertificateError, require_match
from lbmpc.sets.geometry.polytope import SetError
from tandem import terminal
from tandem.commands.sets.check import REFUSED
from tandem.commands.various import log_packages
from tandem.terminal import Refused


def run(file: Path, log: Path | None, out: Path | None, as_json: bool) -> int:
    """0: drawn; 3: the file is refused. Raises `Refused`."""
    with log_packages():
        from run_log.errors import LogError
        from run_log.reading.reader import read_run
        from run_log.reporting.summary import trajectory
        from run_log.run import plant_of
        from tandem.commands.sets.picture import Drawn, picture
    out = file.with_suffix("").with_suffix(".png") if out is None else out
    try:
        sets = read_sets(file)
        plant = get_plant(sets.certificate.model.plant)
        model = build_model(plant, sets.certificate.model.period)
        require_match(sets.certificate, model)
    except (CertificateError, ModelError) as error:
        terminal.complain(f"refused: {error}", as_json)
        return REFUSED
    except LookupError as error:
        raise Refused(f"{file}: {error.args[0]}") from error
    states, x0 = None, plant.x0
    if log is not None:
        try:
            ran = read_run(log)
            if plant_of(ran).name != plant.name:
                raise Refused(f"{log}: is a run of {plant_of(ran).name}, and the sets are of {plant.name}")
            states = trajectory(ran, plant).x
            x0 = states[0]
        except LogError as error:
            raise Refused(str(error)) from error
    try:
        figure = picture(Drawn(sets.certificate, model, np.asarray(x0), states), _title(sets))
        figure.savefig(out, dpi=120)
    except SetError as error:
        raise Refused(f"{file}: {error}") from error
    except OSError as error:
        raise Refused(f"{out}: cannot be written: {error.strerror}") from error
    terminal.console(as_json).print(f"picture {out}", markup=False, soft_wrap=True)
    if as_json:
        terminal.emit({"picture": str(out), "sha256": sets.sha256})
    return 0


def _title(sets: CertifiedSets) -> str:
    model, found = sets.certificate.model, sets.found
    count = len(sets.certificate.pieces)
    return (
        f"{model.plant} at {1 / model.period:g} Hz: {count} certified {'set' if count == 1 else 'sets'} "
        f"({sets.certificate.kind}), {100 * found.volume_fraction:.1f} % of X"
    )
