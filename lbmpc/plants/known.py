"""What a controller knows of a plant: numbers, and no equations. They fit in a log, and a replay needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbmpc.plants.description import Description, as_array


@dataclass(frozen=True, eq=False, kw_only=True)
class Known(Description):
    """A linear model about (x_e, u_e), in deviations from there.

    In continuous time dx/dt = A x + B u; in discrete time x+ = A x + B u after every `period`, with u constant.
    """

    A: np.ndarray
    """(d, d)"""
    B: np.ndarray
    """(d, m)"""
    period: float | None = None
    """Seconds between two states of a discrete-time model; None: continuous time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("A", "B"):
            object.__setattr__(self, name, as_array(getattr(self, name)))

    def varied(self, **changes: float) -> Known:
        """Itself: it has no parameters. Raises `KeyError` where one is to change."""
        if changes:
            raise KeyError(
                f"{self.name} has no parameter {min(changes)!r}: it is numbers alone, without equations"
            )
        return self

    @classmethod
    def from_matrices(
        cls,
        A: Any,
        B: Any,
        *,
        W: Any,
        period: float | None = None,
        name: str = "plant",
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
        x_e: Any = None,
        u_e: Any = None,
        x_min: Any = None,
        x_max: Any = None,
        u_min: Any = None,
        u_max: Any = None,
        x0: Any = None,
        offset: Any = None,
        safe_input: Any = None,
        safe_gain: Any = None,
        performance: Sequence[int] | None = None,
        kernel: Sequence[str] | None = None,
        poles: Sequence[complex] | None = None,
        scale: Mapping[str, float] | None = None,
        names: Mapping[str, str] | None = None,
    ) -> Known:
        """A plant of which no more is known than a pair of matrices.

        Args:
            A, B: (d, d) and (d, m): dx/dt = A x + B u in deviations from (x_e, u_e), or x+ where there is a period.
            W: half-widths of what they do not know, per second, (d,).
            period: T in seconds of a discrete-time model; None: continuous time.
            name: of the plant.
            states, inputs: their names; x1, x2, .. and u1, u2, ..
            units: by name; '1' by default, and 's' for time.
            x_e, u_e: zeros by default.
            x_min, x_max, u_min, u_max: no bounds by default; then `scale` says what counts as 1.
            x0: x_e by default.
            offset: dx/dt, or x+ - x, at (x_e, u_e): a known constant bias, (d,). (x_e, u_e) moves to the nearest rest.
            safe_input: u_e by default.
            safe_gain, poles, scale, names: as the fields of those names.
            performance: all states by default.
            kernel: all states and inputs by default.
        """
        d, m = len(A), len(B[0])
        states = tuple(states or (f"x{i + 1}" for i in range(d)))
        inputs = tuple(inputs or (f"u{i + 1}" for i in range(m)))
        u_e = np.zeros(m) if u_e is None else u_e
        x_e = np.zeros(d) if x_e is None else x_e
        return cls(
            name=name,
            states=states,
            inputs=inputs,
            units={**dict.fromkeys((*states, *inputs), "1"), "t": "s", **(units or {})},
            x_e=x_e,
            u_e=u_e,
            x_min=np.full(d, -np.inf) if x_min is None else x_min,
            x_max=np.full(d, np.inf) if x_max is None else x_max,
            u_min=np.full(m, -np.inf) if u_min is None else u_min,
            u_max=np.full(m, np.inf) if u_max is None else u_max,
            W=W,
            x0=x_e if x0 is None else x0,
            safe_input=u_e if safe_input is None else safe_input,
            safe_gain=safe_gain,
            performance=tuple(range(d)) if performance is None else tuple(performance),
            kernel=tuple(kernel or (*states, *inputs)),
            poles=None if poles is None else tuple(poles),
            scale=scale or {},
            names=names or {},
            A=A,
            B=B,
            period=period,
        )
