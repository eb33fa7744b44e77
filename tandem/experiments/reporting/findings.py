"""Verdicts and sentences of the report, derived from the rows of the results."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Literal, NamedTuple

import numpy as np

from tandem.experiments.reporting.families import by_family, family_label, places
from tandem.experiments.study.results import CaseResult, spread

ENOUGH = 5
"""Fewest pairs of runs for a verdict. With fewer, a sign test at 5 % cannot find a difference."""
ENOUGH_SOLVES = 500
"""Fewest timed solves for a verdict on a p99: five of them are slower than it."""
CLEAR = 0.9
"""A difference is clear when this share of the pairs has its sign."""
COST = 0.01
"""Smallest difference of the median J that counts, as a share of the reference's."""
OVERSHOOT = 0.02
"""Smallest difference of the median overshoot that counts, as a share of the initial deviation."""
BELOW = 0.001
"""A negative regret smaller than this counts as zero."""
NBSP = "\N{NO-BREAK SPACE}"
COMPARED = {"linear", "l2nw", "dnn"}
"""Oracles that the claims of the paper compare."""

Verdict = Literal["held", "not held", "not enough runs"]


class Claim(NamedTuple):
    """A claim of the paper, its verdict, and the figures behind it."""

    statement: str
    verdict: Verdict
    measured: str


class Comparison(NamedTuple):
    """A case compared with the reference of its group."""

    label: str
    verdict: Literal["differs", "no clear difference", "not enough runs"]
    pairs: int
    """Pairs of runs from the same start with the same seed."""
    seen: list[str]
    """The differences of the medians."""


def claims(results: list[CaseResult]) -> list[Claim]:
    """Check the claims of the paper on a group that has linear, l2nw and dnn; empty for any other group.

    A claim is about every seed. It is `held` if it is true in every pair of runs and there are at least `ENOUGH`
    pairs, `not held` if it is false in one pair, and `not enough runs` otherwise. A claim about solve times needs
    `ENOUGH_SOLVES` solves of each oracle.
    """
    by = {result.oracle: result for result in reversed(results)}
    if not by.keys() >= COMPARED:
        return []
    linear, l2nw, dnn = by["linear"], by["l2nw"], by["dnn"]
    found = []
    if not np.isnan(dnn.values("regret")).all():
        found += [
            _pairwise(
                "The regret of the network is at most a third of that of linear MPC",
                dnn,
                linear,
                "regret",
                lambda own, other: np.isfinite(own) & (own <= np.minimum(other / 3, other)),
            ),
            _pairwise("The regret of the network is less than that of L2NW", dnn, l2nw, "regret"),
        ]
    return [
        *found,
        _pairwise("The network overshoots less than L2NW", dnn, l2nw, "overshoot"),
        _pairwise("The network settles sooner than linear MPC", dnn, linear, "settled_s"),
        _constraints(linear, l2nw, dnn),
        *_times(linear, l2nw, dnn),
    ]


def verdict(true: int, of: int, enough: int = ENOUGH) -> Verdict:
    """Return the verdict on a claim that is true in `true` of `of` pairs of runs."""
    if true < of:
        return "not held"
    return "held" if of >= enough else "not enough runs"


def _pairwise(
    statement: str,
    dnn: CaseResult,
    base: CaseResult,
    name: str,
    is_true: Callable[[np.ndarray, np.ndarray], np.ndarray] = np.less,
) -> Claim:
    own, other = paired(dnn, base, name)
    true = int(is_true(own, other).sum())
    if not len(own):
        return Claim(statement, verdict(0, 0), "no pair of runs has this figure")
    measured = (
        f"true in {true} of {counted(len(own), 'pair')} of runs; network {_figure(name, float(np.median(own)))} in "
        f"the median, {_figure(name, float(own.max()))} at worst; {base.label} "
        f"{_figure(name, float(np.median(other)))} in the median"
    )
    return Claim(statement, verdict(true, len(own)), measured)


def _constraints(*compared: CaseResult) -> Claim:
    broken = sum(not record.kept for result in compared for record in result.records)
    seeds = len(compared[-1].rows)
    measured = "; ".join(f"{result.label} in {kept(result)} runs" for result in compared)
    return Claim(
        "Linear MPC, L2NW and the network keep all true constraints at all samples",
        "not held" if broken else verdict(seeds, seeds),
        measured,
    )


def _times(linear: CaseResult, l2nw: CaseResult, dnn: CaseResult) -> list[Claim]:
    if linear.timing is None or l2nw.timing is None or dnn.timing is None:
        return []
    timed = {result.label: result.timing for result in (linear, l2nw, dnn) if result.timing is not None}
    spreads = {name: spread(timing) for name, timing in timed.items()}
    solves = min(sum(len(run) for run in timing.runs) for timing in timed.values())
    period = dnn.case.config.period * 1e3
    own, kernel = spreads[dnn.label], spreads[l2nw.label]

    def claim(statement: str, true: bool, measured: str) -> Claim:
        said: Verdict = "not enough runs" if solves < ENOUGH_SOLVES else "held" if true else "not held"
        return Claim(statement, said, f"{measured}; {counted(solves, 'solve')} of each")

    return [
        claim(
            "The median solve time of the network is less than that of L2NW",
            own.p50 < kernel.p50,
            "; ".join(f"{name} {one.p50:.2g}{NBSP}ms" for name, one in spreads.items()),
        ),
        claim(
            "The p99 of the solve time of the network is less than that of L2NW",
            own.p99 < kernel.p99,
            "; ".join(f"{name} {one.p99:.2g}{NBSP}ms" for name, one in spreads.items()),
        ),
        claim(
            "The p99 of every solve time is less than the period",
            max(one.p99 for one in spreads.values()) < period,
            f"largest p99 {max(one.p99 for one in spreads.values()):.2g}{NBSP}ms; period {period:g}{NBSP}ms",
        ),
    ]


