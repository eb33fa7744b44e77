"""`tandem sets compute`: construct sets, check them, store them, write them, and print their properties."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from tandem import terminal
from tandem.commands.base import NO_SETS, Configured
from tandem.terminal import Refused

if TYPE_CHECKING:
    import numpy as np
    from rich.progress import TaskID
    from rich.table import Table

    from controller_node.certified_sets import CertifiedSets, Kind
    from lbmpc.model import Model

WARNING_SAMPLES = 20_000


@dataclass(frozen=True, kw_only=True)
class SetsCompute(Configured):
    """Compute sets in which the true plant can be kept forever, check them, and write them to a file."""

    kind: Annotated[
        Literal["regions", "hull", "box", "given", "all"], arg(metavar="regions|hull|box|given|all")
    ] = "regions"
    """Knowledge of the model error h: its bound as a box, as a hull, also by regions around a path from x0, or given as
    controller.W. `all`: box, hull and regions in one table; the last one is written."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("sets.json")
    """File of the sets; gzipped if the name ends in .gz."""
    slack: Annotated[float, arg(metavar="SHARE")] = 3e-4
    """Margin beyond W, as a share of X's half-widths: a larger one ends sooner, with smaller sets."""
    fresh: bool = False
    """Do not use the cache."""

    def run(self) -> int:
        """Return 0 if the sets are written, 3 if there are none."""
        config, _ = self.resolve()

        from controller_node.build import build_model, given_disturbance
        from controller_node.certified_sets import CertifiedSets, default_cache, start_of, write_sets
        from lbmpc.sets.certificate import CertificateError
        from lbmpc.sets.enclosures.disturbance import DisturbanceError
        from lbmpc.sets.geometry.polytope import SetError
        from lbmpc.sets.motion import require_certifiable
        from node_runtime.whole_file import require_regular

        if not 0.0 < self.slack < 1.0:
            raise Refused(f"--slack {self.slack:g}: choose a share between 0 and 1")
        try:
            require_regular(self.out)
        except OSError as error:
            raise Refused(f"{self.out}: cannot be written: {error.strerror}") from error
        model = build_model(config)
        try:
            require_certifiable(model)
        except CertificateError as error:
            raise Refused(str(error)) from error
        W = given_disturbance(config)
        start = start_of(config, model)
        kinds: Sequence[Kind] = ("box", "hull", "regions") if self.kind == "all" else (self.kind,)
        made: list[tuple[Kind, CertifiedSets | str, bool]] = []
        for kind in kinds:
            try:
                made.append((kind, *self._one(kind, model, start, W)))
            except (SetError, DisturbanceError) as error:
                made.append((kind, str(error), False))
            except OSError as error:
                where = error.filename or default_cache()
                raise Refused(f"{where}: cannot be written: {error.strerror}") from error
        results = [_result(kind, sets, cached) for kind, sets, cached in made]
        good = [sets for _, sets, _ in made if isinstance(sets, CertifiedSets)]
        if good:
            try:
                write_sets(good[-1], self.out)
            except OSError as error:
                raise Refused(f"{self.out}: cannot be written: {error.strerror}") from error
            results[[s for _, s, _ in made].index(good[-1])]["file"] = str(self.out)
            self.console.print(_table(results))
            self.say(_meaning(good[-1], model), f"wrote {self.out}")
        for kind, reason, _ in made:
            if isinstance(reason, str):
                terminal.complain(f"no certified sets of kind {kind}: {reason}", as_json=False)
        self.emit(results[0] if len(results) == 1 else {"sets": results})
        return 0 if len(good) == len(made) else NO_SETS

    def _one(
        self, kind: Kind, model: Model, start: np.ndarray, W: np.ndarray | None
    ) -> tuple[CertifiedSets, bool]:
        """Return the sets, and whether they were in the cache. Raises `SetError`, `DisturbanceError`, `OSError`."""
        from controller_node.certified_sets import (
            CertifiedSets,
            Found,
            SavedArrays,
            Work,
            default_cache,
            read_sets,
            why_not_trusted,
        )
        from lbmpc.sets.certificate import CertificateError
        from lbmpc.sets.check import check
        from lbmpc.sets.construct import Saved, construct, volume_fraction
        from lbmpc.sets.geometry.polytope import SetError
        from lbmpc.sets.guard import Guard

        work = Work.of(model, kind, start, W, self.slack, default_cache())
        doubt = why_not_trusted(work)
        saved: Saved = SavedArrays(work.folder) if doubt is None else {}
        if doubt is not None:
            self.say(f"{doubt}; computing without it", style="yellow")
        elif self.fresh:
            saved.clear()
        elif work.sets.exists():
            try:
                return read_sets(work.sets), True
            except CertificateError as error:
                self.say(f"{error}; computing again", style="yellow")
        began = time.monotonic()
        tasks: dict[str, TaskID] = {}
        with terminal.share_bar(self.console) as bar:

            def report(what: str, share: float) -> None:
                # "the invariant set: step 12, 340 facets" is one bar, whose text changes.
                stage = what.split(":")[0]
                if stage not in tasks:
                    tasks[stage] = bar.add_task(what, total=1.0)
                bar.update(tasks[stage], completed=share, description=f"{kind}: {what}")

            try:
                certificate = construct(model, kind, start, W, self.slack, saved=saved, report=report)
            except KeyboardInterrupt:
                kept = f"is kept in {work.folder}; the same command continues from there"
                self.say(f"interrupted; the finished part {kept if doubt is None else 'is lost'}")
                raise
            seconds = time.monotonic() - began
            proving = bar.add_task(f"{kind}: proving the claim", total=1.0)
            verdict = check(certificate, progress=lambda done: bar.update(proving, completed=done))
        if not verdict.ok:
            raise SetError(f"the sets were constructed, but the checker refuses them: {verdict.reason}")
        contains = Guard(certificate).first_inputs(start).piece >= 0
        found = Found(volume_fraction(certificate), verdict.margin, contains, seconds)
        sets = CertifiedSets.of(certificate, found)
        if doubt is None:
            work.save(sets)
        return sets, False


