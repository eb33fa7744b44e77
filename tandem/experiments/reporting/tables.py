"""Tables of the report, and the sentences about the runs."""

from __future__ import annotations

from itertools import groupby
from typing import NamedTuple

import numpy as np

from lbmpc.plants import Description
from run_log.reporting.performance import SETTLED
from tandem.experiments.reporting.families import by_family, family_label, places, what_varies
from tandem.experiments.reporting.findings import NBSP, counted, kept
from tandem.experiments.study.declaration import Group
from tandem.experiments.study.results import CaseResult, spread

MISLEADS = 0.01
"""A median regret below minus this share shows that the true h does not have the smallest J."""
SETTINGS = 4
"""Largest number of run lengths that the sentence names; for more, it gives their number."""


class Column(NamedTuple):
    above: str
    """Heading over several columns; empty for a single column."""
    name: str
    cells: list[str]


class Table(NamedTuple):
    columns: list[Column]

    @property
    def heads(self) -> list[tuple[str, int]]:
        """The headings of the first row, and how many columns each spans."""
        found: list[tuple[str, int]] = []
        for above, columns in groupby(self.columns, key=lambda column: column.above):
            members = list(columns)
            found += [(above, len(members))] if above else [("", 1)] * len(members)
        return found

    @property
    def rows(self) -> list[tuple[str, ...]]:
        return list(zip(*(column.cells for column in self.columns), strict=True))


def cases_table(results: list[CaseResult], plant: Description) -> Table:
    """A row for each case: medians and worst cases over its runs."""
    regret = any(row.regret is not None for result in results for row in result.rows)
    several = any(result.case.episodes > 1 for result in results)
    timed = any(result.timing is not None for result in results)
    state = plant.states[plant.performance[0]]
    made = [
        Column("", "case", [result.label for result in results]),
        Column("", "runs", [str(len(result.rows)) for result in results]),
        Column("constraints", "kept in runs", [kept(result) for result in results]),
        Column(
            "constraints", "worst excess (%)", [_percent(r.worst("excess_between_samples")) for r in results]
        ),
    ]
    if several:
        made.append(Column("first episode", "J", [_number(r.median("J_first")) for r in results]))
        if regret:
            cells = [_percent(r.median("regret_first"), signed=True) for r in results]
            made.append(Column("first episode", "regret (%)", cells))
    later = "later episodes" if several else ""
    made.append(Column(later, "J", [_number(r.median("J")) for r in results]))
    if regret:
        for name, what in (("regret (%)", "median"), ("worst regret (%)", "worst")):
            cells = [_percent(getattr(r, what)("regret"), signed=True) for r in results]
            made.append(Column(later, name, cells))
    else:
        made.append(Column(later, "worst J", [_number(r.worst("J")) for r in results]))
    made.append(Column("", "deviation", [_number(r.median("deviation")) for r in results]))
    for name in ("median", "worst"):
        cells = [_percent(getattr(r, name)("overshoot")) for r in results]
        made.append(Column(f"overshoot of {state} (%)", name, cells))
    made.append(Column("", "settled (s)", [_settled(r) for r in results]))
    for name in ("iteration_limit", "soft", "fallback"):
        cells = [_number(r.median(f"{name}_ticks")) for r in results]
        made.append(Column("ticks", name.replace("_", " "), cells))
    if timed:
        spreads = [None if r.timing is None else spread(r.timing) for r in results]
        made += [
            Column(
                "solve time (ms)",
                name,
                ["–" if one is None else f"{getattr(one, name):.2g}" for one in spreads],
            )
            for name in ("p50", "p99")
        ]
    return Table([column for column in made if set(column.cells) != {"–"}])


def survival_table(results: list[CaseResult], plant: Description) -> Table:
    """A row for each family, a column for each value that varies: runs that keep all constraints."""
    families = by_family(results)
    first = next(iter(families.values()))
    made = [
        Column("", "case", [family_label(members[0]) for members in families.values()]),
        Column("", "runs each", [str(len(members[0].rows)) for members in families.values()]),
    ]
    above = f"runs that keep all constraints, by {what_varies(first, plant)}"
    for i, place in enumerate(places(first)):
        cells = [kept(members[i]) if i < len(members) else "–" for members in families.values()]
        made.append(Column(above, place, cells))
    return Table(made)


def size(results: list[CaseResult]) -> str:
    """Return a sentence on the number of cases and runs."""
    return f"{counted(len(results), 'case')}, {counted(sum(len(result.rows) for result in results), 'run')}"


def ran(results: list[CaseResult]) -> str:
    """Return sentences on cases, runs, seeds, initial states and lengths."""
    said = [f"{size(results)}."]
    drawing = [result for result in results if result.case.draws]
    if drawing:
        numbers = sorted({len(result.case.seeds) for result in drawing})
        seeds = sorted({seed for result in drawing for seed in result.case.seeds})
        many = " or ".join(map(str, numbers)) + (" seed" if numbers == [1] else " seeds")
        text = f"{many} ({_seeds(seeds)}) for each case that draws at random"
        if len(drawing) < len(results):
            text += ", one run for each initial state of the other cases"
        said.append(f"{text}.")
    else:
        said.append("No case draws at random: one run for each initial state is exact.")
    said.append(
        f"{counted(len({tuple(row.x0) for result in results for row in result.rows}), 'initial state')}."
    )
    lengths = list(dict.fromkeys(_length(result) for result in results))
    said.append(
        "; ".join(lengths) + "." if len(lengths) <= SETTINGS else f"{len(lengths)} different lengths of runs."
    )
    return " ".join(said)


