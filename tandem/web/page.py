"""The page of `tandem live` as one document: its parts and uPlot in one file, which loads nothing else."""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from importlib.resources import files

from tandem.web.server import Document

STYLES = ("uPlot.min.css", "live.css")
SCRIPTS = ("uPlot.iife.min.js", "live-socket.js", "live-plots.js", "live-page.js")


@cache
def page() -> Document:
    """Return the page, with a policy that lets it run its own script and connect to where it came from."""
    style = "\n".join(_read(name) for name in STYLES)
    script = "\n".join(_read(name) for name in SCRIPTS)
    html = _read("live.html").replace("/* styles */", style).replace("/* scripts */", script)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'"
    )
    return Document("text/html; charset=utf-8", html.encode(), policy)


def _read(name: str) -> str:
    return files("tandem.web").joinpath(name).read_text(encoding="utf-8")
