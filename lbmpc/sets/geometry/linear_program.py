"""scipy's `linprog`, imported at the first linear program.

The import takes a third of a second. A controller whose sets are boxes solves no linear program, and a restarted
controller is down until all its imports are done.
"""

from __future__ import annotations

from typing import Any


def linprog(*arguments: Any, **options: Any) -> Any:
    """Call `scipy.optimize.linprog`."""
    from scipy.optimize import linprog as solve

    return solve(*arguments, **options)


def load() -> None:
    """Import scipy's solver now. Call it before a control loop that solves linear programs."""
    import scipy.optimize  # noqa: F401
