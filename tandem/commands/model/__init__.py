"""`tandem model`: start a plant file, and check it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import subcommand

from tandem.commands.model.check import ModelCheck
from tandem.commands.model.new import ModelNew


@dataclass(frozen=True, kw_only=True)
class ModelCommand:
    """Plant files: start one, and check one."""

    action: Annotated[ModelCheck, subcommand("check")] | Annotated[ModelNew, subcommand("new")]
