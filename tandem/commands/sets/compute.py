"""`tandem sets compute`: construct, have it checked, keep it, write it, say what it is worth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import TaskID
from rich.table import Table

from controller_node.build import build_model
from controller_node.certified_sets import (
    CertifiedSets,
    Found,
    Kind,
    SavedArrays,
    Work,
    default_cache,
    read_sets,
    start_of,
    write_sets,
)
from lbmpc.model import Model
from lbmpc.sets.certificate import Certificate, CertificateError
from lbmpc.sets.check import check
from lbmpc.sets.construct import construct, volume_fraction
from lbmpc.sets.enclosures.disturbance import DisturbanceError
from lbmpc.sets.geometry.polytope import SetError
from lbmpc.sets.guard import Guard
from node_runtime.config.sections import Config
from tandem import terminal
from tandem.checks import plant_of
from tandem.commands.sets.check import HAIR, REFUSED, sample, share_bar
from tandem.terminal import Refused

WARNING_SAMPLES = 20_000


@dataclass(frozen=True)
class _Asked:
    """What the sets are for."""

    model: Model
    start: np.ndarray
    W: np.ndarray | None
    slack: float
    fresh: bool
    cache: Path


def run(config: Config, kinds: Sequence[Kind], out: Path, slack: float, fresh: bool, as_json: bool) -> int:
    """0: written; 3: there are no such sets, and why. Raises `Refused`, `ConfigError`."""
    if not 0.0 < slack < 1.0:
        raise Refused(f"--slack {slack:g}: a share between 0 and 1")
    if out.is_dir():
        raise Refused(f"{out}: is a folder; name a file")
    plant_of(config)
    model = build_model(config)
    W = None if config.controller.W is None else np.array(config.controller.W, dtype=float)
    asked = _Asked(model, start_of(config, model), W, slack, fresh, default_cache())
    console = terminal.console(as_json)
    made: list[tuple[Kind, CertifiedSets | str, bool]] = []
    for kind in kinds:
        try:
            sets, cached = _one(asked, kind, as_json, console)
            made.append((kind, sets, cached))
        except (SetError, DisturbanceError) as error:
            made.append((kind, str(error), False))
        except OSError as error:
            raise Refused(f"{error.filename or asked.cache}: cannot be written: {error.strerror}") from error
    results = [_result(kind, sets, cached) for kind, sets, cached in made]
    good = [sets for _, sets, _ in made if isinstance(sets, CertifiedSets)]
    if good:
        try:
            write_sets(good[-1], out)
        except OSError as error:
            raise Refused(f"{out}: cannot be written: {error.strerror}") from error
        results[[s for _, s, _ in made].index(good[-1])]["file"] = str(out)
        console.print(_table(results))
        console.print(_meaning(good[-1], asked), markup=False, soft_wrap=True)
        console.print(f"wrote {out}", markup=False, soft_wrap=True)
    for kind, reason, _ in made:
        if isinstance(reason, str):
            terminal.complain(f"no certified sets of kind {kind}: {reason}", as_json=False)
    if as_json:
        terminal.emit(results[0] if len(results) == 1 else {"sets": results})
    return 0 if len(good) == len(made) else REFUSED


def _one(asked: _Asked, kind: Kind, as_json: bool, console: Console) -> tuple[CertifiedSets, bool]:
    """The sets, and whether they were in the cache. Raises `SetError`, `DisturbanceError`, `OSError`."""
    work = Work.of(asked.model, kind, asked.start, asked.W, asked.slack, asked.cache)
    if not asked.fresh and work.sets.exists():
        try:
            return read_sets(work.sets), True
        except CertificateError as error:
            console.print(f"{error}; computed again", style="yellow", markup=False, soft_wrap=True)
    saved = SavedArrays(work.folder)
    if asked.fresh:
        saved.clear()
    began = time.monotonic()
    try:
        certificate = _constructed(asked, kind, saved, as_json)
    except KeyboardInterrupt:
        console.print(
            f"interrupted; what was done is kept in {work.folder}: the same command goes on from there",
            markup=False,
            soft_wrap=True,
        )
        raise
    seconds = time.monotonic() - began
    with share_bar(as_json) as bar:
        task = bar.add_task(f"{kind}: proving the claim", total=1.0)
        verdict = check(certificate, progress=lambda done: bar.update(task, completed=done))
    if not verdict.ok:
        raise SetError(f"constructed, but the checker refuses it: {verdict.reason}")
    contains = Guard(certificate).first_inputs(asked.start).piece >= 0
    found = Found(volume_fraction(certificate), verdict.margin, contains, seconds)
    sets = CertifiedSets.of(certificate, found)
    write_sets(sets, work.sets)
    return sets, False


def _constructed(asked: _Asked, kind: Kind, saved: SavedArrays, as_json: bool) -> Certificate:
    tasks: dict[str, TaskID] = {}
    with share_bar(as_json) as bar:

        def report(what: str, share: float) -> None:
            # "the invariant set: step 12, 340 facets" is one bar, whose text changes.
            stage = what.split(":")[0]
            if stage not in tasks:
                tasks[stage] = bar.add_task(what, total=1.0)
            bar.update(tasks[stage], completed=share, description=f"{kind}: {what}")

        return construct(asked.model, kind, asked.start, asked.W, asked.slack, saved=saved, report=report)


def _result(kind: Kind, sets: CertifiedSets | str, cached: bool) -> dict[str, Any]:
    """One object of `--json`."""
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


def _meaning(sets: CertifiedSets, asked: _Asked) -> str:
    certificate = sets.certificate
    count = len(certificate.pieces)
    given = certificate.source_of_W == "given"
    text = (
        f"From every state of {'this set' if count == 1 else f'these {count} sets'} the inputs of U can keep the plant "
        f"in {'it' if count == 1 else 'them'}, and so in X, for ever: {certificate.model.plant} at "
        f"{1 / certificate.model.period:g} Hz, "
    )
    if not given:
        return text + "whatever the true h does within its proved bound."
    text += "as long as h stays in the W that was given."
    found = sample(certificate, asked.model, WARNING_SAMPLES)
    if found.excess > HAIR:
        text += f"\nWarning: the plant's own equations leave that W: {found.where}."
    return text