def compare(results: list[CaseResult], reference: str | None) -> list[Comparison]:
    """Compare each case with the reference; empty if the reference is not among the results."""
    base = next((result for result in results if result.case.name == reference), None)
    if base is None:
        return []
    return [_comparison(result, base) for result in results if result is not base]


def _comparison(result: CaseResult, base: CaseResult) -> Comparison:
    pairs, seen = len(paired(result, base, "J")[0]), _differences(result, base)
    # Where neither case draws at random, a run is exact and needs no repetition.
    if pairs < ENOUGH and (result.case.draws or base.case.draws):
        return Comparison(result.label, "not enough runs", pairs, seen)
    return Comparison(result.label, "differs" if seen else "no clear difference", pairs, seen)


def _differences(result: CaseResult, base: CaseResult) -> list[str]:
    said = []
    if abs(result.kept - base.kept) * min(len(result.rows), len(base.rows)) >= 1.5:
        said.append(f"keeps all constraints in {kept(result)} runs, against {kept(base)}")
    for name, enough in (("J", COST * abs(base.median("J"))), ("overshoot", OVERSHOOT)):
        own, other = paired(result, base, name)
        if not len(own):
            continue
        middle, others = float(np.median(own)), float(np.median(other))
        if not abs(middle - others) > enough:
            continue
        more = middle > others
        agree = int((own > other if more else own < other).sum())
        if agree >= CLEAR * len(own):
            where = "" if agree == len(own) else f" (in {agree} of {len(own)} pairs)"
            said.append(
                f"{'more' if more else 'less'} {name}, {_figure(name, middle)} against {_figure(name, others)}{where}"
            )
    return said


def below_perfect(results: list[CaseResult]) -> list[str]:
    """Return a sentence on the number of runs whose J is below that of the true h."""
    below = {
        result.label: values[values < -BELOW]
        for result in results
        if result.oracle != "perfect"
        for values in (result.values("regret"),)
        if (values < -BELOW).any()
    }
    if not below:
        return []
    runs = sum(len(values) for values in below.values())
    most = min(below, key=lambda label: below[label].min())
    return [
        f"J is below that of the true h in {counted(runs, 'run')} of {counted(len(below), 'case')}, by up to "
        f"{_figure('regret', -below[most].min())} ({most}). This is possible because the horizon is finite and the "
        "constraints are tightened, and because J weighs u from u_e although the plant may need another input to rest."
    ]


def survival(results: list[CaseResult]) -> list[str]:
    """Return for each family the largest number of kept runs with its value, and the number at the last value."""
    said = []
    for members in by_family(results).values():
        at, shares = places(members), [member.kept for member in members]
        best = max(i for i, share in enumerate(shares) if share == max(shares))
        text = f"{family_label(members[0])}: at most {kept(members[best])} runs kept"
        if shares[best] > 0.0:
            text += f", at {at[best]}"
        if best != len(at) - 1:
            text += f"; {kept(members[-1])} at {at[-1]}"
        said.append(f"{text}.")
    return said


def counted(number: int, noun: str) -> str:
    """ "1 run", "2 runs"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def kept(result: CaseResult) -> str:
    """Return the number of runs that keep all constraints at samples, such as "3 of 4"."""
    return f"{sum(record.kept for record in result.records)} of {len(result.records)}"


def paired(result: CaseResult, base: CaseResult, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return one figure of both cases for every pair of runs with the same seed and x0, without NaN; each (pairs,).

    A case that draws nothing at random has one run, which is paired with every seed of the other case.
    """
    same_seed = result.case.draws == base.case.draws

    def by_start(one: CaseResult) -> dict[tuple[float, ...], list[float]]:
        found: dict[tuple[float, ...], list[float]] = {}
        for row, value in zip(one.rows, one.values(name), strict=True):
            found.setdefault((row.seed if same_seed else 0, *row.x0), []).append(value)
        return found

    own, others = by_start(result), by_start(base)
    pairs = [pair for start in own for pair in product(own[start], others.get(start, []))]
    both = np.reshape(pairs, (-1, 2))
    one, other = both[~np.isnan(both).any(axis=1)].T
    return one, other


def _figure(name: str, value: float) -> str:
    if np.isinf(value):
        return "not settled" if name == "settled_s" else "lost"
    if name == "settled_s":
        return f"{value:.3g}{NBSP}s"
    return f"{value:.3g}" if name == "J" else f"{100 * value:.1f}{NBSP}%"
