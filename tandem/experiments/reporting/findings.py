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
            f"{dnn.median('overshoot'):.2g} in the median, {dnn.values('overshoot').max():.2g} at worst, against "
            f"{l2nw.values('overshoot').min():.2g}",
        ),
        Claim(
            "Faster than linear MPC, for every seed",
            bool((fast < slow).all()),
            f"settles at step {dnn.median('settling_step'):.0f} in the median, {dnn.values('settling_step').max():.0f} "
            f"at worst, against {linear.median('settling_step'):.0f}",
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
    base, matter, same, said = known[0], [], [], []
    if min(len(result.rows) for result in results) < ENOUGH and len(base.rows) < ENOUGH:
        return [f"Fewer than {ENOUGH} runs of a case do not show what matters."]
    for result in results:
        if result is base:
            continue
        differences = _differences(result, base)
        if differences:
            matter.append(result.label)
            said.append(f"{result.label}: {'; '.join(differences)}.")
        else:
            same.append(result.label)
    closing = []
    if matter:
        closing.append(f"Matters, against {base.label}: {', '.join(matter)}.")
    if same:
        closing.append(f"No clear difference from {base.label}: {', '.join(same)}.")
    return [*closing, *said]


def _differences(result: CaseResult, base: CaseResult) -> list[str]:
    said = []
    if abs(result.kept - base.kept) * min(len(result.rows), len(base.rows)) >= 1.5:
        said.append(f"keeps all constraints in {_kept(result)}, against {_kept(base)}")
    regret = "regret" if all(row.regret is not None for row in (*base.rows, *result.rows)) else "cost"
    for name, word, enough in (
        (regret, regret, REGRET * abs(base.median(regret))),
        ("overshoot", "overshoot", OVERSHOOT),
    ):
        own, other = paired(result, base, name)
        if not len(own):
            continue
        if name == "overshoot":
            # Below zero there is none, however far below.
            own, other = np.maximum(own, 0.0), np.maximum(other, 0.0)
        change = float(np.median(own)) - float(np.median(other))
        if not abs(change) > enough:
            continue
        agree = int((own > other).sum() if change > 0 else (own < other).sum())
        if agree >= CLEAR * len(own):
            more = "more" if change > 0 else "less"
            said.append(
                f"{more} {word}, {_figure(np.median(own))} against {_figure(np.median(other))} in the median "
                + (
                    f"in all {agree} pairs of runs"
                    if agree == len(own)
                    else f"in {agree} of {len(own)} pairs of runs"
                )
            )
    return said


def _figure(value: float) -> str:
    return "lost" if np.isinf(value) else f"{value:.3g}"


def _kept(result: CaseResult) -> str:
    return f"{sum(record.kept for record in result.records)} of {len(result.records)} runs"


def paired(result: CaseResult, base: CaseResult, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The figure of both for every seed and x0 that both have; rows that draw nothing stand for all seeds."""
    keys = [(row.seed, tuple(row.x0)) for row in base.rows]
    own = [(row.seed, tuple(row.x0)) for row in result.rows]
    one, other = result.values(name), base.values(name)
    if result.oracle != "dnn" and base.oracle == "dnn":
        by_x0 = {key[1]: value for key, value in zip(own, one, strict=True)}
        both = [(by_x0[key[1]], value) for key, value in zip(keys, other, strict=True) if key[1] in by_x0]
    else:
        table = dict(zip(own, one, strict=True))
        both = [(table[key], value) for key, value in zip(keys, other, strict=True) if key in table]
    return np.array([a for a, _ in both]), np.array([b for _, b in both])


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
