"""Errors of logs, with messages for a person."""

from __future__ import annotations


class LogError(Exception):
    """A log that cannot be written, read or replayed; the text says what, where and what to do."""


class LogExistsError(LogError):
    """The path exists already; a log never overwrites a file."""
