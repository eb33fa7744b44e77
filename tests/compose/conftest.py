"""A failed test shows the state of the containers and the end of their output."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.compose.project import Project


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    outcome = yield
    report = outcome.get_result()
    if not report.failed:
        return
    for name, value in getattr(item, "funcargs", {}).items():
        if isinstance(value, Project):
            report.sections.append((f"containers of {name}", value.last_words()))
