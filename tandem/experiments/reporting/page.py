"""The report: one page that needs nothing else, from the results."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import jinja2
import numpy as np

from lbmpc.plants import Description
from node_runtime import provenance
from node_runtime.config.loading import to_toml
from node_runtime.config.sections import Config
from run_log.reporting.canvas import PictureError, drawing
from run_log.reporting.performance import SETTLED
from tandem.experiments.reporting import findings, pictures, style
from tandem.experiments.study.declaration import Declaration, Group
from tandem.experiments.study.results import CaseResult, spread


class Page(NamedTuple):
    html: str
    pictures: dict[str, bytes]
    """PNG by name, of those that could be drawn."""


class Drawn(NamedTuple):
    png: bytes
    uri: str
    """Empty where it could not be drawn; the caption says why."""
    caption: str
    alt: str


class Table(NamedTuple):
    head: list[str]
    body: list[list[str]]
    note: str


class Part(NamedTuple):
    """What is shown of one group."""

    group: Group
    claims: list[findings.Claim]
    pictures: list[Drawn]
    table: Table
    words: list[str]

    def named_pictures(self) -> Iterator[tuple[str, bytes]]:
        """(name, PNG): the group's name, with a number from the second one on."""
        for number, drawn in enumerate(self.pictures, 1):
            if drawn.png:
                yield self.group.name + (f"-{number}" if number > 1 else ""), drawn.png


def page(
    declared: Declaration,
    results: list[CaseResult],
    plant: Description,
    base: Config,
    command: str,
    code: str,
    quick: bool,
    failed: int = 0,
) -> Page:
    """The whole report as HTML, and its pictures.

    Args:
        declared: the experiment.
        results: its cases, in order.
        plant: what was controlled.
        base: the configuration that no case has changed.
        command: what made this.
        code: version of the code, a hash.
        quick: whether it is the short form.
        failed: runs that failed and are in no table.
    """
    parts = []
    for group in declared.group:
        own = [result for result in results if result.case.group == group.name]
        if own:
            parts.append(_part(group, own, plant))
    loader = jinja2.PackageLoader("tandem.experiments.reporting", "")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    html = environment.get_template("page.html.j2").render(
        declared=declared,
        parts=parts,
        config=to_toml(base),
        machine=provenance.describe() | provenance.versions(provenance.SCIENCE),
        load=provenance.load(),
        command=command,
        code=code,
        runs=sum(len(result.rows) for result in results),
        quick=quick,
        failed=failed,
        arithmetics=sorted({row.arithmetic for result in results for row in result.rows}),
        squares=_squares(plant),
    )
    return Page(html, {name: png for part in parts for name, png in part.named_pictures()})


def _part(group: Group, results: list[CaseResult], plant: Description) -> Part:
    survival = group.picture == "survival"
    try:
        with drawing(f"the picture of {group.name}"):
            drawn = [
                Drawn(style.png(one.figure), style.data_uri(one.figure), one.caption, one.alt)
                for one in pictures.draw(group.picture, results, plant, group.reference)
            ]
    except PictureError as error:
        drawn = [Drawn(b"", "", str(error), "")]
    return Part(
        group=group,
        claims=findings.claims(results) if group.picture == "trajectories" else [],
        pictures=drawn,
        table=_survival_table(results) if survival else _table(results, plant),
        words=findings.survival(results)
        if survival
        else [*findings.compare(results, group.reference), *findings.below_perfect(results)],
    )