def _length(result: CaseResult) -> str:
    case = result.case
    what = "episode" if case.set_points is None else "cycle"
    length = (
        f"{counted(case.steps, 'tick')} ({case.steps * case.config.period:g} s at {case.config.rate:g} Hz)"
    )
    return f"{counted(case.episodes, what)} of {length}" if case.episodes > 1 else length


def _seeds(seeds: list[int]) -> str:
    if len(seeds) > 2 and seeds == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    shown = ", ".join(map(str, seeds[:SETTINGS]))
    return shown if len(seeds) <= SETTINGS else f"{shown}, and {len(seeds) - SETTINGS} more"


def headline(group: Group, results: list[CaseResult]) -> str:
    """Return the result of a group in one line."""
    if group.picture == "survival":
        shares = {
            family_label(members[0]): (
                sum(record.kept for one in members for record in one.records),
                sum(len(one.records) for one in members),
            )
            for members in by_family(results).values()
        }
        shown = {name: (float(n), f"{n} of {of}") for name, (n, of) in shares.items()}
        return _extremes(shown, "runs that keep all constraints")
    if group.picture == "lemma":
        ratios = [
            float((found.accumulated / found.bound).max())
            for found in (record.lemma for result in results for record in result.records)
            if found is not None
        ]
        return f"largest ratio of the error sum to its bound: {max(ratios):.2g}" if ratios else "–"
    if len(results) == 1 and group.reference is None:
        return f"median J: {_number(results[0].median('J'))}"
    learned = [result for result in results if result.oracle != "perfect"]
    name = "regret" if any(row.regret is not None for result in results for row in result.rows) else "J"
    if name == "regret" and any(result.median("regret") < -MISLEADS for result in learned):
        # The true h does not give the smallest J here.
        name = "deviation"
    known = {r.label: r.median(name) for r in (learned if name == "regret" else results)}
    shown = {
        label: (
            value,
            f"{_percent(value)}{NBSP}%" if name == "regret" and np.isfinite(value) else _number(value),
        )
        for label, value in known.items()
        if not np.isnan(value)
    }
    return _extremes(shown, f"median {name}")


def _extremes(shown: dict[str, tuple[float, str]], what: str) -> str:
    """Name the lowest and the highest value. shown: (number, text) by name."""
    if not shown:
        return "–"
    low, high = min(shown, key=lambda name: shown[name][0]), max(shown, key=lambda name: shown[name][0])
    if len(shown) == 1:
        return f"{what}: {shown[low][1]} ({low})"
    if shown[low][0] == shown[high][0]:
        return f"{what}: {shown[low][1]} in every case"
    return f"{what}: lowest {shown[low][1]} ({low}), highest {shown[high][1]} ({high})"


def terms(plant: Description) -> list[tuple[str, str]]:
    """Explain the columns of the tables."""
    squares = " + ".join(f"Δ{plant.states[i]}²" for i in plant.performance)
    state = plant.states[plant.performance[0]]
    bands = [(plant.states[i], SETTLED * plant.x_scale[i]) for i in plant.performance]
    within = " and ".join(f"{name} within {band:g} {_unit(plant, name)}".rstrip() for name, band in bands)
    return [
        ("median, worst", "Statistic over the runs of the case. A column without either word is a median."),
        ("J", "Sum of the stage costs with the weights Q and R per second. With several episodes, the mean."),
        (
            "regret",
            "J above that of the true h from the same start with the same settings, in percent. It is negative where J "
            "is below.",
        ),
        (
            "kept in runs",
            "Runs in which the true plant is inside X and U at all samples, to within 1e-6 of a half-width.",
        ),
        (
            "worst excess",
            "Largest distance of the true motion from X in the worst run, between samples too, as a share of the "
            "half-width. – where it is not known.",
        ),
        ("deviation", f"Integral of {squares}. With several episodes, the mean from the second one on."),
        (
            "overshoot",
            f"How far {state} goes beyond its equilibrium, as a share of its initial deviation. With several episodes, "
            "the worst from the second one on.",
        ),
        (
            "settled",
            f"Seconds after which {within} of the equilibrium stay ({100 * SETTLED:g} % of the half-width).",
        ),
        (
            "ticks",
            "Iteration limit: ticks whose solve ended at the limit of iterations. Soft: ticks that needed slack in a "
            "soft constraint. Fallback: ticks whose input is not the solver's.",
        ),
        (
            "solve time",
            "Measured alone, from the plant's own x0, once for every oracle, horizon, network and rate.",
        ),
        ("lost", "The true motion could not be computed to the end of the run."),
    ]


def _unit(plant: Description, name: str) -> str:
    unit = plant.units.get(name, "")
    return "" if unit == "1" else unit


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
