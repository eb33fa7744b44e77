"""Links with certificates: who is let in, what each may do, and what both sides say of a refusal. A real router."""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from node_runtime.bus.session import session_config
from node_runtime.bus.zenoh_bus import Bus, Mailbox
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.realtime import clock
from node_runtime.router import open_router
from node_runtime.tls import access_control, credentials
from node_runtime.tls.client import refusal
from protocol import rights, topics
from protocol.topics import Topic
from tandem import certificate_authority
from tests.helpers.live import HANG_S, Process, connected, free_endpoint, live_config, matched, wait_for

pytestmark = pytest.mark.live


class Listener:
    """What a process says on standard error, as it comes."""

    def __init__(self, process: Process):
        self._text = ""
        self._changed = threading.Condition()
        threading.Thread(target=self._read, args=(process,), daemon=True).start()

    def _read(self, process: Process) -> None:
        for line in process.lines():
            with self._changed:
                self._text += line
                self._changed.notify_all()

    def heard(self, words: str, timeout_s: float = HANG_S) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: words in self._text, timeout_s), (
                f"no {words!r} in {self._text}"
            )


class Site:
    """A router with the local endpoint and the one with certificates, and keys of two authorities."""

    def __init__(self, folder: Path, router: Process, config: Config):
        self.folder, self.router, self.local = folder, Listener(router), config
        assert config.bus.remote is not None
        self.remote = config.bus.remote

    def far(self, role: str, authority: str = "jet1", *more: str) -> Config:
        """The configuration of a process on another machine."""
        keys = self.folder / authority / role
        return override(
            self.local, [f'bus.endpoint="{self.remote}"', f'bus.tls.keys="{keys}"', 'bus.remote=""', *more]
        )

    def session(self, role: str, authority: str = "jet1") -> zenoh.Session:
        """A hostile program with that role's certificate: Zenoh alone, none of our checks."""
        own = credentials.read(self.folder / authority / role)
        return zenoh.open(
            session_config("client", self.remote, 5000, more=access_control.client_settings(own))
        )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("site")
    certificate_authority.create("jet1", [], folder / "jet1", 30)
    certificate_authority.create("jet1", [], folder / "other", 30)  # the same names from another authority
    own = certificate_authority.create("jet2", [], folder / "jet2", 30)
    assert own
    _issue(folder, "expired", "trainer.jet1", -0.5)
    _issue(folder, "nobody", "nobody.jet1", 30)
    _issue(folder, "neighbour", "trainer.jet2", 30)
    remote = free_endpoint().replace("tcp/", "tls/")
    config = live_config(f'bus.remote="{remote}"', f'bus.tls.keys="{folder / "jet1" / "router"}"')
    with Process("node_runtime.router", config) as process:
        site = Site(folder, process, config)
        site.router.heard("with certificates, on")
        yield site


def _issue(folder: Path, place: str, name: str, days: float) -> None:
    """A certificate of jet1's authority that `tandem keys` would not make."""
    authority = folder / "jet1" / "authority"
    key = load_pem_private_key((authority / "key.pem").read_bytes(), None)
    to = folder / "jet1" / place
    to.mkdir(mode=0o700)
    certificate_authority.issue(
        to, name, key, credentials.load_certificate(authority / "certificate.pem"), days, []
    )


# -- who is let in ---------------------------------------------------------------------------------------------------


def test_a_trainer_elsewhere_hears_samples_asks_and_sends_weights(site: Site):
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


