"""Modules that read the wall clock."""

from __future__ import annotations

import ast
from fnmatch import fnmatch

from tests.helpers.paths import INSTALLED, ROOT

WALL_CLOCK = {"time", "time_ns", "localtime", "gmtime", "ctime", "now", "today", "utcnow"}
MAY_READ_IT = {
    "node_runtime/provenance.py run_info": "for people: when this process began",
    "controller_node/node.py _live": "the same",
    "run_log/writing/recorder.py main": "the log's beginning",
    "run_log/writing/recorder.py _record": "once, the offset of all times in the log",
    "node_runtime/tls/credentials.py *": "certificates end at a date",
    "tandem/certificate_authority.py *": "the same",
    "tandem/commands/keys.py *": "the same",
}


def test_only_the_listed_modules_read_the_wall_clock() -> None:
    """A step of the clock can change nothing else; `make faults` steps it."""
    found = set()
    for package in INSTALLED:
        for path in sorted((ROOT / package).rglob("*.py")):
            for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not isinstance(function, ast.FunctionDef):
                    continue
                for node in ast.walk(function):
                    if (
                        isinstance(node, ast.Attribute)
                        and node.attr in WALL_CLOCK
                        and isinstance(node.value, ast.Name)
                        and node.value.id in ("time", "datetime", "date")
                    ):
                        found.add(f"{path.relative_to(ROOT)} {function.name}")
    assert "run_log/writing/recorder.py _record" in found
    assert [place for place in found if not any(fnmatch(place, known) for known in MAY_READ_IT)] == []
