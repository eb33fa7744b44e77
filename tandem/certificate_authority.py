"""A plant's private authority and one certificate for each role: created, renewed and loaded.

keys/jet1/authority/   certificate.pem, key.pem     keep the key elsewhere: renewing needs it, running does not
keys/jet1/trainer/     certificate.pem, key.pem, authority.pem      all files for the trainer's machine
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from node_runtime.config.strict import ConfigError
from node_runtime.tls.credentials import AUTHORITY, CERTIFICATE, KEY, load_certificate, name_of, read_bytes
from node_runtime.whole_file import write_whole
from protocol.rights import ROLES, common_name
from tandem.terminal import Refused

AUTHORITY_FOLDER = "authority"
PEM = serialization.Encoding.PEM
AUTHORITY_DAYS = 3650
"""Validity of the authority in days, longer than that of its certificates: a new authority replaces every folder."""
LEAF_DAYS = 365
EARLY = timedelta(days=1)
"""Clocks differ: a certificate is valid from a little before its creation."""
ALWAYS = ("localhost", "127.0.0.1", "router")


@dataclass(frozen=True)
class Issued:
    """One certificate on disk."""

    folder: Path
    role: str
    plant: str
    certificate: x509.Certificate

    @property
    def valid_until(self) -> datetime:
        return self.certificate.not_valid_after_utc

    @property
    def days_left(self) -> float:
        return (self.valid_until - datetime.now(UTC)).total_seconds() / 86400.0

    @property
    def fingerprint(self) -> str:
        """SHA-256, as `openssl x509 -fingerprint -sha256` prints it."""
        return self.certificate.fingerprint(hashes.SHA256()).hex(":").upper()

    @property
    def hosts(self) -> list[str]:
        """Names and addresses for which the certificate is valid; only the router's has them."""
        try:
            names = self.certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except x509.ExtensionNotFound:
            return []
        return [
            str(name) for kind in (x509.DNSName, x509.IPAddress) for name in names.get_values_for_type(kind)
        ]


def create(plant: str, hosts: Sequence[str], folder: Path, days: int) -> list[Issued]:
    """Create an authority for one plant and a certificate for every role, in `folder`, which must not exist yet."""
    if folder.exists() or folder.is_symlink():
        raise Refused(
            f"{folder}: exists already, and keys are never overwritten. `tandem keys renew --role ROLE` renews one "
            "certificate; with another --out a new authority is created, and the old certificates do not fit it"
        )
    if not 1 <= days < AUTHORITY_DAYS:
        raise Refused(f"--days {days}: choose at least 1 and less than the authority's {AUTHORITY_DAYS}")
    names = _host_names([*ALWAYS, *hosts])
    key = ec.generate_private_key(ec.SECP256R1())
    authority = _authority(plant, key)
    with _refused_where_it_cannot_write(folder):
        for place in (folder, *(folder / name for name in (AUTHORITY_FOLDER, *ROLES))):
            place.mkdir(mode=0o700, parents=True)
            place.chmod(0o700)
        _write(folder / AUTHORITY_FOLDER, key, authority)
        for role in ROLES:
            hosts_of = names if role == "router" else []
            issue(folder / role, common_name(role, plant), key, authority, days, hosts_of)
    return found(folder)


def renew(
    role: str, folder: Path, hosts: Sequence[str], days: int, drawer: Path | None
) -> tuple[Issued | None, Issued]:
    """Issue a new key and certificate for one role; return the old one and the new one.

    The old one is None for a role that these keys do not have: a later version may have more roles.

    folder: the plant's folder; hosts: further names for the router; drawer: folder of the authority, None: within the
    plant's folder.
    """
    place = drawer or folder / AUTHORITY_FOLDER
    try:
        authority = load_certificate(place / CERTIFICATE)
        key = serialization.load_pem_private_key(read_bytes(place / KEY), password=None)
    except (ConfigError, ValueError, TypeError) as error:
        raise Refused(
            f"{error}. The authority's key is needed to renew a certificate; if it is elsewhere, add --authority FOLDER"
        ) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != authority.public_key():
        raise Refused(f"{place / KEY}: is not the key of {CERTIFICATE} in the same folder")
    _, plant = _role_and_plant(authority)
    old = _issued(folder / role)
    if old is None and not any(one.plant == plant for one in found(folder)):
        raise Refused(f"{folder}: contains no certificate of {plant}; name the folder with the plant's keys")
    if old is not None and plant != old.plant:
        raise Refused(f"{place}: is the authority of {plant}, and {folder / role} belongs to {old.plant}")
    left = (authority.not_valid_after_utc - datetime.now(UTC)).days
    if not 1 <= days < left:
        raise Refused(
            f"--days {days}: choose at least 1 and less than {left}, the days until the authority expires"
        )
    if hosts and role != "router":
        raise Refused(f"--host: only the router's certificate contains host names, not the {role}'s")
    names = _host_names([*(ALWAYS if old is None else old.hosts), *hosts]) if role == "router" else []
    with _refused_where_it_cannot_write(folder):
        (folder / role).mkdir(mode=0o700, exist_ok=True)
        issue(folder / role, common_name(role, plant), key, authority, days, names)
    new = _issued(folder / role)
    assert new is not None
    return old, new


