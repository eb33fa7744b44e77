"""`tandem keys`: certificates for links that leave the machine."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg, subcommand

from tandem.commands.base import Command
from tandem.terminal import Refused

if TYPE_CHECKING:
    from rich.text import Text

    from tandem.certificate_authority import Issued

ROLE = "router|plant|controller|trainer|recorder|viewer|commander"


class Shows(Command):
    """A command that shows certificates."""

    def _show(self, there: list[Issued]) -> None:
        from rich.table import Table

        from node_runtime.tls.credentials import WARN_DAYS
        from protocol.rights import ROLES

        for plant in dict.fromkeys(one.plant for one in there):
            table = Table(title=f"keys of {plant}", title_justify="left", show_lines=True)
            table.add_column("role", no_wrap=True)
            table.add_column("may", ratio=1)
            for head in ("valid until", "SHA-256"):
                table.add_column(head, no_wrap=True)
            for one in there:
                if one.plant == plant:
                    table.add_row(*_row(one))
            self.console.print(table)
        for one in there:
            if one.days_left < WARN_DAYS:
                end = "has expired" if one.days_left < 0 else f"expires in {one.days_left:.0f} days"
                how = (
                    f"`tandem keys renew --role {one.role}`"
                    if one.role in ROLES
                    else "`tandem keys create` again"
                )
                self.say(f"{one.folder}: {end}; {how}", style="yellow")
        self.emit({"certificates": [_plain(one) for one in there]})


@dataclass(frozen=True, kw_only=True)
class KeysCreate(Shows):
    """Create a private authority for one plant, and one certificate for each role."""

    plant: Annotated[str, arg(metavar="NAME")]
    """The plant's name, as `name` in the configuration."""
    host: Annotated[UseAppendAction[list[str]], arg(metavar="NAME|IP")] = field(default_factory=list)
    """A name or address under which other machines reach the router. May be given several times."""
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: keys/NAME)")] = None
    """Folder for them; must not exist yet."""
    days: Annotated[int, arg(metavar="N")] = 365
    """Validity of the roles' certificates in days; the authority's is ten years."""

    def run(self) -> int:
        from node_runtime.config.sections import PLANT_NAME
        from tandem import certificate_authority

        if not re.fullmatch(PLANT_NAME, self.plant):
            raise Refused(
                f"--plant {self.plant}: at most 40 letters, digits, _ and -, as `name` in the configuration"
            )
        folder = self.out or Path("keys") / self.plant
        made = certificate_authority.create(self.plant, self.host, folder, self.days)
        self._show(made)
        router = next(one for one in made if one.role == "router")
        authority_key = folder / certificate_authority.AUTHORITY_FOLDER / "key.pem"
        self.say(
            f"The router's certificate is valid for {', '.join(router.hosts)}; --host adds others.",
            f"Copy to each machine only the folders of its own roles. Anyone who holds {authority_key} can issue "
            "certificates. It is needed only to renew them, so keep it elsewhere.",
        )
        return 0


@dataclass(frozen=True, kw_only=True)
class KeysRenew(Command):
    """Create one role's key and certificate again, or for the first time, with the existing authority."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """The plant's folder: keys/NAME."""
    role: Annotated[UseAppendAction[list[str]], arg(metavar=ROLE)] = field(default_factory=list)
    """The role. May be given several times."""
    host: Annotated[UseAppendAction[list[str]], arg(metavar="NAME|IP")] = field(default_factory=list)
    """Another name or address of the router."""
    authority: Annotated[
        Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: FOLDER/authority)")
    ] = None
    """Folder of the authority's certificate and key, if they are elsewhere."""
    days: Annotated[int, arg(metavar="N")] = 365
    """Validity of the certificate in days."""

    def run(self) -> int:
        from protocol.rights import ROLES
        from tandem import certificate_authority

        for role in self.role:
            if role not in ROLES:
                raise Refused(f"--role {role}: choose one of {', '.join(ROLES)}")
        if not self.role:
            raise Refused(f"--role is missing: choose one of {', '.join(ROLES)}")
        renewed = []
        for role in self.role:
            hosts = self.host if role == "router" or len(self.role) == 1 else []
            old, new = certificate_authority.renew(role, self.folder, hosts, self.days, self.authority)
            renewed.append(new)
            was = "" if old is None else f", was {old.valid_until:%Y-%m-%d}"
            still = "" if old is None else " The old certificate remains valid until it expires."
            self.say(
                f"{new.folder}: valid until {new.valid_until:%Y-%m-%d}{was}. Copy the folder to the {role}'s machine "
                f"and restart the {role}.{still}",
            )
        self.emit({"certificates": [_plain(one) for one in renewed]})
        return 0


@dataclass(frozen=True, kw_only=True)
class KeysShow(Shows):
    """Print what each certificate's holder may do, and until when. Exit code 1 if one has expired."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")] = Path("keys")
    """A role's folder, a plant's, or that of all plants."""

    def run(self) -> int:
        """Return 0, or 1 if one has expired."""
        from tandem import certificate_authority

        there = certificate_authority.found(self.folder)
        self._show(there)
        return 1 if any(one.days_left < 0 for one in there) else 0


@dataclass(frozen=True, kw_only=True)
class KeysCommand:
    """Certificates for links that leave the machine: create, renew, show."""

    action: (
        Annotated[KeysCreate, subcommand("create")]
        | Annotated[KeysRenew, subcommand("renew")]
        | Annotated[KeysShow, subcommand("show")]
    )


def _row(one: Issued) -> list[str | Text]:
    from rich.text import Text

    from node_runtime.tls.credentials import WARN_DAYS

    end = Text(f"{one.valid_until:%Y-%m-%d}\n")
    end.append(f"{one.days_left:.0f} days", style="bold red" if one.days_left < WARN_DAYS else "")
    return [one.role, "\n".join(_may(one.role)), end, f"{one.fingerprint[:23]}…"]


def _may(role: str) -> list[str]:
    from protocol.rights import ROLES, rights_of
    from tandem.certificate_authority import AUTHORITY_FOLDER

    if role == AUTHORITY_FOLDER:
        return ["issue certificates of all roles; no rights on the bus"]
    if role not in ROLES:
        return ["nothing: not a role of this version"]
    rights = rights_of(role)
    own = ", ".join(topic.name.removeprefix(f"{role}/") for topic in rights.publishes)
    reads = "everything" if rights.reads_all else ", ".join(topic.name for topic in rights.reads)
    parts = {
        "publish": own and f"{role}/ {own}",
        "read": reads,
        "ask": ", ".join(rights.asks),
        "answer": ", ".join(rights.answers),
    }
    return [f"{verb} {what}" for verb, what in parts.items() if what]


def _plain(one: Issued) -> dict[str, Any]:
    from protocol.rights import ROLES, rights_of

    plain: dict[str, Any] = {
        "role": one.role,
        "plant": one.plant,
        "folder": str(one.folder),
        "valid_until": one.valid_until.isoformat(),
        "days_left": round(one.days_left, 1),
        "fingerprint": one.fingerprint,
        "hosts": one.hosts,
    }
    if one.role in ROLES:
        rights = rights_of(one.role)
        plain["publishes"] = rights.publish_keys(one.plant)
        plain["reads"] = rights.read_keys(one.plant)
        plain["asks"] = rights.ask_keys(one.plant)
        plain["answers"] = rights.answer_keys(one.plant)
    return plain
