"""`tandem keys`: certificates for links that leave the machine."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg, subcommand

from tandem.commands.base import Command

ROLE = "router|plant|controller|trainer|recorder|operator"


@dataclass(frozen=True, kw_only=True)
class KeysCreate(Command):
    """Make a private authority for one plant, and with it one certificate a role."""

    plant: Annotated[str, arg(metavar="NAME")]
    """The plant's name, as `name` in the configuration."""
    host: Annotated[UseAppendAction[list[str]], arg(metavar="NAME|IP")] = field(default_factory=list)
    """A name or address under which other machines reach the router. May be given several times."""
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: keys/NAME)")] = None
    """Where they go; must not exist yet."""
    days: Annotated[int, arg(metavar="N")] = 365
    """How long the roles' certificates are valid; the authority's is for ten years."""

    def run(self) -> int:
        from tandem.commands import keys

        return keys.create(self.plant, self.host, self.out, self.days, self.json)


@dataclass(frozen=True, kw_only=True)
class KeysRenew(Command):
    """Make one role's key and certificate anew, from the authority that there is."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """The plant's folder: keys/NAME."""
    role: Annotated[UseAppendAction[list[str]], arg(metavar=ROLE)] = field(default_factory=list)
    """Whose. May be given several times."""
    host: Annotated[UseAppendAction[list[str]], arg(metavar="NAME|IP")] = field(default_factory=list)
    """A further name or address of the router."""
    authority: Annotated[
        Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: FOLDER/authority)")
    ] = None
    """Where the authority's certificate and key are, if they are kept elsewhere."""
    days: Annotated[int, arg(metavar="N")] = 365
    """How long it is valid."""

    def run(self) -> int:
        from tandem.commands import keys

        return keys.renew(self.role, self.folder, self.host, self.days, self.authority, self.json)


@dataclass(frozen=True, kw_only=True)
class KeysShow(Command):
    """Say what each certificate's holder may do, and until when. Exit code 1 when one has expired."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")] = Path("keys")
    """A role's folder, a plant's, or that of all plants."""

    def run(self) -> int:
        from tandem.commands import keys

        return keys.show(self.folder, self.json)


@dataclass(frozen=True, kw_only=True)
class KeysCommand:
    """Certificates for links that leave the machine: create, renew, show."""

    action: (
        Annotated[KeysCreate, subcommand("create")]
        | Annotated[KeysRenew, subcommand("renew")]
        | Annotated[KeysShow, subcommand("show")]
    )