def _result(kind: Kind, sets: CertifiedSets | str, cached: bool) -> dict[str, Any]:
    """Return one object of `--json`."""
    if isinstance(sets, str):
        nothing = dict.fromkeys(("contains_x0", "invariance_margin", "seconds", "file"))
        return {"kind": kind, "facets": 0, "volume_fraction": 0.0, "certificate": sets, **nothing}
    found = sets.found
    return {
        "kind": kind,
        "facets": sum(sets.facets),
        "facets_by_set": sets.facets,
        "contains_x0": found.contains_x0,
        "volume_fraction": found.volume_fraction,
        "invariance_margin": found.invariance_margin,
        "seconds": found.seconds,
        "cached": cached,
        "certificate": "ok",
        "sha256": sets.sha256,
        "file": None,
    }


def _table(results: Sequence[dict[str, Any]]) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("W", style="bold")
    for name in ("sets", "facets", "share of X", "x0", "margin", "seconds", "certificate"):
        table.add_column(name, justify="right")
    for r in results:
        if r["certificate"] != "ok":
            table.add_row(r["kind"], "-", "-", "-", "-", "-", "-", "none, see below")
            continue
        seconds = f"{r['seconds']:.1f}" + (" (cached)" if r["cached"] else "")
        table.add_row(
            r["kind"],
            str(len(r["facets_by_set"])),
            str(r["facets"]),
            f"{100 * r['volume_fraction']:.2f} %",
            "inside" if r["contains_x0"] else "outside",
            f"{r['invariance_margin']:.2g}",
            seconds,
            "ok",
        )
    return table


def _meaning(sets: CertifiedSets, model: Model) -> str:
    from tandem.commands.sets.sampling import HAIR, sample

    certificate = sets.certificate
    count = len(certificate.pieces)
    given = certificate.source_of_W == "given"
    text = (
        f"From every state of {'this set' if count == 1 else f'these {count} sets'} the inputs of U can keep the plant "
        f"in {'it' if count == 1 else 'them'}, and so in X, at all times: {certificate.model.plant} at "
        f"{1 / certificate.model.period:g} Hz, "
    )
    if not given:
        return text + "for every h within its proved bound."
    text += "as long as h stays in the W that was given."
    if model.equations is None:
        return text + " The plant has no equations with which to check this."
    found = sample(certificate, model, WARNING_SAMPLES)
    if found.excess > HAIR:
        text += f"\nWarning: the plant's own equations leave that W: {found.where}."
    return text
