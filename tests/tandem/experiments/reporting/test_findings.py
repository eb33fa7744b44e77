"""Verdicts of the report follow from the rows by rules, and too few runs give no verdict."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from tandem.experiments.reporting import families, findings
from tandem.experiments.study.results import CaseResult
from tests.tandem.experiments.made import a_result

LEARNS = "The regret of the network is at most a third of that of linear MPC"
KEEPS = "Linear MPC, L2NW and the network keep all true constraints at all samples"
MEDIAN = "The median solve time of the network is less than that of L2NW"
TAIL = "The p99 of the solve time of the network is less than that of L2NW"


def compared(costs: list[float], **changes: Any) -> dict[str, findings.Claim]:
    """Return the claims of a network with these J, by statement; linear MPC has a regret of 50 %."""
    others: list[CaseResult] = [
        a_result("linear MPC", [30.0], oracle="linear"),
        a_result("L2NW", [25.0], overshoot=0.4, oracle="l2nw"),
    ]
    return {
        claim.statement: claim for claim in findings.claims([*others, a_result("network", costs, **changes)])
    }


@pytest.mark.parametrize(("seeds", "verdict"), [(1, "not enough runs"), (4, "not enough runs"), (5, "held")])
def test_a_claim_is_held_from_five_seeds_on(seeds: int, verdict: str) -> None:
    claims = compared([21.0] * seeds)
    assert claims[LEARNS].verdict == verdict
    assert claims[KEEPS].verdict == verdict
    assert claims[LEARNS].measured.startswith(f"true in {seeds} of {findings.counted(seeds, 'pair')} of runs")
    assert f"network in {seeds} of {seeds} runs" in claims[KEEPS].measured


def test_one_seed_is_enough_against_a_claim() -> None:
    claims = compared([21.0] * 5 + [29.0])
    assert claims[LEARNS].verdict == "not held"
    assert claims[LEARNS].measured.startswith("true in 5 of 6 pairs of runs")
    assert compared([21.0], violations=1)[KEEPS].verdict == "not held"


def test_a_lost_run_is_against_a_claim() -> None:
    lost = a_result("network", [21.0] * 6, lost="at step 3")
    both = [
        a_result("linear MPC", [30.0], oracle="linear", lost="at step 3"),
        a_result("L2NW", [25.0], oracle="l2nw"),
    ]
    claims = {claim.statement: claim.verdict for claim in findings.claims([*both, lost])}
    assert claims[LEARNS] == "not held"


def timed(solves: int, network: list[float]) -> dict[str, str]:
    kernel = [2.0] * solves
    results = [
        a_result("linear MPC", [30.0], oracle="linear", solve_ms=[1.0] * solves),
        a_result("L2NW", [25.0], oracle="l2nw", solve_ms=kernel),
        a_result("network", [21.0] * 5, solve_ms=(network * solves)[:solves]),
    ]
    return {claim.statement: claim.verdict for claim in findings.claims(results)}


def test_a_slow_tail_affects_only_the_claim_about_the_p99() -> None:
    slow_tail = [1.0] * 19 + [9.0]
    assert timed(600, slow_tail)[MEDIAN] == "held"
    assert timed(600, slow_tail)[TAIL] == "not held"
    assert timed(600, [1.0])[TAIL] == "held"
    assert timed(600, [60.0])["The p99 of every solve time is less than the period"] == "not held"
    assert {timed(40, slow_tail)[claim] for claim in (MEDIAN, TAIL)} == {"not enough runs"}


def test_a_comparison_follows_from_the_figures() -> None:
    base = a_result("base", [21.0, 21.1, 21.2, 21.3, 21.4])
    others = [
        a_result("worse", [22.0, 22.1, 22.2, 22.3, 22.4]),
        a_result("same", [21.4, 21.3, 21.2, 21.0, 21.1]),
        a_result("breaks", [21.0, 21.1, 21.2, 21.3, 21.4], violations=3),
        a_result("few", [22.0, 22.1]),
    ]
    found = {one.label: one for one in findings.compare([base, *others], "base")}
    assert {label: one.verdict for label, one in found.items()} == {
        "worse": "differs",
        "same": "no clear difference",
        "breaks": "differs",
        "few": "not enough runs",
    }
    assert found["worse"].seen == ["more J, 22.2 against 21.2"]
    assert found["breaks"].seen == ["keeps all constraints in 0 of 5 runs, against 5 of 5"]
    assert (found["few"].pairs, found["few"].seen) == (2, ["more J, 22.1 against 21.1"])


def test_cases_that_draw_nothing_need_no_repetition() -> None:
    one, other = a_result("one", [22.0], oracle="linear"), a_result("other", [21.0], oracle="l2nw")
    assert findings.compare([one, other], "other")[0].verdict == "differs"


def test_regret_is_signed_and_a_page_names_cases_below_the_true_h() -> None:
    better, worse = a_result("better", [19.0, 23.0]), a_result("worse", [20.0, 21.0])
    assert better.values("regret") == pytest.approx([-0.05, 0.15])
    (said,) = findings.below_perfect([better, worse])
    assert said.startswith(
        "J is below that of the true h in 1 run of 1 case, by up to 5.0\N{NO-BREAK SPACE}% (better)."
    )
    assert findings.below_perfect([worse]) == []


def test_the_varied_value_of_a_family_need_not_be_a_number() -> None:
    members = [a_result(name, [21.0]) for name in ("a", "b")]
    members = [
        one._replace(case=msgspec.structs.replace(one.case, varied={"plant.truth": {"slope": value}}))
        for one, value in zip(members, (1.4, 1.6), strict=True)
    ]
    assert families.places(members) == ['{"slope":1.4}', '{"slope":1.6}']
    assert len(findings.survival(members)) == 1
