"""scipy's `linprog`, imported when the first linear program is solved.

The import takes a third of a second. A controller whose sets are boxes solves none, and one that died is away until it
has imported everything.
"""

from __future__ import annotations

from typing import Any


def linprog(*arguments: Any, **options: Any) -> Any:
    """`scipy.optimize.linprog`, see there."""
    from scipy.optimize import linprog as solve

    return solve(*arguments, **options)


def load() -> None:
    """Import it now: whoever solves in a control loop calls this before the loop."""
    import scipy.optimize  # noqa: F401
