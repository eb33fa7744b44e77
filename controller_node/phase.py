"""The phase of a controller's slots after the plant's states, and the resulting delay of a command."""

from __future__ import annotations

import msgspec

from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError

LONGEST_PHASE = 0.5
"""Largest phase, as a share of a period."""
USUAL_PHASE, USUAL_PHASE_SHARE = 1e-3, 0.25
"""Default phase in seconds, and its limit as a share of a period."""
USUAL_ANSWER, USUAL_ANSWER_SHARE = 4e-3, 0.1
"""Default time from a slot until its command acts, in seconds, and its limit as a share of a period."""


def with_input_delay(config: Config) -> Config:
    """Return the configuration with a value for `controller.input_delay_ms`, so that the log contains it."""
    if config.controller.input_delay_ms is not None:
        return config
    usual = phase(config) + min(USUAL_ANSWER, USUAL_ANSWER_SHARE * config.period)
    delay_ms = min(usual, 0.5 * config.period) * 1e3
    settled = msgspec.structs.replace(config.controller, input_delay_ms=delay_ms)
    return msgspec.structs.replace(config, controller=settled)


def phase(config: Config) -> float:
    """Return the time of the slots after the arrival of the plant's states, in seconds."""
    given = config.controller.phase_ms
    return min(USUAL_PHASE, USUAL_PHASE_SHARE * config.period) if given is None else given * 1e-3


def check_phase(config: Config) -> None:
    """Raise `ConfigError` if the phase is too long."""
    longest = LONGEST_PHASE * config.period * 1e3
    if phase(config) * 1e3 > longest:
        raise ConfigError(
            f"controller.phase_ms = {config.controller.phase_ms} is more than {LONGEST_PHASE} of a period; "
            f"at rate = {config.rate} Hz at most {longest:g} ms"
        )
