"""The report: one HTML file that needs no other file and no network, from the results."""

from __future__ import annotations

import shlex
from collections import Counter
from importlib.resources import files
from typing import Any, NamedTuple

import jinja2
import msgspec
from markupsafe import Markup, escape

from lbmpc.plants import Description
from node_runtime import provenance
from node_runtime.config.loading import to_toml
from node_runtime.config.sections import Config
from run_log.reporting.canvas import PictureError, drawing
from tandem.experiments.reporting import findings, pictures, style, tables
from tandem.experiments.reporting.chart_figure import chart_figure
from tandem.experiments.reporting.charts import Chart, to_page
from tandem.experiments.study.declaration import Declaration, Group
from tandem.experiments.study.results import CaseResult


class Page(NamedTuple):
    html: str
    pictures: dict[str, bytes]
    """PNG by name, of all pictures that could be drawn."""


class Drawn(NamedTuple):
    """One picture on the page: a chart, or an image where `uri` is not empty, or a caption alone."""

    chart: str
    """JSON for the script of the page; empty if it is not a chart."""
    uri: str
    png: bytes
    """PNG; empty if the picture could not be drawn. The caption gives the reason."""
    caption: str
    alt: str


class Part(NamedTuple):
    """One group on the page."""

    group: Group
    command: str
    size: str
    ran: str
    headline: str
    runs: int
    kept: str
    claims: list[findings.Claim]
    pictures: list[Drawn]
    table: tables.Table
    comparisons: list[findings.Comparison]
    reference: str
    """The label of the case that the others are compared with."""
    words: list[str]


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
    """Return the whole report as HTML, and its pictures.

    Args:
        declared: the experiment.
        results: its cases, in order.
        plant: the controlled plant.
        base: the configuration before the changes of the cases.
        command: the command that made the results.
        code: version of the code, a hash.
        quick: whether the results are those of the short form.
        failed: number of failed runs, which are in no table.
    """
    by_group: dict[str, list[CaseResult]] = {}
    for result in results:
        by_group.setdefault(result.case.group, []).append(result)
    parts = [
        _part(group, by_group[group.name], plant, command)
        for group in declared.group
        if group.name in by_group
    ]
    claimed = [part for part in parts if part.claims]
    statements = list(dict.fromkeys(claim.statement for part in claimed for claim in part.claims))
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("tandem.experiments.reporting", ""),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"prose": _prose, "counted": findings.counted}
    html = environment.get_template("page.html.j2").render(
        declared=declared,
        parts=parts,
        claimed=claimed,
        statements=statements,
        verdicts=Counter(claim.verdict for part in claimed for claim in part.claims),
        enough=findings.ENOUGH,
        enough_solves=findings.ENOUGH_SOLVES,
        terms=tables.terms(plant),
        config=to_toml(base),
        machine=provenance.describe() | provenance.versions(provenance.SCIENCE),
        load=provenance.load(),
        command=command if len(parts) == len(declared.group) or len(parts) != 1 else parts[0].command,
        code=code,
        cases=len(results),
        runs=sum(len(result.rows) for result in results),
        quick=quick,
        failed=failed,
        arithmetics=sorted({row.arithmetic for result in results for row in result.rows}),
        style=_text("web/uPlot.min.css") + _text("experiments/reporting/page.css"),
        script=_text("web/uPlot.iife.min.js") + _text("experiments/reporting/page.js"),
    )
    return Page(html, {name: png for part in parts for name, png in _named_pictures(part)})


def _part(group: Group, results: list[CaseResult], plant: Description, command: str) -> Part:
    survival = group.picture == "survival"
    try:
        with drawing(f"the picture of {group.name}"):
            drawn = [_drawn(one) for one in pictures.draw(group.picture, results, plant, group.reference)]
    except PictureError as error:
        drawn = [Drawn("", "", b"", str(error), "")]
    records = [record for result in results for record in result.records]
    return Part(
        group=group,
        command=f"{command} --only {shlex.quote(group.name)}",
        size=tables.size(results),
        ran=tables.ran(results),
        headline=tables.headline(group, results),
        runs=len(records),
        kept=f"{sum(record.kept for record in records)} of {len(records)}",
        claims=findings.claims(results) if group.picture == "trajectories" else [],
        pictures=drawn,
        table=tables.survival_table(results, plant) if survival else tables.cases_table(results, plant),
        comparisons=[] if survival else findings.compare(results, group.reference),
        reference=next((result.label for result in results if result.case.name == group.reference), ""),
        words=findings.survival(results) if survival else findings.below_perfect(results),
    )


def _drawn(picture: pictures.Picture) -> Drawn:
    shown = picture.drawn
    if isinstance(shown, Chart):
        return Drawn(_json(to_page(shown)), "", style.png(chart_figure(shown)), picture.caption, picture.alt)
    png = style.png(shown)
    # The layout is known; computing it again would take as long as drawing.
    shown.set_layout_engine("none")
    return Drawn("", style.data_uri(shown), png, picture.caption, picture.alt)


def _named_pictures(part: Part) -> list[tuple[str, bytes]]:
    """(name, PNG): the name of the group, with a number from the second one on."""
    return [
        (part.group.name + (f"-{number}" if number > 1 else ""), drawn.png)
        for number, drawn in enumerate(part.pictures, 1)
        if drawn.png
    ]


def _json(values: Any) -> str:
    """Return JSON for a script element: no text in it can end the element."""
    return msgspec.json.encode(values).decode().replace("<", "\\u003c")


def _prose(text: str) -> Markup:
    """Return text of the experiment's file as HTML, with text in backticks as code."""
    code = Markup("<code>{}</code>").format
    parts = " ".join(text.split()).split("`")
    return Markup("").join(code(part) if i % 2 else escape(part) for i, part in enumerate(parts))


def _text(name: str) -> str:
    """Return a file of the package by its path below `tandem`."""
    return (files("tandem") / name).read_text("utf-8")
