"""`tandem sets check`: the hash, the model, the claim, and W against the true plant."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from controller_node.build import build_model
from controller_node.certified_sets import read_sets
from lbmpc.model import Model
from lbmpc.sets.certificate import Certificate, CertificateError, require_match
from lbmpc.sets.check import check
from lbmpc.sets.construct import points_in
from lbmpc.sets.geometry.operations import body
from lbmpc.sets.invariance.approach import one_period
from node_runtime.config.sections import Config
from tandem import terminal
from tandem.checks import plant_of

REFUSED = 3
# Of the integration of a sample, as a share of a row's scaled length; a rigorous W is wider than that.
HAIR = 1e-9


@dataclass(frozen=True)
class Sampled:
    """W against the true plant; `excess` is how far h was outside, as a share of X's half-widths, at most 0 inside."""

    samples: int
    excess: float
    where: str


def run(config: Config, file: Path, samples: int, as_json: bool) -> int:
    """0: everything holds; 3: refused, and why."""
    if samples < 1:
        raise terminal.Refused(f"--samples {samples}: at least 1")
    plant_of(config)
    model, console = build_model(config), terminal.console(as_json)
    result: dict[str, Any] = {"file": str(file), "certificate": "ok"}
    reason = ""
    try:
        sets = read_sets(file)
        result |= {"kind": sets.certificate.kind, "sha256": sets.sha256, "facets": sum(sets.facets)}
        require_match(sets.certificate, model)
    except CertificateError as error:
        reason = str(error)
    else:
        with share_bar(as_json) as bar:
            task = bar.add_task("proving the claim", total=1.0)
            verdict = check(sets.certificate, progress=lambda done: bar.update(task, completed=done))
        found = sample(sets.certificate, model, samples)
        result |= {"invariance_margin": verdict.margin, "vertices": verdict.vertices}
        result |= {"samples": found.samples, "largest_excess_over_W": found.excess}
        if not verdict.ok:
            reason = f"the claim does not hold: {verdict.reason}"
        elif found.excess > HAIR:
            reason = f"its W does not hold for the true plant: {found.where}"
    if reason:
        result["certificate"] = reason
        terminal.complain(f"{file}: refused: {reason}", as_json=False)
    else:
        console.print(f"{file}: ok", style="green", markup=False, soft_wrap=True)
        near = f"at least {-found.excess:.2g} inside" if found.excess < 0 else f"never outside by {HAIR:g}"
        text = (
            f"{len(sets.facets)} sets ({sets.certificate.kind}), {result['facets']} facets, {result['vertices']} "
            f"vertices confirmed; margin {result['invariance_margin']:.2g} of X's half-widths\n"
            f"the true plant at {found.samples} states and inputs: h stays in W ({near})\n"
            f"sha256 {sets.sha256}"
        )
        console.print(text, markup=False, soft_wrap=True)
    if as_json:
        terminal.emit(result)
    return REFUSED if reason else 0


def sample(certificate: Certificate, model: Model, samples: int, seed: int = 0) -> Sampled:
    """Random states and inputs of every piece: does h lie in its W, in the directions of its target's rows?"""
    rng, move = np.random.default_rng(seed), one_period(model)
    half = model.plant.x_scale
    worst, where, asked = -math.inf, "", 0
    for piece in certificate.pieces:
        inside = body(np.array(piece.G), np.array(piece.g), piece.name, half)
        count = math.ceil(samples / len(certificate.pieces))
        x = points_in(inside, count, rng)
        u = rng.uniform(piece.u_lower, piece.u_upper, (count, model.m))
        after = np.asarray(move(x.T, u.T)).T
        h = after - x @ model.A.T - u @ model.B.T
        rest = h - x @ np.array(piece.slope_x).T - u @ np.array(piece.slope_u).T
        T = np.array(certificate.pieces[piece.target].G)
        T = T / np.linalg.norm(T * half, axis=1)[:, None]
        excess = (rest @ T.T - (T @ np.array(piece.W).T).max(axis=1)).max(axis=1)
        asked += count
        if excess.max() > worst:
            worst, at = float(excess.max()), int(excess.argmax())
            state, given = x[at] + model.plant.x_e, u[at] + model.plant.u_e
            where = (
                f"in piece {piece.name}, from x = {np.array2string(state, precision=6)} with u = "
                f"{np.array2string(given, precision=6)}, h is outside of W by {worst:.3g} of X's half-widths"
            )
    return Sampled(asked, worst, where)


def share_bar(as_json: bool) -> Progress:
    """A progress bar of shares, on a terminal."""
    console = terminal.console(as_json)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )
