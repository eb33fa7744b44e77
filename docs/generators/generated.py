"""The pages that are made from the code, by their place in the site."""

from __future__ import annotations

from collections.abc import Callable

from docs.generators import cli, configuration, messages

GENERATED: dict[str, Callable[[], str]] = {
    "reference/cli.md": cli.page,
    "reference/configuration.md": configuration.page,
    "reference/messages.md": messages.page,
}