def test_controller_and_plant_may_be_elsewhere_too_and_a_recorder_hears_all(site: Site):
    with (
        Bus(site.far("plant"), "plant", "p-1") as plant,
        Bus(site.far("controller"), "controller", "c-1") as controller,
        Bus(site.far("recorder"), "recorder", "r-1") as recorder,
        Bus(site.far("operator"), "monitor", "m-1") as operator,
    ):
        states, commands = controller.queue(topics.PLANT_STATE), plant.queue(topics.COMMAND)
        logged, seen = recorder.everything(), operator.everything()
        wait_for(lambda: matched(plant, topics.PLANT_STATE) and matched(controller, topics.COMMAND))
        loop = {topic.key("jet1") for topic in (topics.PLANT_STATE, topics.COMMAND)}
        keys: dict[Mailbox, set[str]] = {box: set() for box in (logged, seen)}

        def all_hear() -> bool:
            """The router may know of one listener before it knows of the other."""
            plant._put(topics.PLANT_STATE, b"state")
            controller._put(topics.COMMAND, b"command")
            for box, found in keys.items():
                found |= {delivery.key for delivery in box.drain()}
            return all(loop <= found for found in keys.values())

        wait_for(all_hear)
        assert states.get(HANG_S)
        assert commands.get(HANG_S)


def _loopback6() -> str | None:
    """A free port on ::1; None where this machine has no such address."""
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
            return f"[::1]:{probe.getsockname()[1]}"
    except OSError:
        return None