def _table(results: list[CaseResult], plant: Description) -> Table:
    """A row for each case: medians, worst cases."""
    regret = any(row.regret is not None for result in results for row in result.rows)
    several = any(result.case.episodes > 1 for result in results)
    state = plant.states[plant.performance[0]]
    head = [
        "case",
        "runs",
        "keep X and U at samples",
        "excess, also between samples (%)",
        *(["J in the first"] if several else []),
        *(["its regret (%)"] if several and regret else []),
        "J in the later" if several else "J",
        *(["regret (%)", "worst"] if regret else ["worst J"]),
        "deviation",
        f"overshoot of {state} (%)",
        "worst",
        "settled (s)",
        "limit / soft / fallback ticks",
        "solve p50 / p99 (ms)",
    ]
    body = []
    for result in results:
        times = "–"
        if result.timing is not None:
            spent = spread(result.timing)
            times = f"{spent.p50:.2g} / {spent.p99:.2g}"
        ticks = (result.median(f"{name}_ticks") for name in ("iteration_limit", "soft", "fallback"))
        body.append(
            [
                result.label,
                str(len(result.rows)),
                f"{result.kept:.0%}",
                _percent(result.worst("excess_between_samples")),
                *([_number(result.median("J_first"))] if several else []),
                *([_percent(result.median("regret_first"), signed=True)] if several and regret else []),
                _number(result.median("J")),
                *([_percent(result.median("regret"), signed=True)] if regret else []),
                _percent(result.worst("regret"), signed=True) if regret else _number(result.worst("J")),
                _number(result.median("deviation")),
                _percent(result.median("overshoot")),
                _percent(result.worst("overshoot")),
                _settled(result),
                " / ".join(_number(count) for count in ticks),
                times,
            ]
        )
    of_several = (
        "Of several episodes, all that does not say first is of the later ones: J and deviation are their mean, "
        "overshoot and settling the worst of them; constraints and ticks are those of all. "
    )
    note = (
        "Medians over the runs, where it does not say worst; the excess is the worst run's. Excess: the largest "
        "distance of the true motion from X, between samples too, as a share of the half-width; – where it is not "
        f"known. Overshoot: how far beyond its equilibrium {state} got, as a share of its own initial deviation. "
        f"Settled: {_bands(plant)} for good. Ticks at the iteration limit, "
        "ticks in which a soft constraint gave way, and ticks whose input did not come from the solver. Solve times "
        "were measured alone, from the plant's own x0, once for every oracle, horizon, network and rate."
    )
    return Table(head, body, of_several * several + note)


def _bands(plant: Description) -> str:
    """What settled means, in the plant's own words and units."""
    states = [(plant.states[i], SETTLED * plant.x_scale[i]) for i in plant.performance]
    within = [f"{name} within {band:g} {_unit(plant, name)}".rstrip() for name, band in states]
    return f"{' and '.join(within)} of the equilibrium ({SETTLED:.0%} of the half-width)"


def _squares(plant: Description) -> str:
    return " + ".join(f"Δ{plant.states[i]}²" for i in plant.performance)


def _unit(plant: Description, name: str) -> str:
    unit = plant.units.get(name, "")
    return "" if unit == "1" else unit


def _survival_table(results: list[CaseResult]) -> Table:
    families = pictures.by_family(results)
    places = pictures.margins(next(iter(families.values())))
    head = ["oracle", "runs", *(f"{place:g}" for place in places)]
    body = []
    for members in families.values():
        first, kept = members[0], [f"{member.kept:.0%}" for member in members]
        body.append([pictures.family_label(first), str(len(first.rows)), *kept])
    return Table(head, body, "Share of the runs kept, by margin.")


def _settled(result: CaseResult) -> str:
    if result.case.set_points is not None:
        return "–"
    median = result.median("settled_s")
    if np.isinf(median):
        return "lost" if np.isinf(result.median("J")) else "not settled"
    return _number(median)


def _number(value: float, digits: int = 3) -> str:
    if not np.isfinite(value):
        return "–" if np.isnan(value) else "lost"
    if value == round(value) and abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"


def _percent(value: float, signed: bool = False) -> str:
    if not np.isfinite(value):
        return _number(value)
    value = round(100 * value, 1) or 0.0
    return f"{value:+.1f}" if signed and value else f"{value:.1f}"
