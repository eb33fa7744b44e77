"""The page: its texts follow from the rows, its plots have data, and it needs no other file."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from tandem.experiments import experiment
from tandem.experiments.reporting.chart_figure import chart_figure
from tandem.experiments.reporting.charts import Chart, Level, Line, of_runs, reduced, to_page
from tandem.experiments.reporting.page import page
from tandem.experiments.study.declaration import load
from tandem.experiments.study.results import CaseResult
from tandem.experiments.study.work import Traces
from tests.tandem.experiments.made import a_result
from tests.tandem.experiments.small import PLANT, SHIPPED

TRACES = Traces(x=[[0.1, 1.2], [0.3, 1.5], [0.5, 1.7]], u=[[1.0], [0.5]], error=[None, 0.1])
STRANGE = "network </script><b>"


class Parsed(HTMLParser):
    """Text, verdicts, links and chart data of the page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text, self.verdicts, self.links, self.charts = "", [], [], []
        self._inside = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        said = dict(attributes)
        self._inside = {"script": said.get("type") or "script", "style": "style"}.get(tag, "")
        if (said.get("class") or "").startswith("verdict"):
            self._inside = "verdict"
        self.links += [said[name] for name in ("src", "href") if name in said]

    def handle_data(self, data: str) -> None:
        if self._inside == "application/json":
            self.charts.append(json.loads(data))
        elif self._inside == "verdict":
            self.verdicts.append(data)
        if self._inside not in ("application/json", "script", "style"):
            self.text += data
        self._inside = ""


def of_group(result: CaseResult, group: str) -> CaseResult:
    return result._replace(case=msgspec.structs.replace(result.case, group=group))


def made(seeds: int, quick: bool, solves: int = 40) -> Parsed:
    """Return the page of the paper's comparison with this number of seeds of the network."""
    traced = {"traces": TRACES, "solve_ms": [1.0] * solves}
    results = [
        a_result("linear MPC", [30.0], oracle="linear", **traced),
        a_result("L2NW", [25.0], overshoot=0.4, oracle="l2nw", **traced),
        a_result(STRANGE, [21.0 + 0.1 * seed for seed in range(seeds)], **traced),
    ]
    declared = load(SHIPPED)
    base = experiment.settings(declared, str(SHIPPED))
    command = "tandem experiment paper --out DIR" + (" --quick" if quick else "")
    results = [of_group(result, "comparison") for result in results]
    return Parsed(page(declared, results, PLANT, base, command, "f" * 64, quick).html)


@pytest.fixture(scope="module")
def quick() -> Parsed:
    return made(1, quick=True)


@pytest.fixture(scope="module")
def full() -> Parsed:
    return made(20, quick=False, solves=600)


def test_a_page_of_one_seed_gives_no_verdict(quick: Parsed) -> None:
    assert "held" not in quick.verdicts
    assert quick.verdicts.count("not enough runs") >= 8
    assert "no basis for conclusions" in quick.text
    assert "1 seed (0)" in quick.text
    for word in ("20 seeds", "10 seeds", "every seed of", "holds"):
        assert word not in quick.text


def test_a_page_of_many_seeds_has_their_number_and_verdicts(full: Parsed) -> None:
    assert "20 seeds (0 to 19)" in full.text
    assert {"held", "not held"} <= set(full.verdicts)
    assert "not enough runs" not in full.verdicts
    assert "no basis for conclusions" not in full.text


def test_the_table_of_claims_has_the_verdicts_of_the_sections(full: Parsed) -> None:
    half = len(full.verdicts) // 2
    assert full.verdicts[:half] == full.verdicts[half:]


def test_every_plot_has_data_and_units_on_its_axes(full: Parsed) -> None:
    assert [chart["title"] for chart in full.charts] == ["Mass flow z", "Pressure rise y", "Solve time"]
    for chart in full.charts:
        assert chart["xLabel"] == "time (s)"
        assert "(" in chart["yLabel"]
        assert len(chart["lines"]) == 3
        assert all(later > earlier for earlier, later in pairwise(chart["x"]))
        for line in chart["lines"]:
            assert len(line["y"]) == len(chart["x"])
            assert any(value is not None for value in line["y"])


