"""The page of `tandem live` in headless Chromium, with a real system whose processes restart."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from node_runtime.config.sections import Config
from tests.helpers.live import HANG_S, Process, free_endpoint, live_config, wait_for

pytest.importorskip("websockets", reason="pip install 'tandem-control[live]'")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine"),
]
MODULES = {
    "router": "node_runtime.router",
    "plant": "plant_sim.node",
    "controller": "controller_node.node",
    "live": "tandem.web.main",
}
ROWS = "streams.state.t.length"
COLOURED = """() => plots.filter((plot) => plot.visible).map(({u}) => {
  const {left, top, width, height} = u.bbox;
  const pixels = u.ctx.getImageData(left, top, width, height).data;
  let found = 0;
  for (let i = 0; i < pixels.length; i += 4) found += pixels[i + 3] > 0 && pixels[i] !== pixels[i + 2];
  return found;
})"""
"""Number of coloured pixels of each visible plot: lines and bounds."""


class System:
    """A running system whose processes can be restarted one by one."""

    def __init__(self, stack: ExitStack, config: Config):
        self._stack, self.config = stack, config
        self._running = {name: self._start(name) for name in MODULES}

    def _start(self, name: str) -> Process:
        return self._stack.enter_context(Process(MODULES[name], self.config))

    def restart(self, name: str) -> None:
        self._running[name].signal(signal.SIGKILL)
        self._running[name].end()
        self._running[name] = self._start(name)


@pytest.fixture
def system() -> Iterator[System]:
    port = free_endpoint().rpartition(":")[2]
    small = ("controller.horizon=20", "controller.oracle=constant", "controller.solver.compile=never")
    with ExitStack() as stack:
        yield System(stack, live_config(f"live.port={port}", *small))


@pytest.fixture
def page() -> Iterator[Any]:
    """A page that keeps its errors and its requests."""
    with playwright.sync_playwright() as chromium:
        browser = chromium.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        there = browser.new_page(viewport={"width": 1280, "height": 900})
        there.set_default_timeout(1000.0 * HANG_S)
        there.wrong, there.asked = [], []
        there.on("pageerror", lambda error: there.wrong.append(str(error)))
        there.on("request", lambda request: there.asked.append(request.url))
        yield there
        browser.close()


def until(page: Any, expression: str) -> None:
    """Wait until it is true. Playwright's own function needs eval, which the page's policy denies."""
    wait_for(lambda: page.evaluate(expression), every=0.1)


def plots_on(page: Any) -> None:
    """Wait until new data arrive and are drawn."""
    rows = page.evaluate(ROWS)
    until(page, f"{ROWS} > {rows} + 20")
    until(page, f"({COLOURED})().every((found) => found > 100)")


def test_it_plots_and_survives_a_restart_of_every_process(system: System, page: Any):
    at = f"http://localhost:{system.config.live.port}/"
    while True:
        try:
            page.goto(at)
            break
        except playwright.Error:  # the server is not running yet
            page.wait_for_timeout(200)
    until(page, "plots.length > 0")
    plots_on(page)
    assert page.inner_text("h1") == system.config.name
    titles = page.eval_on_selector_all("figcaption b", "all => all.map((one) => one.textContent)")
    assert titles == ["z", "y", "r", "rdot", "u", "tick", "h, z", "h, y", "h, r", "h, rdot"]

    # The legend has the newest values, of z: x0 is 0.15 and x_e is 0.5.
    read = page.eval_on_selector_all(
        "figure:first-child .u-value", "all => all.map((one) => one.textContent)"
    )
    target, measured = (float(text) for text in read[1:])
    assert target == 0.5
    assert 0.0 < measured < 1.0

    for name in ("controller", "plant"):
        system.restart(name)
        until(page, f'shared.marks.some(({{text}}) => text === "{name} restarted")')
        plots_on(page)
    system.restart("router")
    plots_on(page)
    system.restart("live")
    until(page, "!connected")
    until(page, "connected")
    plots_on(page)
    assert "controller running" in page.inner_text("#processes").replace("\n", " ")

    page.click("#pause")
    held = page.evaluate("plots[0].u.scales.x.max")
    plots_go_on_behind = page.evaluate(ROWS)
    until(page, f"{ROWS} > {plots_go_on_behind}")
    assert page.evaluate("plots[0].u.scales.x.max") == held
    page.click("#pause")
    until(page, f"plots[0].u.scales.x.max > {held}")

    for width, scheme in ((390, "dark"), (1280, "light")):
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size({"width": width, "height": 844})
        page.wait_for_timeout(500)
        assert page.evaluate("document.documentElement.scrollWidth") == width
        plots_on(page)
    assert page.wrong == []
    assert {url.partition("localhost")[0] for url in page.asked} == {"http://"}
