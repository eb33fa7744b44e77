"""One process's certificate: where it lies, and whether it can be used, said before anybody is asked.

A folder holds `certificate.pem`, its `key.pem`, and `authority.pem`, the certificate that others' are checked with.
`tandem keys create` makes such a folder for every role.
"""

from __future__ import annotations

import stat
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import NameOID

from node_runtime.config.strict import ConfigError
from node_runtime.whole_file import read_regular
from protocol.rights import common_name

CERTIFICATE = "certificate.pem"
KEY = "key.pem"
AUTHORITY = "authority.pem"
WARN_DAYS = 30


@dataclass(frozen=True)
class Credentials:
    """A folder whose three files fit each other."""

    folder: Path
    name: str
    """The certificate's common name: `trainer.jet1`."""
    not_before: datetime
    not_after: datetime

    @property
    def certificate(self) -> Path:
        return self.folder / CERTIFICATE

    @property
    def key(self) -> Path:
        return self.folder / KEY

    @property
    def authority(self) -> Path:
        return self.folder / AUTHORITY

    def days_left(self) -> float:
        """Days until it expires, negative afterwards."""
        return (self.not_after - datetime.now(UTC)).total_seconds() / 86400.0

    def expired(self) -> str | None:
        """Why the certificate is not valid now, or None."""
        now = datetime.now(UTC)
        if now > self.not_after:
            return (
                f"{self.certificate}: expired on {self.not_after:%Y-%m-%d %H:%M} UTC. "
                f"Make a new one: `tandem keys renew --role {self.role}` where the authority is, and copy its folder"
            )
        if now < self.not_before:
            return (
                f"{self.certificate}: not valid before {self.not_before:%Y-%m-%d %H:%M} UTC; "
                f"it is {now:%Y-%m-%d %H:%M} here. Is the clock right?"
            )
        return None

    @property
    def role(self) -> str:
        return self.name.partition(".")[0]


def read(folder: str | Path) -> Credentials:
    """The credentials in a folder, valid at this time or not.

    Raises:
        ConfigError: a file is missing, cannot be read, is none of these, or does not fit the others; or the key can
            be read by others than its owner.
    """
    place = Path(folder).absolute()
    try:
        there = place.is_dir()
    except OSError as error:
        raise ConfigError(f"bus.tls.keys = {str(folder)!r}: cannot be read: {error.strerror}") from error
    if not there:
        raise ConfigError(
            f"bus.tls.keys = {str(folder)!r}: no such folder; `tandem keys create` makes one for every role"
        )
    certificate = load_certificate(place / CERTIFICATE)
    authority = load_certificate(place / AUTHORITY)
    key = place / KEY
    pem = read_bytes(key)
    mode = stat.S_IMODE(key.stat().st_mode)
    if mode & 0o077:
        raise ConfigError(f"{key}: others can read it (mode {mode:04o}); chmod 600 {key}")
    try:
        private = load_pem_private_key(pem, password=None)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{key}: no private key in PEM without a password: {error}") from error
    if private.public_key() != certificate.public_key():
        raise ConfigError(f"{key}: is not the key of {CERTIFICATE} beside it")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise ConfigError(
            f"{place / CERTIFICATE}: was not issued by the authority in {AUTHORITY} beside it; "
            "copy a role's folder as a whole"
        ) from error
    return Credentials(
        place, name_of(certificate), certificate.not_valid_before_utc, certificate.not_valid_after_utc
    )


def of_process(folder: str | None, role: str, plant: str) -> Credentials:
    """The credentials of a process, usable now. Raises `ConfigError`, which says why they are not.

    folder: `bus.tls.keys`; role: one of `protocol.rights.ROLES`; plant: its name.
    """
    wanted = common_name(role, plant)
    if not folder:
        raise ConfigError(
            f"bus.tls.keys is missing: a tls/ or quic/ endpoint needs the folder with the certificate of {wanted}"
        )
    credentials = read(folder)
    if credentials.name != wanted:
        raise ConfigError(
            f"{credentials.certificate}: is the certificate of {credentials.name}, and this process is {wanted}: "
            f"the router would deny it what it needs. Give bus.tls.keys the folder of {wanted}"
        )
    reason = credentials.expired()
    if reason is not None:
        raise ConfigError(reason)
    return credentials


def load_certificate(path: Path) -> x509.Certificate:
    """Raises `ConfigError` when it cannot be read, or is none."""
    pem = read_bytes(path)
    try:
        return x509.load_pem_x509_certificate(pem)
    except ValueError as error:
        raise ConfigError(f"{path}: no certificate in PEM: {error}") from error


def name_of(certificate: x509.Certificate) -> str:
    """The common name; "" when there is none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def read_bytes(path: Path) -> bytes:
    """Raises `ConfigError` when the file cannot be read."""
    try:
        return read_regular(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
