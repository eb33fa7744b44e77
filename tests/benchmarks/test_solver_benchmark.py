"""The benchmark's figures: their names, and the correctness of the timed work. No test checks a time."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from benchmarks.solver import reporting
from benchmarks.solver.__main__ import Benchmark, main
from benchmarks.solver.measure import Report, Scope, measure
from benchmarks.solver.recording import build_case, record

KEYS = {
    "solver",
    "mode",
    "oracle",
    "N",
    "width",
    "median_ms",
    "p99_ms",
    "error",
    "max_ms",
    "iterations",
    "compiled",
}
TINY = Scope(
    ticks=5,
    rounds=1,
    horizons=(10,),
    widths=(32,),
    rival_horizons=(10,),
    rival_every=2,
    compile=False,
    memory=False,
    centre=10,
)


@pytest.fixture(scope="module")
def report() -> Report:
    return measure(TINY)


def test_rows_have_the_documented_keys(report: Report) -> None:
    assert report.rows
    for row in report.rows:
        assert set(msgspec.to_builtins(row)) >= KEYS
        assert 0 < row.median_ms <= row.p99_ms <= row.max_ms


def test_every_candidate_has_rows(report: Report) -> None:
    for oracle in ("linear", "constant", "l2nw", "dnn"):
        for mode in ("converged", "preparation", "feedback", "tick", "real_time_tick"):
            assert report.find("tandem", mode, oracle, 10, 32 if oracle == "dnn" else None, False), (
                oracle,
                mode,
            )
    for solver in ("ipopt", "ipopt-hard", "ipopt-hard-gauss-newton", "sqpmethod-daqp", "sqpmethod-qrqp"):
        assert report.find(solver, "converged", "dnn", 10, 32, False), solver
    assert report.find("ipopt-hard", "converged", "linear", 10, None, False)


def test_converged_solvers_agree_on_the_optimum(report: Report) -> None:
    converged = [row for row in report.rows if row.mode in ("converged", "tick")]
    assert {row.solver for row in converged} >= {"tandem", "ipopt", "sqpmethod-daqp"}
    for row in converged:
        assert row.error < 1e-6, row
        assert row.failures == 0, row


def test_a_real_time_iteration_is_close_to_the_optimum(report: Report) -> None:
    for oracle in ("linear", "dnn"):
        row = report.find("tandem", "feedback", oracle, 10, 32 if oracle == "dnn" else None, False)
        assert row is not None
        assert row.error < 1e-4
        assert row.failures == 0


def test_the_recorded_states_are_reproducible() -> None:
    one, two = record(4), record(4)
    assert [x.tobytes() for x in one.x] == [x.tobytes() for x in two.x]
    cases = [build_case(recording, "dnn", 10, 16, lambda function: function) for recording in (one, two)]
    assert cases[0].tight[-1].v.tobytes() == cases[1].tight[-1].v.tobytes()


def test_ratios_are_of_medians(report: Report) -> None:
    found = reporting.ratios(report, N=10)
    ours = report.find("tandem", "converged", "dnn", 10, 32, False)
    ipopt = report.find("ipopt", "converged", "dnn", 10, 32, False)
    assert ours is not None
    assert ipopt is not None
    assert found["ipopt / converged, both dnn"] == pytest.approx(ipopt.median_ms / ours.median_ms)
    assert {"dnn / linear, converged", "dnn / linear, real-time iteration"} <= found.keys()


def test_text_outside_the_marks_does_not_change(report: Report, tmp_path: Path) -> None:
    path = tmp_path / "performance.md"
    path.write_text(f"before\n{reporting.MARKS.begin}\nlast year's\n{reporting.MARKS.end}\nafter\n")
    for _ in range(2):
        picture = reporting.write(report, path, "python -m benchmarks.solver")
    text = path.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "last year's" not in text
    assert text.count("| tandem | feedback | dnn | 10 |") == 1
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_document_without_marks_is_refused_before_the_measurement(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "benchmarks.solver.__main__.measure", lambda *_: pytest.fail("measured before the check")
    )
    path = tmp_path / "notes.md"
    path.write_text("nothing here\n")
    assert main(Benchmark(document=path)) == 2
    assert "two lines that it lacks" in " ".join(capsys.readouterr().err.split())
    assert path.read_text() == "nothing here\n"


def test_the_command_prints_one_json_object(
    report: Report, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("benchmarks.solver.__main__.measure", lambda *_: report)
    assert main(Benchmark(quick=True, json=True)) == 0
    printed = json.loads(capsys.readouterr().out)
    assert len(printed["rows"]) == len(report.rows)
    assert set(printed["rows"][0]) >= KEYS
    assert set(printed) >= {"ratios", "machine", "versions", "memory_mb", "notes"}
