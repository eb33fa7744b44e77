"""What can be wrong with a log, in words for the person who has it."""

from __future__ import annotations


class LogError(Exception):
    """A log that cannot be written, read or replayed; the text says what, where and what to do."""


class LogExistsError(LogError):
    """The path is taken; a log never overwrites anything."""
