"""`tandem keys`: what it says of the certificates that it makes and finds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from node_runtime.config.sections import PLANT_NAME
from node_runtime.tls.credentials import WARN_DAYS
from protocol.rights import ROLES, rights_of
from tandem import certificate_authority, terminal
from tandem.certificate_authority import AUTHORITY_FOLDER, Issued
from tandem.terminal import Refused

PLANT = re.compile(PLANT_NAME)


def create(plant: str, hosts: Sequence[str], out: Path | None, days: int, as_json: bool) -> int:
    """Make them; 0."""
    if not PLANT.fullmatch(plant):
        raise Refused(f"--plant {plant}: at most 40 letters, digits, _ and -, as `name` in the configuration")
    folder = out or Path("keys") / plant
    made = certificate_authority.create(plant, hosts, folder, days)
    console = terminal.console(as_json)
    _show(made, as_json)
    router = next(one for one in made if one.role == "router")
    for text in (
        f"The router answers to {', '.join(router.hosts)}; --host adds others.",
        f"Each machine gets its own roles' folders and nothing else. {folder / AUTHORITY_FOLDER / 'key.pem'} can make "
        "any of these: it is needed to renew one and never to run, so keep it elsewhere.",
    ):
        console.print(text, markup=False, soft_wrap=True)
    return 0


def renew(
    roles: Sequence[str], folder: Path, hosts: Sequence[str], days: int, authority: Path | None, as_json: bool
) -> int:
    """Make some anew; 0."""
    for role in roles:
        if role not in ROLES:
            raise Refused(f"--role {role}: one of {', '.join(ROLES)}")
    if not roles:
        raise Refused(f"--role is missing: one of {', '.join(ROLES)}")
    console = terminal.console(as_json)
    renewed = []
    for role in roles:
        old, new = certificate_authority.renew(
            role, folder, hosts if role == "router" or len(roles) == 1 else [], days, authority
        )
        renewed.append(new)
        console.print(
            f"{new.folder}: valid until {new.valid_until:%Y-%m-%d}, was {old.valid_until:%Y-%m-%d}. Copy the folder to "
            f"the {role}'s machine and start the {role} again. The old certificate works until its end.",
            markup=False,
            soft_wrap=True,
        )
    if as_json:
        terminal.emit({"certificates": [_plain(one) for one in renewed]})
    return 0


def show(folder: Path, as_json: bool) -> int:
    """What there is; 0, or 1 when one has expired."""
    there = certificate_authority.found(folder)
    _show(there, as_json)
    return 1 if any(one.days_left < 0 for one in there) else 0


def _show(there: list[Issued], as_json: bool) -> None:
    console = terminal.console(as_json)
    for plant in dict.fromkeys(one.plant for one in there):
        table = Table(title=f"keys of {plant}", title_justify="left", show_lines=True)
        table.add_column("role", no_wrap=True)
        table.add_column("may", ratio=1)
        for head in ("valid until", "SHA-256"):
            table.add_column(head, no_wrap=True)
        for one in there:
            if one.plant == plant:
                table.add_row(*_row(one))
        console.print(table)
    for one in there:
        if one.days_left < WARN_DAYS:
            end = "has expired" if one.days_left < 0 else f"expires in {one.days_left:.0f} days"
            how = (
                f"`tandem keys renew --role {one.role}`"
                if one.role in ROLES
                else "`tandem keys create` again"
            )
            console.print(f"{one.folder}: {end}; {how}", style="yellow", markup=False, soft_wrap=True)
    if as_json:
        terminal.emit({"certificates": [_plain(one) for one in there]})


def _row(one: Issued) -> list[Text]:
    # As Text: in a plain string rich would take `:CD:` in a fingerprint for the name of a picture.
    end = Text(f"{one.valid_until:%Y-%m-%d}\n")
    end.append(f"{one.days_left:.0f} days", style="bold red" if one.days_left < WARN_DAYS else "")
    return [Text(one.role), Text("\n".join(_may(one.role))), end, Text(f"{one.fingerprint[:23]}…")]


def _may(role: str) -> list[str]:
    if role == AUTHORITY_FOLDER:
        return ["make certificates of all roles; may do nothing on the bus itself"]
    if role not in ROLES:
        return ["nothing: it is no role of ours"]
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
