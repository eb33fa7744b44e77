"""Families: cases that differ in one value, such as the margin on the disturbance."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from lbmpc.plants import Description
from tandem.experiments.study.results import CaseResult


def by_family(results: list[CaseResult]) -> dict[str, list[CaseResult]]:
    """Group the cases that differ only in the last key that varies, by their common label."""
    families: dict[str, list[CaseResult]] = {}
    for result in results:
        families.setdefault(result.case.family, []).append(result)
    return families


def family_label(member: CaseResult) -> str:
    return member.case.family


def places(members: list[CaseResult]) -> list[str]:
    """Return the value that varies from member to member, as text: of lists, the entry that differs."""
    values: list[Any] = [[0.0, *member.case.varied.values()][-1] for member in members]
    entry = _entry(values)
    return [_shown(value if entry is None else value[entry]) for value in values]


def what_varies(members: list[CaseResult], plant: Description) -> str:
    """Return the name of the value that varies, for an axis."""
    if not members[0].case.varied:
        return "case"
    key, value = list(members[0].case.varied.items())[-1]
    name = key.rpartition(".")[2]
    entry = _entry([member.case.varied[key] for member in members])
    if entry is None:
        return name
    return f"{name} of {plant.states[entry]}" if len(value) == plant.d else f"{name}, entry {entry}"


def _entry(values: list[Any]) -> int | None:
    """Return the index at which lists of numbers differ most; None if the values are not such lists."""
    try:
        numbers = np.array(values, dtype=float)
    except (TypeError, ValueError):
        return None
    return int(np.argmax(np.ptp(numbers, axis=0))) if numbers.ndim == 2 and numbers.size else None


def _shown(value: Any) -> str:
    if isinstance(value, int | float):
        return f"{value:g}"
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()