def test_every_table_has_its_command(quick: Parsed) -> None:
    assert "tandem experiment paper --out DIR --quick --only comparison" in quick.text
    assert "3 cases, 3 runs, made by" in quick.text


def test_the_page_needs_no_other_file_and_no_name_ends_its_script(quick: Parsed) -> None:
    assert all(link.startswith(("#", "data:")) for link in quick.links)
    assert [line["name"] for line in quick.charts[0]["lines"]][-1] == STRANGE
    assert STRANGE in quick.text


def test_a_plot_without_a_line_is_words_and_the_others_are_drawn() -> None:
    result = a_result(
        "linear MPC", [30.0], oracle="linear", traces=TRACES, solve_ms=[1.0] * 40, lost="left X"
    )
    declared = load(SHIPPED)
    base = experiment.settings(declared, str(SHIPPED))
    found = Parsed(
        page(declared, [of_group(result, "comparison")], PLANT, base, "tandem", "f" * 64, False).html
    )
    assert [chart["title"] for chart in found.charts] == ["Solve time"]
    assert found.text.count("There is no line to draw.") == 2


def test_timed_runs_of_different_lengths_share_a_line() -> None:
    result = a_result("network", [30.0])
    line = of_runs(result, {"color": "#000000"}, [np.arange(5.0), np.arange(3.0)])
    assert line is not None
    assert line.y.tolist() == [0.0, 1.0, 2.0]


def a_line(n: int) -> Line:
    y = np.sin(np.linspace(0, 40, n))
    y[n // 3] = 9.0
    return Line("a", {"color": "#000000", "linestyle": "-"}, np.arange(n) * 0.01, y, y - 1.0, y + 1.0, 5)


def test_a_long_line_keeps_its_extremes() -> None:
    line = a_line(20_000)
    few = reduced(line, 1000)
    assert len(few.x) <= 1000
    assert (few.y.min(), few.y.max()) == (line.y.min(), line.y.max())
    assert few.low is not None
    assert few.high is not None
    assert (few.low.min(), few.high.max()) == (line.y.min() - 1.0, 10.0)
    assert (few.x[0], few.x[-1]) == (line.x[0], line.x[-1])
    assert reduced(a_line(900), 1000).y is not None
    np.testing.assert_array_equal(reduced(a_line(900), 1000).y, a_line(900).y)


def test_lines_of_two_periods_share_an_axis() -> None:
    look: dict[str, Any] = {"color": "#000000", "linestyle": (0, (5, 1.5))}
    fast, slow = (Line(str(n), look, np.linspace(0, 1, n), np.full(n, n)) for n in (5, 3))
    told = to_page(Chart("t", "time (s)", "y (m)", [fast, slow]))
    assert told["x"] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert [line["y"] for line in told["lines"]] == [[5.0] * 5, [3.0, None, 3.0, None, 3.0]]
    assert told["lines"][0]["dash"] == [10.0, 3.0]


def test_a_picture_of_regrets_ends_near_its_data() -> None:
    x = np.array([1.0, 2.0])
    lines = [
        Line("a", {"color": "C0"}, x, np.array([90.0, 90.0])),
        Line("b", {"color": "C1"}, x, np.array([8.0, 1.0])),
    ]
    drawn = chart_figure(
        Chart("t", "x", "y", lines, scale="asinh", linear_up_to=2.0, levels=(Level(0.0, "zero"),))
    )
    low, _high = drawn.axes[0].get_ylim()
    assert -0.6 < low < 0.0


def test_zero_has_no_place_on_a_logarithmic_axis() -> None:
    line = Line("a", {"color": "#000000", "linestyle": "-"}, np.arange(3.0), np.array([0.0, 1.0, np.nan]))
    (shown,) = to_page(Chart("t", "x", "y", [line], scale="log"))["lines"]
    assert shown["y"] == [None, 1.0, None]
