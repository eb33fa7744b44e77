"""The certificate of a process: its files, and whether it can be used, checked before connecting.

A folder contains `certificate.pem`, its `key.pem`, and `authority.pem`, the certificate for checking other processes.
`tandem keys create` creates such a folder for every role.
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
    """A folder with three files that belong together."""

    folder: Path
    name: str
    """The certificate's common name, such as `trainer.jet1`."""
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
        """Return the days until it expires, negative afterwards."""
        return (self.not_after - datetime.now(UTC)).total_seconds() / 86400.0

    def expired(self) -> str | None:
        """Return why the certificate is not valid now, or None."""
        now = datetime.now(UTC)
        if now > self.not_after:
            return (
                f"{self.certificate}: expired on {self.not_after:%Y-%m-%d %H:%M} UTC. "
                f"Renew it by `tandem keys renew --role {self.role}` at the authority, and copy its folder"
            )
        if now < self.not_before:
            return (
                f"{self.certificate}: not valid before {self.not_before:%Y-%m-%d %H:%M} UTC; "
                f"it is {now:%Y-%m-%d %H:%M} here. Check the clock"
            )
        return None

    @property
    def role(self) -> str:
        return self.name.partition(".")[0]


def read(folder: str | Path) -> Credentials:
    """Read the credentials in a folder, whether they are valid at this time or not.

    Raises:
        ConfigError: a file is missing, unreadable or of a wrong kind, or does not belong to the others; or the key is
            readable by other users.
    """
    place = Path(folder).absolute()
    try:
        there = place.is_dir()
    except OSError as error:
        raise ConfigError(f"bus.tls.keys = {str(folder)!r}: cannot be read: {error.strerror}") from error
    if not there:
        raise ConfigError(
            f"bus.tls.keys = {str(folder)!r}: no such folder; `tandem keys create` creates one for every role"
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
        raise ConfigError(f"{key}: not a private key in PEM without a password: {error}") from error
    if private.public_key() != certificate.public_key():
        raise ConfigError(f"{key}: it is not the key of {CERTIFICATE} in the same folder")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise ConfigError(
            f"{place / CERTIFICATE}: was not issued by the authority in {AUTHORITY} in the same folder; "
            "copy a role's folder as a whole"
        ) from error
    return Credentials(
        place, name_of(certificate), certificate.not_valid_before_utc, certificate.not_valid_after_utc
    )


def of_process(folder: str | None, role: str, plant: str) -> Credentials:
    """Return the credentials of a process if they are usable now. Raises `ConfigError` with the reason otherwise.

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
            f"{credentials.certificate}: is the certificate of {credentials.name}, but this process is {wanted}, "
            f"and the router would deny its messages. Set bus.tls.keys to the folder of {wanted}"
        )
    reason = credentials.expired()
    if reason is not None:
        raise ConfigError(reason)
    return credentials


def load_certificate(path: Path) -> x509.Certificate:
    """Read a certificate. Raises `ConfigError` if it cannot be read or is not one."""
    pem = read_bytes(path)
    try:
        return x509.load_pem_x509_certificate(pem)
    except ValueError as error:
        raise ConfigError(f"{path}: not a certificate in PEM: {error}") from error


def name_of(certificate: x509.Certificate) -> str:
    """Return the common name; "" if there is none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def read_bytes(path: Path) -> bytes:
    """Read a file. Raises `ConfigError` if it cannot be read."""
    try:
        return read_regular(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
