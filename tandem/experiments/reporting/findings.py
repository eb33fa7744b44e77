"""What the figures say, in words that follow from them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tandem.experiments.reporting.pictures import by_family, family_label, margins
from tandem.experiments.study.results import CaseResult, spread

CLEAR = 0.9
"""A difference counts when so many of the paired runs have its sign,"""
REGRET = 0.1
"""and the medians of the regret differ by this share of the reference's,"""
OVERSHOOT = 0.005
"""or those of the overshoot by this much."""
ENOUGH = 3
"""Fewer pairs say nothing."""


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
                own <= others[0] / 3,
                f"{own:.3g} against {others[0]:.3g}",
            ),
            Claim("and below L2NW's", own < others[1], f"{own:.3g} against {others[1]:.3g}"),
        ]
    kernel, network = paired(l2nw, dnn, "overshoot")
    slow, fast = paired(linear, dnn, "settling_step")
    found += [
        Claim(
            "Less overshoot than L2NW, for every seed",
            bool((network < kernel).all()),
            f"{dnn.median('overshoot'):.2g} in the median, {dnn.worst('overshoot'):.2g} at worst, against "
            f"{l2nw.values('overshoot').min():.2g}",
        ),
        Claim(
            "Faster than linear MPC, for every seed",
            bool((fast < slow).all()),
            f"settles at step {dnn.median('settling_step'):.0f} in the median, {dnn.worst('settling_step'):.0f} at "
            f"worst, against {linear.median('settling_step'):.0f}",
        ),
        Claim(
            "All true constraints kept by all three",
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
        said.append(f"keeps all constraints in {_kept(result)}, against {_kept(base)}")
    regret = "regret" if all(row.regret is not None for row in (*base.rows, *result.rows)) else "cost"
    for name, enough in ((regret, REGRET * abs(base.median(regret))), ("overshoot", OVERSHOOT)):
        own, other = paired(result, base, name)
        if not len(own):
            continue
        if name == "overshoot":
            # Below zero there is none, however far below.
            own, other = np.maximum(own, 0.0), np.maximum(other, 0.0)
        middle, others = float(np.median(own)), float(np.median(other))
        if not abs(middle - others) > enough:
            continue
        more = middle > others
        agree = int((own > other if more else own < other).sum())
        if agree >= CLEAR * len(own):
            pairs = f"all {agree}" if agree == len(own) else f"{agree} of {len(own)}"
            said.append(
                f"{'more' if more else 'less'} {name}, {_figure(middle)} against {_figure(others)} in the median "
                f"in {pairs} pairs of runs"
            )
    return said


def _figure(value: float) -> str:
    return "lost" if np.isinf(value) else f"{value:.3g}"


def _kept(result: CaseResult) -> str:
    return f"{sum(record.kept for record in result.records)} of {len(result.records)} runs"


def paired(result: CaseResult, base: CaseResult, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The figure of both for every seed and x0 that both have; rows that draw nothing stand for all seeds."""
    for_all_seeds = result.oracle != "dnn" and base.oracle == "dnn"

    def by_start(one: CaseResult) -> list[tuple[tuple[float, ...], float]]:
        starts = [tuple(row.x0) if for_all_seeds else (row.seed, *row.x0) for row in one.rows]
        return list(zip(starts, one.values(name), strict=True))

    own = dict(by_start(result))
    both = [(own[start], value) for start, value in by_start(base) if start in own]
    one, other = np.reshape(both, (-1, 2)).T
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