@pytest.mark.parametrize("protocol", ["tls", "quic"])
@pytest.mark.parametrize("written", ["[::1]", "[0:0::1]"])
def test_a_router_at_an_ipv6_address_is_reached_by_certificates(
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
def test_who_is_not_let_in_is_told_why(site: Site, role: str, authority: str, says: str):
    with pytest.raises(ConfigError, match=says), Bus(site.far(role, authority), "trainer", "t-1"):
        pass


def test_no_certificate_is_told_at_once(site: Site):
    config = override(site.local, [f'bus.endpoint="{site.remote}"', 'bus.tls.keys=""'])
    with pytest.raises(ConfigError, match=r"bus\.tls\.keys is missing"), Bus(config, "trainer", "t-1"):
        pass


def test_a_router_under_another_name_is_not_believed(site: Site):
    far = site.far("trainer", "jet1", f'bus.endpoint="{site.remote.replace("127.0.0.1", "127.0.0.2")}"')
    own = credentials.read(site.folder / "jet1" / "trainer")
    # Nobody listens on 127.0.0.2: that is no refusal, and is waited for.
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
    """Listens on 127.0.0.2 and passes one connection on to `place`."""
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


def test_the_router_says_whom_it_refused_and_both_know_why(site: Site):
    """What our own checks would stop before: an expired certificate, another authority's, none."""
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


# -- who is let in and does more than it may -------------------------------------------------------------------------


FOREIGN = [
    (role, topic)
    for role, topic in [
        ("trainer", topics.COMMAND),
        ("trainer", topics.PLANT_STATE),
        ("trainer", topics.TICK),
        ("trainer", topics.HEALTH["controller"]),
        ("plant", topics.COMMAND),
        ("controller", topics.HIDDEN_WEIGHTS),
        ("controller", topics.PLANT_STATE),
        ("recorder", topics.HIDDEN_WEIGHTS),
        ("operator", topics.COMMAND),
        ("operator", topics.OVERRIDE),
        ("operator", topics.REFERENCE),
        ("commander", topics.COMMAND),
        ("nobody", topics.HIDDEN_WEIGHTS),
        ("neighbour", topics.HIDDEN_WEIGHTS),
    ]
]


def _allowed(role: str) -> Topic | None:
    own = rights.rights_of(role).publishes if role in rights.ROLES else ()
    return own[0] if own else None


def _until(mailbox: Mailbox, key: str, timeout_s: float = HANG_S) -> list[str]:
    """The keys of all that arrives, up to and with the first at `key`."""
    keys: list[str] = []
    deadline = clock.now() + timeout_s
    while key not in keys:
        assert clock.now() < deadline, f"nothing at {key}, but {keys}"
        delivery = mailbox.get(0.2)
        if delivery is not None:
            keys.append(delivery.key)
    return keys


@pytest.mark.parametrize("role", dict.fromkeys(role for role, _ in FOREIGN))
def test_what_a_role_may_not_publish_reaches_nobody(site: Site, role: str):
    """The last message is one that it may publish, so all before it have arrived or never will."""
    with Bus(site.local, "operator", "o-1") as ear, site.session(role) as session:
        heard, block = ear.everything(), zenoh.CongestionControl.BLOCK
        fast = [
            ear._lanes.session("bulk").declare_subscriber(topic.direct_key("jet1"))
            for topic in (topics.COMMAND,)
        ]
        # Only now does the router know that somebody listens.
        _until(heard, topics.HEALTH["router"].key("jet1"))
        for name, topic in FOREIGN:
            if name == role:
                session.put(topic.key("jet1"), b"bad", congestion_control=block)
        if role != "controller":
            session.put(topics.COMMAND.direct_key("jet1"), b"bad")
        session.put("tandem/jet2/trainer/hidden_weights", b"bad")
        session.delete("tandem/jet1/controller/command")
        own = _allowed(role)
        if own is not None:
            session.put(own.key("jet1"), b"good", congestion_control=block)
        # And where it may publish nothing, the router's next two words come after it.
        last = own.key("jet1") if own is not None else topics.HEALTH["router"].key("jet1")
        arrived = [key for _ in range(1 if own else 2) for key in _until(heard, last)]
        assert set(arrived) <= {last, *(f"tandem/jet1/router/{name}" for name in ("health", "run_info"))}
        assert fast[0].try_recv() is None
    named = {"nobody": "a certificate without rights here", "neighbour": "a certificate without rights here"}
    site.router.heard(named.get(role, f"bad from {role}.jet1: denied, put"))


def test_a_trainer_hears_no_commands_and_answers_no_questions(site: Site):
    with (
        Bus(site.local, "controller", "c-1") as controller,
        Bus(site.local, "trainer", "t-2") as asker,
        site.session("trainer") as session,
    ):
        heard = [
            session.declare_subscriber(key)
            for key in ("tandem/**", "tandem/jet1/**", "tandem/jet1/*/command")
        ]
        samples = session.declare_subscriber(topics.SAMPLES.key("jet1"), zenoh.handlers.RingChannel(8))
        lies = session.declare_queryable(
            f"tandem/jet1/{topics.OUTBOX_QUERY}",
            lambda query: query.reply(query.key_expr, b"lie"),
            complete=True,
        )
        controller.serve(topics.OUTBOX_QUERY, lambda _parameters: [b"true"])
        wait_for(lambda: matched(controller, topics.SAMPLES))
        controller._put(topics.COMMAND, b"command")
        controller._put(topics.SAMPLES, b"samples")
        sample = samples.recv()
        assert sample.payload.to_bytes() == b"samples"
        assert asker.ask(topics.OUTBOX_QUERY, {}, HANG_S) == [b"true"]
        commands = [
            one for sub in heard for one in iter(sub.try_recv, None) if "command" in str(one.key_expr)
        ]
        assert commands == []
        lies.undeclare()


def test_a_message_beyond_its_topic_s_size_ends_at_the_router(site: Site):
    health = topics.HEALTH["trainer"]
    with Bus(site.local, "recorder", "r-1") as ear, site.session("trainer") as session:
        heard = ear._lanes.session("bulk").declare_subscriber(health.key("jet1"))
        own = session.declare_publisher(health.key("jet1"))
        wait_for(lambda: own.matching_status.matching)
        block = zenoh.CongestionControl.BLOCK
        session.put(health.key("jet1"), bytes(health.max_bytes + 1), congestion_control=block)
        session.put(health.key("jet1"), bytes(health.max_bytes), congestion_control=block)
        assert len(heard.recv().payload) == health.max_bytes


# -- how long a link lasts, and the other protocol ---------------------------------------------------------------------


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_a_link_ends_with_its_certificate_and_the_process_says_so(
    site: Site, protocol: str, caplog: pytest.LogCaptureFixture
):
    place = f"short-{protocol}"
    _issue(site.folder, place, "trainer.jet1", 3.0 / 86400.0)
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
        # The rights are the same by either protocol.
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
        wait_for(lambda: any("expired on" in text and "our links to" in text for text in caplog.messages))
        assert connected(trainer)
        controller._put(topics.SAMPLES, b"later")
        wait_for(lambda: b"later" in [one.payload for one in heard[0].drain()])
        assert b"later" not in [one.payload for one in heard[1].drain()]
