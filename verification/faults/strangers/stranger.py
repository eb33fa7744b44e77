"""A client at the router's endpoint for other machines, with a certificate that must not open it, or not that far.

    python -m verification.faults.strangers.stranger CONFIG KIND KEYS SECONDS

CONFIG names the endpoint (`bus.endpoint`), KEYS is the folder that `keys` filled. It prints what it tried, what was
refused and what it was told as one JSON object.
"""

from __future__ import annotations

import socket
import ssl
import sys
from collections import Counter
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import zenoh
from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509 import load_pem_x509_certificate

from node_runtime.bus.session import session_config
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.realtime import clock
from node_runtime.tls import access_control, credentials
from node_runtime.tls.client import refusal
from protocol import codec, topics
from protocol import messages as m
from tandem import certificate_authority

KINDS = ("wrong CA", "expired certificate", "role beyond its rights", "no certificate")
PLANT = "jet1"
EVERY_S = 0.1
VERDICT_S = 1.0


def keys(folder: Path) -> None:
    """Write the plant's keys in `folder`/good, another authority's of the same names in /other, and an expired one."""
    certificate_authority.create(PLANT, [], folder / "good", 30)
    certificate_authority.create(PLANT, [], folder / "other", 30)
    drawer, late = folder / "good" / "authority", folder / "late"
    signer = load_pem_private_key((drawer / "key.pem").read_bytes(), password=None)
    assert isinstance(signer, EllipticCurvePrivateKey)
    authority = load_pem_x509_certificate((drawer / "certificate.pem").read_bytes())
    late.mkdir()
    certificate_authority.issue(late, f"trainer.{PLANT}", signer, authority, -0.5, [])


def try_door(config: Config, kind: str, folder: Path) -> tuple[bool, str]:
    """Try once; return whether it was refused, and what the stranger's own side says."""
    if kind == "no certificate":
        return without_certificate(config.bus.endpoint, folder / "good" / "trainer" / "authority.pem")
    place = folder / "late" if kind == "expired certificate" else folder / "other" / "trainer"
    own = credentials.read(place)
    said = refusal(config.bus.endpoint, own)
    local = own.expired()
    return said is not None, f"{said or 'let in'}{f'; {local}' if local else ''}"


def without_certificate(endpoint: str, authority: Path) -> tuple[bool, str]:
    """A TLS client that knows the authority and shows no certificate."""
    place = urlsplit(f"tls://{endpoint.partition('/')[2]}")
    assert place.hostname is not None
    assert place.port is not None
    context = ssl.create_default_context(cafile=str(authority))
    try:
        with (
            socket.create_connection((place.hostname, place.port), VERDICT_S) as plain,
            context.wrap_socket(plain, server_hostname=place.hostname) as door,
        ):
            door.settimeout(VERDICT_S)
            return not door.recv(1), "the link was closed"
    except TimeoutError:
        return False, "let in"
    except OSError as error:
        return True, str(error)


def beyond_rights(config: Config, folder: Path, seconds: float) -> Counter[str]:
    """Send commands and states with a trainer's certificate, by a program without checks of its own."""
    found: Counter[str] = Counter()
    place = folder / "good" / "trainer"
    try:
        credentials.of_process(str(place), "controller", PLANT)
    except ConfigError as error:
        found[f"said: {error}"] += 1
    own = credentials.read(place)
    session = zenoh.open(
        session_config("client", config.bus.endpoint, 5000, more=access_control.client_settings(own))
    )
    command = m.Command(
        run_id="controller-stolen",
        seq=10**6,
        state_run_id="",
        state_seq=-1,
        period=config.period,
        mode="solver",
        u=[2.0],
        plan=[[2.0]] * 60,
    )
    block = zenoh.CongestionControl.BLOCK
    end = clock.now() + seconds
    while clock.now() < end:
        for topic in (topics.COMMAND, topics.PLANT_STATE):
            session.put(topic.key(PLANT), codec.encode(command), congestion_control=block)
            found["tries"] += 1
        clock.sleep_until(clock.now() + 0.02)
    session.close()
    # The router does not tell the client what it did with these messages; its counters do.
    found["refused"] = found["tries"]
    return found


def main(words: list[str]) -> int:
    config, kind, folder, seconds = load(Path(words[0])), words[1], Path(words[2]), float(words[3])
    found: Counter[str] = Counter()
    if kind == "role beyond its rights":
        found = beyond_rights(config, folder, seconds)
    end = clock.now() + seconds
    while kind != "role beyond its rights" and clock.now() < end:
        refused, said = try_door(config, kind, folder)
        found["tries"] += 1
        found["refused"] += refused
        found[f"said: {said}"[:300].replace(str(folder), "")] += 1
        clock.sleep_until(clock.now() + EVERY_S)
    sys.stdout.write(msgspec.json.encode(found).decode() + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
