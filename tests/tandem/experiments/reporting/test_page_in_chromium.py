"""The charts of the report in headless Chromium."""

from __future__ import annotations

import shutil
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from tandem.experiments.reporting.charts import Chart, Line, to_page
from tandem.experiments.reporting.page import _json

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine"),
]
WAIT_MS = 20_000
OFF = "setTimeout(() => document.querySelectorAll('.u-series th')[1].click(), 1)"


def a_page(chart: Chart) -> str:
    def text(name: str) -> str:
        return (files("tandem") / name).read_text("utf-8")

    script = text("web/uPlot.iife.min.js") + text("experiments/reporting/page.js")
    return (
        "<!doctype html><nav><details></details></nav><section><div class='chart'>"
        f"<script type='application/json'>{_json(to_page(chart))}</script></div></section><script>{script}</script>"
    )


@pytest.mark.parametrize("y", [np.zeros(5), np.arange(1.0, 6.0)], ids=["nothing above 0", "switched off"])
def test_a_logarithmic_chart_with_nothing_to_show_does_not_stop_the_page(
    tmp_path: Path, y: np.ndarray
) -> None:
    file = tmp_path / "page.html"
    line = Line("a", {"color": "#000000", "linestyle": "-"}, np.arange(5.0), y)
    file.write_text(a_page(Chart("t", "x", "y", [line], scale="log")))
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page()
        page.goto(file.as_uri(), timeout=WAIT_MS)
        page.evaluate(OFF)
        page.wait_for_selector(".u-series.u-off", state="attached", timeout=WAIT_MS)
        page.wait_for_function("() => document.querySelectorAll('canvas').length === 1", timeout=WAIT_MS)
        browser.close()
