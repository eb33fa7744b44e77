"""What the figures say, in words that follow from them."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from tandem.experiments.reporting.pictures import by_family, family_label, margins
from tandem.experiments.study.results import CaseResult, spread

CLEAR = 0.9
"""A difference counts when so many of the paired runs have its sign,"""
COST = 0.01
"""and the medians of J differ by this share of the reference's,"""
OVERSHOOT = 0.02
"""or those of the overshoot by this share of the initial deviation."""
ENOUGH = 3
"""Fewer pairs say nothing."""
BELOW = 0.001
"""A regret that is negative by less than this is none."""


class Claim(NamedTuple):
    """Something the paper says, and whether the figures agree."""

    claim: str
    holds: bool
    measured: str


def claims(results: list[CaseResult]) -> list[Claim]:
    """The paper's, where the group has linear, l2nw and dnn."""
    by = {result.oracle: result for result in reversed(results)}
    if not {"linear", "l2nw", "dnn"} <= by.keys():
        return []
    linear, l2nw, dnn = by["linear"], by["l2nw"], by["dnn"]
    found = []
    if all(row.regret is not None for result in (linear, l2nw, dnn) for row in result.rows):
        own, others = dnn.median("regret"), (linear.median("regret"), l2nw.median("regret"))
        found += [
            Claim(
                "Learning is worth it: median regret of the network at most a third of linear MPC's",
                own <= min(others[0] / 3, others[0]),
                f"{own:.1%} against {others[0]:.1%}",
            ),
            Claim("and below L2NW's", own < others[1], f"{own:.1%} against {others[1]:.1%}"),
        ]
    kernel, network = paired(l2nw, dnn, "overshoot")
    slow, fast = paired(linear, dnn, "settled_s")
    found += [
        Claim(
            "Less overshoot than L2NW, for every seed",
            bool((network < kernel).all()),
            f"{dnn.median('overshoot'):.1%} in the median, {dnn.worst('overshoot'):.1%} at worst, against "
            f"{l2nw.values('overshoot').min():.1%}",
        ),
        Claim(
            "Faster than linear MPC, for every seed",
            bool((fast < slow).all()),
            f"settled after {_seconds(dnn.median('settled_s'))} in the median, {_seconds(dnn.worst('settled_s'))} at "
            f"worst, against {_seconds(linear.median('settled_s'))}",
        ),
        Claim(
            "All true constraints kept at samples by all three",
            min(linear.kept, l2nw.kept, dnn.kept) == 1.0,
            ", ".join(f"{r.label} {r.kept:.0%} of {len(r.rows)} runs" for r in (linear, l2nw, dnn)),
        ),
    ]
    if linear.timing and l2nw.timing and dnn.timing:
        times = {result.label: spread(result.timing) for result in (linear, l2nw, dnn) if result.timing}
        period = dnn.case.config.period * 1e3
        said = "; ".join(f"{name} {t.p50:.2g} / {t.p99:.2g} ms" for name, t in times.items())
        found.append(
            Claim(
                "A solve of the network takes less time than one of L2NW and fits in the period",
                times[dnn.label].p50 < times[l2nw.label].p50 and times[dnn.label].p99 < period,
                f"p50 / p99 of {said}; the period is {period:g} ms",
            )
        )
    return found


def compare(results: list[CaseResult], reference: str | None) -> list[str]:
    """One sentence for each case against the reference, then which matter and which do not."""
    known = [result for result in results if result.case.name == reference]
    if not known:
        return []
    base = known[0]
    if min(len(result.rows) for result in results) < ENOUGH and len(base.rows) < ENOUGH:
        return [f"Fewer than {ENOUGH} runs of a case do not show what matters."]
    found = [(result.label, _differences(result, base)) for result in results if result is not base]
    matter = [label for label, differences in found if differences]
    same = [label for label, differences in found if not differences]
    said = [f"Matters, against {base.label}: {', '.join(matter)}."] if matter else []
    said += [f"No clear difference from {base.label}: {', '.join(same)}."] if same else []
    return said + [f"{label}: {'; '.join(differences)}." for label, differences in found if differences]


def _differences(result: CaseResult, base: CaseResult) -> list[str]:
    said = []
    if abs(result.kept - base.kept) * min(len(result.rows), len(base.rows)) >= 1.5:
        said.append(f"keeps all constraints at samples in {_kept(result)}, against {_kept(base)}")
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
            pairs = f"all {agree}" if agree == len(own) else f"{agree} of {len(own)}"
            said.append(
                f"{'more' if more else 'less'} {name}, {_figure(name, middle)} against {_figure(name, others)} "
                f"in the median in {pairs} pairs of runs"
            )
    return said


def below_perfect(results: list[CaseResult]) -> list[str]:
    """Where something is better than the true h."""
    said = []
    for result in results:
        regret = result.values("regret")
        below = regret[regret < -BELOW]
        if below.size and result.oracle != "perfect":
            said.append(f"{result.label} in {below.size} of {regret.size} runs, by up to {-below.min():.1%}")
    if not said:
        return []
    return [
        f"J below that of the true h: {'; '.join(said)}. A finite horizon and tightening make that possible."
    ]


def _figure(name: str, value: float) -> str:
    if np.isinf(value):
        return "lost"
    return f"{value:.1%}" if name == "overshoot" else f"{value:.3g}"


def _seconds(value: float) -> str:
    return "never" if np.isinf(value) else f"{value:.3g} s"


def _kept(result: CaseResult) -> str:
    return f"{sum(record.kept for record in result.records)} of {len(result.records)} runs"


def paired(result: CaseResult, base: CaseResult, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The figure of both for every seed and x0 where both have it; a case that draws nothing stands for all seeds."""
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


def survival(results: list[CaseResult]) -> list[str]:
    """How many runs each family keeps at best, up to which margin, and what is left at the largest."""
    said = []
    for members in by_family(results).values():
        places, kept = margins(members), [member.kept for member in members]
        best = max(kept)
        held = max(place for place, share in zip(places, kept, strict=True) if share == best)
        text = f"{family_label(members[0])}: at best {best:.0%} of its runs"
        if best > 0.0:
            text += f", up to a margin of {held:g}"
        if held != places[-1]:
            text += f"; {kept[-1]:.0%} at {places[-1]:g}"
        said.append(f"{text}.")
    return said