def found(folder: Path) -> list[Issued]:
    """Load all certificates of a folder, of a plant's folder, or of several plants'."""
    if not folder.is_dir():
        raise Refused(f"{folder}: no such folder; `tandem keys create --plant NAME` creates one")
    places = sorted(path.parent for depth in ("", "*/", "*/*/") for path in folder.glob(depth + CERTIFICATE))
    all_of_them = [issued for place in places if (issued := _issued(place)) is not None]
    if not all_of_them:
        raise Refused(f"{folder}: neither this folder nor a folder in it contains a {CERTIFICATE}")
    order = {role: i for i, role in enumerate((AUTHORITY_FOLDER, *ROLES))}
    return sorted(all_of_them, key=lambda one: (one.plant, order.get(one.role, len(order))))


def _issued(folder: Path) -> Issued | None:
    path = folder / CERTIFICATE
    if not path.exists():
        return None
    try:
        certificate = load_certificate(path)
    except ConfigError as error:
        raise Refused(str(error)) from error
    return Issued(folder, *_role_and_plant(certificate), certificate)


def _role_and_plant(certificate: x509.Certificate) -> tuple[str, str]:
    role, _, plant = name_of(certificate).partition(".")
    return role, plant


@contextmanager
def _refused_where_it_cannot_write(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise Refused(f"{error.filename or folder}: cannot be written: {error.strerror}") from error


def _host_names(hosts: Sequence[str]) -> list[x509.GeneralName]:
    names: dict[str, x509.GeneralName] = {}
    for host in hosts:
        try:
            # An IPv6 address is written [::1] in an endpoint.
            address = ipaddress.ip_address(host.removeprefix("[").removesuffix("]"))
        except ValueError:
            if not host.isascii() or not host or any(sign in host for sign in "/: "):
                raise Refused(
                    f"--host {host}: not a host name or an address; omit port and protocol"
                ) from None
            names[host.lower()] = x509.DNSName(host.lower())
        else:
            names[str(address)] = x509.IPAddress(address)
    return list(names.values())


def _authority(plant: str, key: ec.EllipticCurvePrivateKey) -> x509.Certificate:
    # Two authorities of one plant have two names, so that a refusal can name the other one.
    number = x509.SubjectKeyIdentifier.from_public_key(key.public_key()).digest.hex()
    own = _name(common_name(AUTHORITY_FOLDER, plant))
    name = x509.Name([*own, x509.NameAttribute(NameOID.SERIAL_NUMBER, number)])
    return _builder(name, name, key.public_key(), AUTHORITY_DAYS, signs_others=True).sign(
        key, hashes.SHA256()
    )


def issue(
    folder: Path,
    name: str,
    signer: ec.EllipticCurvePrivateKey,
    authority: x509.Certificate,
    days: float,
    hosts: list[x509.GeneralName],
) -> None:
    """Create a key and its certificate, named `name`, in `folder`. With hosts it is a server too; all are clients."""
    key = ec.generate_private_key(ec.SECP256R1())
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
    builder = _builder(_name(name), authority.subject, key.public_key(), days, signs_others=False)
    if hosts:
        uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        builder = builder.add_extension(x509.SubjectAlternativeName(hosts), critical=False)
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key())
    builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
    builder = builder.add_extension(issuer, critical=False)
    _write(folder, key, builder.sign(signer, hashes.SHA256()))
    _write_file(folder / AUTHORITY, authority.public_bytes(PEM))


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: float, *, signs_others: bool
) -> x509.CertificateBuilder:
    """Properties of both kinds; an authority signs these certificates and no further authority."""
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLY)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(
            x509.BasicConstraints(ca=signs_others, path_length=0 if signs_others else None), critical=True
        )
        .add_extension(_usage(signs_others), critical=True)
    )


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _usage(signs_others: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_others,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_others,
        crl_sign=signs_others,
        encipher_only=False,
        decipher_only=False,
    )


def _write(folder: Path, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> None:
    pkcs8, plain = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    _write_file(folder / KEY, key.private_bytes(PEM, pkcs8, plain))
    _write_file(folder / CERTIFICATE, certificate.public_bytes(PEM))


def _write_file(path: Path, content: bytes) -> None:
    """Create a file that only its owner can read, from the first byte on."""
    write_whole(path, content, mode=0o600, durable=True)
