"""When a controller's slots lie: how long behind the plant's states, and which delay of a command that makes."""

from __future__ import annotations

import msgspec

from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError

LONGEST_PHASE = 0.5
"""Of a period."""
USUAL_PHASE, USUAL_PHASE_SHARE = 1e-3, 0.25
"""Seconds, and share of a period at most."""
USUAL_ANSWER, USUAL_ANSWER_SHARE = 4e-3, 0.1
"""Likewise, from a slot until its command acts."""


def with_input_delay(config: Config) -> Config:
    """The configuration with `controller.input_delay_ms` settled, so that the log says what was in force."""
    if config.controller.input_delay_ms is not None:
        return config
    usual = phase(config) + min(USUAL_ANSWER, USUAL_ANSWER_SHARE * config.period)
    delay_ms = min(usual, 0.5 * config.period) * 1e3
    settled = msgspec.structs.replace(config.controller, input_delay_ms=delay_ms)
    return msgspec.structs.replace(config, controller=settled)


def phase(config: Config) -> float:
    """How far, in seconds, the slots lie behind the arrival of the plant's states."""
    given = config.controller.phase_ms
    return min(USUAL_PHASE, USUAL_PHASE_SHARE * config.period) if given is None else given * 1e-3


def check_phase(config: Config) -> None:
    """Raises `ConfigError`: it is too long."""
    longest = LONGEST_PHASE * config.period * 1e3
    if phase(config) * 1e3 > longest:
        raise ConfigError(
            f"controller.phase_ms = {config.controller.phase_ms} is more than {LONGEST_PHASE} of a period; "
            f"at rate = {config.rate} Hz at most {longest:g} ms"
        )
