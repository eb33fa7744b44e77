"""The report: one page that needs nothing else, from the results."""

from __future__ import annotations

from typing import NamedTuple

import jinja2
import numpy as np

from lbmpc.plants import Plant
from node_runtime import provenance
from node_runtime.config.sections import Config, to_toml
from run_log.reporting.canvas import PictureError, drawing
from tandem.experiments.reporting import findings, pictures, style
from tandem.experiments.study.declaration import Declaration, Group
from tandem.experiments.study.results import CaseResult, spread


class Drawn(NamedTuple):
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


def page(
    declared: Declaration,
    results: list[CaseResult],
    plant: Plant,
    base: Config,
    command: str,
    code: str,
    quick: bool,
) -> str:
    """The whole report as HTML.

    Args:
        declared: the experiment.
        results: its cases, in order.
        plant: what was controlled.
        base: the configuration that no case has changed.
        command: what made this.
        code: version of the code, a hash.
        quick: whether it is the short form.
    """
    parts = []
    for group in declared.group:
        own = [result for result in results if result.case.group == group.name]
        if own:
            parts.append(_part(group, own, plant))
    loader = jinja2.PackageLoader("tandem.experiments.reporting", "")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.get_template("page.html.j2").render(
        declared=declared,
        parts=parts,
        config=to_toml(base),
        machine=provenance.describe() | provenance.versions(provenance.SCIENCE),
        load=provenance.load(),
        command=command,
        code=code,
        runs=sum(len(result.rows) for result in results),
        quick=quick,
    )


def _part(group: Group, results: list[CaseResult], plant: Plant) -> Part:
    survival = group.picture == "survival"
    try:
        with drawing(f"the picture of {group.name}"):
            drawn = [
                Drawn(style.data_uri(one.figure), one.caption, one.alt)
                for one in pictures.draw(group.picture, results, plant, group.reference)
            ]
    except PictureError as error:
        drawn = [Drawn("", str(error), "")]
    return Part(
        group=group,
        claims=findings.claims(results) if group.picture == "trajectories" else [],
        pictures=drawn,
        table=_survival_table(results) if survival else _table(results, plant),
        words=findings.survival(results) if survival else findings.compare(results, group.reference),
    )


def _table(results: list[CaseResult], plant: Plant) -> Table:
    """A row for each case: medians, worst cases."""
    regret = any(row.regret is not None for result in results for row in result.rows)
    state = plant.states[plant.performance[0]]
    head = [
        "case",
        "runs",
        "keep all constraints",
        "cost",
        *(["regret", "worst regret"] if regret else ["worst cost"]),
        f"overshoot of {state}",
        "worst",
        "settles at step",
        "infeasible ticks",
        "solve p50 / p99 (ms)",
    ]
    body = []
    for result in results:
        times = "–"
        if result.timing is not None:
            spent = spread(result.timing)
            times = f"{spent.p50:.2g} / {spent.p99:.2g}"
        body.append(
            [
                result.label,
                str(len(result.rows)),
                f"{result.kept:.0%}",
                _number(result.median("cost")),
                *([_number(result.median("regret"))] if regret else []),
                _number(result.worst("regret" if regret else "cost")),
                _number(result.median("overshoot"), 2),
                _number(result.worst("overshoot"), 2),
                _settled(result),
                _number(result.median("infeasible_ticks")),
                times,
            ]
        )
    note = (
        "Cost, regret, overshoot, settling and infeasible ticks are medians over the runs; worst is the worst run. A "
        "negative overshoot is the distance that was never closed. A run settles when z and y stay within 0.02. An "
        "infeasible tick is one whose problem has no solution that keeps all tightened constraints, so that a soft one "
        "gave way. Solve times were measured alone, from the plant's own x0, once for every oracle, horizon, network "
        "and rate."
    )
    return Table(head, body, note)


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
    """The last sample of a run that is still off is none at which it has settled."""
    step = result.median("settling_step")
    return "not in time" if step >= result.case.steps else _number(step)


def _number(value: float, digits: int = 3) -> str:
    if not np.isfinite(value):
        return "lost"
    if value == round(value) and abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"
