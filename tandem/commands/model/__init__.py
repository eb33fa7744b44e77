"""`tandem model`: a plant file, started and looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import subcommand

from tandem.commands.model.check import ModelCheck
from tandem.commands.model.new import ModelNew


@dataclass(frozen=True, kw_only=True)
class ModelCommand:
    """A plant file: start one, and look at what is in it."""

    action: Annotated[ModelCheck, subcommand("check")] | Annotated[ModelNew, subcommand("new")]
