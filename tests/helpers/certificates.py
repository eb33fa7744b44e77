"""Certificates that `tandem keys` would not create."""

from __future__ import annotations

from pathlib import Path

from cryptography.hazmat.primitives.serialization import load_pem_private_key

from node_runtime.tls import credentials
from tandem import certificate_authority


def issue(keys: Path, place: str, name: str, days: float) -> None:
    """Issue a certificate by the authority of these keys into their folder `place`, for any name and duration."""
    key = load_pem_private_key((keys / "authority" / "key.pem").read_bytes(), None)
    issued_by = credentials.load_certificate(keys / "authority" / "certificate.pem")
    (keys / place).mkdir(mode=0o700, exist_ok=True)
    certificate_authority.issue(keys / place, name, key, issued_by, days, [])
