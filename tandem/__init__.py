"""Learning-based model predictive control that learns while it runs.

    from tandem import Loop

    result = Loop("moore_greitzer", oracle="dnn").run(200)

`Loop` is imported on first use: a trainer's machine has no CasADi, and a controller's machine has no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tandem.loop import Loop, Result, Step

__all__ = ["Loop", "Result", "Step"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from tandem import loop

    return getattr(loop, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
