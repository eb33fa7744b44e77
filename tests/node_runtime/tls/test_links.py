"""Links with certificates over a real router: admission, messages about refusals, and the end of a link."""

from __future__ import annotations

import socket
import ssl
import threading
from pathlib import Path

import pytest

from node_runtime.bus.zenoh_bus import Bus, Mailbox
from node_runtime.config.loading import override
from node_runtime.config.strict import ConfigError
from node_runtime.router import open_router
from node_runtime.tls import credentials
from node_runtime.tls.client import refusal
from protocol import topics
from tandem import certificate_authority
from tests.helpers.certificates import issue
from tests.helpers.live import HANG_S, connected, free_endpoint, live_config, matched, wait_for
from tests.node_runtime.tls.site import Site

pytestmark = pytest.mark.live


# -- admission -------------------------------------------------------------------------------------------------------


def test_a_remote_trainer_receives_samples_queries_and_sends_weights(site: Site):
    with (
        Bus(site.far("trainer"), "trainer", "t-1") as trainer,
        Bus(site.local, "controller", "c-1") as controller,
    ):
        controller.serve(topics.OUTBOX_QUERY, lambda _parameters: [b"answer"])
        weights, samples = controller.queue(topics.HIDDEN_WEIGHTS), trainer.queue(topics.SAMPLES)
        wait_for(lambda: matched(trainer, topics.HIDDEN_WEIGHTS) and matched(controller, topics.SAMPLES))
        trainer._put(topics.HIDDEN_WEIGHTS, b"weights")
        controller._put(topics.SAMPLES, b"samples")
        arrived = weights.get(HANG_S), samples.get(HANG_S)
        assert [one and one.payload for one in arrived] == [b"weights", b"samples"]
        assert trainer.ask(topics.OUTBOX_QUERY, {}, HANG_S) == [b"answer"]


def test_controller_and_plant_can_be_remote_and_a_recorder_receives_all(site: Site):
    with (
        Bus(site.far("plant"), "plant", "p-1") as plant,
        Bus(site.far("controller"), "controller", "c-1") as controller,
        Bus(site.far("recorder"), "recorder", "r-1") as recorder,
        Bus(site.far("viewer"), "monitor", "m-1") as viewer,
    ):
        states, commands = controller.queue(topics.PLANT_STATE), plant.queue(topics.COMMAND)
        logged, seen = recorder.everything(), viewer.everything()
        wait_for(lambda: matched(plant, topics.PLANT_STATE) and matched(controller, topics.COMMAND))
        loop = {topic.key("jet1") for topic in (topics.PLANT_STATE, topics.COMMAND)}
        keys: dict[Mailbox, set[str]] = {box: set() for box in (logged, seen)}

        def all_hear() -> bool:
            """The router may know one subscriber before the other."""
            plant._put(topics.PLANT_STATE, b"state")
            controller._put(topics.COMMAND, b"command")
            for box, found in keys.items():
                found |= {delivery.key for delivery in box.drain()}
            return all(loop <= found for found in keys.values())

        wait_for(all_hear)
        assert states.get(HANG_S)
        assert commands.get(HANG_S)


def _loopback6() -> str | None:
    """Return a free port on ::1; None if this machine has no such address."""
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
            return f"[::1]:{probe.getsockname()[1]}"
    except OSError:
        return None


@pytest.mark.parametrize("protocol", ["tls", "quic"])
@pytest.mark.parametrize("written", ["[::1]", "[0:0::1]"])
def test_a_router_at_an_ipv6_address_is_reached_with_certificates(
    tmp_path: Path, protocol: str, written: str
) -> None:
    place = _loopback6()
    if place is None:
        pytest.skip("this machine has no IPv6 loopback address")
    certificate_authority.create("jet1", ["[::1]"], tmp_path / "keys", 30)
    endpoint = f"{protocol}/{place}"
    router = live_config(f'bus.endpoint="{endpoint}"', f'bus.tls.keys="{tmp_path}/keys/router"')
    there = endpoint.replace("[::1]", written)
    controller = override(router, [f'bus.endpoint="{there}"', f'bus.tls.keys="{tmp_path}/keys/controller"'])
    with open_router(router), Bus(controller, "controller", "c-1") as bus:
        assert connected(bus)


def test_an_ipv6_router_that_its_certificate_does_not_name_is_refused(tmp_path: Path) -> None:
    place = _loopback6()
    if place is None:
        pytest.skip("this machine has no IPv6 loopback address")
    certificate_authority.create("jet1", [], tmp_path / "keys", 30)
    router = live_config(f'bus.endpoint="tls/{place}"', f'bus.tls.keys="{tmp_path}/keys/router"')
    with (
        open_router(router),
        pytest.raises(ConfigError, match=r"not for ::1: `tandem keys renew .* --host ::1`"),
    ):
        Bus(override(router, [f'bus.tls.keys="{tmp_path}/keys/trainer"']), "trainer", "t-1").open()


@pytest.mark.parametrize(
    ("role", "authority", "says"),
    [
        ("trainer", "other", "does not come from the authority"),
        ("expired", "jet1", "expired on"),
        ("controller", "jet1", r"is the certificate of controller\.jet1"),
        ("nowhere", "jet1", "no such folder"),
    ],
)
def test_a_refused_client_gets_the_reason(site: Site, role: str, authority: str, says: str):
    with pytest.raises(ConfigError, match=says), Bus(site.far(role, authority), "trainer", "t-1"):
        pass


def test_a_missing_certificate_is_reported_at_once(site: Site):
    config = override(site.local, [f'bus.endpoint="{site.remote}"', 'bus.tls.keys=""'])
    with pytest.raises(ConfigError, match=r"bus\.tls\.keys is missing"), Bus(config, "trainer", "t-1"):
        pass


def test_a_router_with_another_name_is_refused(site: Site):
    far = site.far("trainer", "jet1", f'bus.endpoint="{site.remote.replace("127.0.0.1", "127.0.0.2")}"')
    own = credentials.read(site.folder / "jet1" / "trainer")
    # There is no router on 127.0.0.2. That is not a refusal, and the client waits.
    assert refusal(far.bus.endpoint, own) is None
    assert refusal(site.remote, own) is None
    relay = _relay(site.remote.replace("tls/", ""))
    try:
        reason = refusal(f"tls/127.0.0.2:{relay.getsockname()[1]}", own)
    finally:
        relay.close()
    assert reason is not None
    assert "not for 127.0.0.2" in reason
    assert "--host 127.0.0.2" in reason


def _relay(place: str) -> socket.socket:
    """Listen on 127.0.0.2 and forward one connection to `place`."""
    listener = socket.create_server(("127.0.0.2", 0))
    host, _, port = place.rpartition(":")

    def serve() -> None:
        client, _ = listener.accept()
        with client, socket.create_connection((host, int(port))) as router:
            router.sendall(client.recv(65536))
            client.sendall(router.recv(65536))
            client.recv(65536)

    threading.Thread(target=serve, daemon=True).start()
    return listener


def test_router_and_client_report_the_reason_of_a_refusal(site: Site):
    """Our own checks would reject these earlier: an expired certificate, another authority's, none."""
    reason = refusal(site.remote, credentials.read(site.folder / "jet1" / "expired"))
    assert reason is not None
    assert "our certificate has expired by its clock" in reason
    site.router.heard("bad TLS link: refused, its certificate has expired")

    mixed = site.folder / "mixed"
    mixed.mkdir(exist_ok=True)
    for name in ("certificate.pem", "key.pem"):
        (mixed / name).write_bytes((site.folder / "other" / "trainer" / name).read_bytes())
    (mixed / "authority.pem").write_bytes((site.folder / "jet1" / "trainer" / "authority.pem").read_bytes())
    mine = credentials.read(site.folder / "jet1" / "trainer")
    reason = refusal(site.remote, credentials.Credentials(mixed, mine.name, mine.not_before, mine.not_after))
    assert reason is not None
    assert "does not know the authority of our certificate" in reason
    site.router.heard("bad TLS link: refused, its certificate comes from another authority")

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(mine.authority)
    host, _, port = site.remote.removeprefix("tls/").rpartition(":")
    with (
        socket.create_connection((host, int(port)), HANG_S) as plain,
        pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"),
        context.wrap_socket(plain, server_hostname=host) as link,
    ):
        link.recv(1)
    site.router.heard("bad TLS link: refused, it has no certificate")


# -- the end of a link, and the other protocol -------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_a_link_ends_with_its_certificate_and_the_process_logs_it(
    site: Site, protocol: str, caplog: pytest.LogCaptureFixture
):
    place = f"short-{protocol}"
    issue(site.folder / "jet1", place, "trainer.jet1", 3.0 / 86400.0)
    remote = free_endpoint().replace("tcp/", f"{protocol}/")
    local = override(site.local, [f'bus.remote="{remote}"', f'bus.endpoint="{free_endpoint()}"'])
    far = override(site.far("trainer", "jet1"), [f'bus.endpoint="{remote}"'])
    short = override(far, [f'bus.tls.keys="{site.folder / "jet1" / place}"'])
    with (
        open_router(local),
        Bus(local, "controller", "c-1") as controller,
        Bus(far, "trainer", "t-1") as trainer,
        Bus(short, "trainer", "t-2") as brief,
    ):
        weights, commands = controller.queue(topics.HIDDEN_WEIGHTS), controller.queue(topics.COMMAND)
        heard = trainer.queue(topics.SAMPLES), brief.queue(topics.SAMPLES)
        # The rights are the same with either protocol.
        wait_for(lambda: matched(trainer, topics.HIDDEN_WEIGHTS))
        trainer._lanes.session("bulk").put(topics.COMMAND.key("jet1"), b"bad")
        trainer._put(topics.HIDDEN_WEIGHTS, b"weights")
        arrived = weights.get(HANG_S)
        assert arrived is not None
        assert arrived.payload == b"weights"
        assert commands.drain() == []

        def both_hear() -> bool:
            controller._put(topics.SAMPLES, b"samples")
            return all(box.drain() for box in heard)

        wait_for(both_hear, every=0.05)
        wait_for(lambda: not connected(brief))
        wait_for(lambda: any("expired on" in text and "the links to" in text for text in caplog.messages))
        assert connected(trainer)
        controller._put(topics.SAMPLES, b"later")
        wait_for(lambda: b"later" in [one.payload for one in heard[0].drain()])
        assert b"later" not in [one.payload for one in heard[1].drain()]
