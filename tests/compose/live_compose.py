"""The containers for real: up, 200 ticks and adopted weights, each process killed, down, replay. `make compose-test`.

Not collected by `make test`: it needs a Docker engine and some minutes. The tests build on each other, in order.
What is waited for is heard on the bus, through a port that the test publishes.
"""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from protocol import messages as m
from protocol import topics
from tandem import certificate_authority
from tests.compose.project import BASE, Project, bridge_address, docker, limits
from tests.helpers.live import BusListener, health_of, wait_for

MAIN, TEST = "docker-compose.yml", "tests/compose/docker-compose.test.yml"
REMOTE = "docker-compose.remote.yml"
SERVICES = {"router", "plant", "controller", "trainer", "recorder"}
PATIENCE_S = 90.0
INSIDE = """
import errno, glob, json, os, re, shutil
def write(path):
    try:
        open(path, "w").close()
        return "written"
    except OSError as error:
        return errno.errorcode[error.errno]
def of_all(field):
    return sorted({re.search(field + r":\\t(\\S+)", open(path).read())[1] for path in glob.glob("/proc/[0-9]*/status")})
print(json.dumps({
    "users": sorted({os.stat(path).st_uid for path in glob.glob("/proc/[0-9]*")}),
    "capabilities": of_all("CapEff"),
    "no new privileges": of_all("NoNewPrivs"),
    "root": write("/x"),
    "package": write("/opt/tandem/x"),
    "tmp": write("/tmp/x"),
    "compilers": [name for name in ("cc", "gcc", "g++", "clang", "tcc") if shutil.which(name)],
    "processors": sorted(os.sched_getaffinity(1)),
}))
"""


class Watch:
    """Listens from outside, and says how long things took."""

    def __init__(self, bus: Bus):
        self.ear = BusListener(bus)

    def until(self, what: str, wanted: Callable[[m.Message], bool]) -> m.Message:
        began = clock.now()
        message = self.ear.until(wanted, PATIENCE_S)
        say(f"  {what}: after {clock.now() - began:.1f} s")
        return message

    def run_of(self, process: str) -> str:
        """The run id in the newest health of a process."""
        return self.ear.of(topics.HEALTH[process])[-1].run_id

    def returned(self, process: str, before: str) -> m.Health:
        """Wait until the next incarnation of a process is ready."""

        def ready(message: m.Message) -> bool:
            return (
                isinstance(message, m.Health)
                and message.process == process
                and message.run_id != before
                and message.status in ("ready", "running")
            )

        found = self.until(f"{process} is back", ready)
        assert isinstance(found, m.Health)
        return found

    def goes_on(self, ticks: int = 40) -> None:
        """Wait for so many ticks with a fresh state, and then for a plant that a fresh command drives."""
        fresh = 0

        def enough(message: m.Message) -> bool:
            nonlocal fresh
            fresh += isinstance(message, m.Tick) and message.state_verdict == "fresh"
            return fresh >= ticks

        self.until(f"{ticks} fresh ticks", enough)
        self.until(
            "a command drives the plant", lambda x: isinstance(x, m.PlantState) and x.source == "command"
        )

    def sources_since(self, mark: int) -> list[str]:
        """What drove the plant, in order, without repetitions."""
        found: list[str] = []
        for _, message in self.ear.heard[mark:]:
            if isinstance(message, m.PlantState) and found[-1:] != [message.source]:
                found.append(message.source)
        return found

    def ticks_since(self, mark: int) -> list[m.Tick]:
        return [message for _, message in self.ear.heard[mark:] if isinstance(message, m.Tick)]


def say(text: str) -> None:
    """A figure for the person who runs this (pytest -s)."""
    sys.stdout.write(f"{text}\n")


def adopted(message: m.Message) -> bool:
    return isinstance(message, m.TickResult) and message.weights_outcome == "adopted"


def assert_steady(sources: list[str]) -> None:
    """Fresh commands drove the plant all the time; where there is no SCHED_FIFO, the plan for a late tick."""
    assert set(sources) <= ({"command", "plan"} if limits() else {"command"})


def tick(seq: int) -> Callable[[m.Message], bool]:
    return lambda message: isinstance(message, m.Tick) and message.seq >= seq


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listening(endpoint: str) -> Config:
    return override(Config(), [f'bus.endpoint="{endpoint}"'])


def healthy(project: Project, service: str) -> None:
    """Wait until Docker itself finds a container healthy."""
    wait_for(lambda: project.inspect(service)["State"]["Health"]["Status"] == "healthy", PATIENCE_S)


@pytest.fixture(scope="module")
def project() -> Iterator[Project]:
    """All containers, built and started."""
    project = Project("tandem-test", [MAIN, TEST], TANDEM_TEST_PORT=str(free_port()), **limits())
    project.compose("down", "-v", "--remove-orphans")
    began = clock.now()
    project.compose("build", timeout_s=1800.0)
    say(f"\nbuilt in {clock.now() - began:.0f} s")
    try:
        yield project
    finally:
        project.compose("down", "-v", "--remove-orphans")


@pytest.fixture(scope="module")
def watch(project: Project) -> Iterator[Watch]:
    began = clock.now()
    # Creating containers can keep the disk and both processors busy: do that before anything runs.
    project.compose("up", "--no-start")
    say(f"created in {clock.now() - began:.0f} s")
    began = clock.now()
    project.compose("up", "-d")
    say(f"up in {clock.now() - began:.0f} s")
    port = docker("port", project.container("router"), "7447/tcp").split(":")[-1].strip()
    with Bus(listening(f"tcp/127.0.0.1:{port}"), "monitor", "monitor-test") as bus:
        watch = Watch(bus)
        watch.until("200 ticks", tick(199))
        say(f"200 ticks {clock.now() - began:.0f} s after up began")
        yield watch


def test_weights_are_adopted(project: Project, watch: Watch) -> None:
    if not any(adopted(message) for _, message in watch.ear.heard):
        watch.until("adopted weights", adopted)
    assert set(project.services()) == SERVICES


@pytest.mark.parametrize("service", sorted(SERVICES))
def test_a_container_has_no_more_than_it_needs(project: Project, watch: Watch, service: str) -> None:
    seen = project.inspect(service)
    healthy(project, service)
    assert seen["HostConfig"]["ReadonlyRootfs"]
    found = json.loads(docker("exec", seen["Id"], "python", "-c", INSIDE))
    real_time = service in ("router", "plant", "controller")
    assert found == {
        "users": [10001],
        "capabilities": ["0000000000000000"],
        "no new privileges": ["1"],
        "root": "EROFS",
        "package": "EROFS",
        "tmp": "written",
        "compilers": [],
        "processors": [0 if real_time else 1],
    }
    size = json.loads(docker("image", "inspect", seen["Image"]))[0]["Size"] / 1e6
    base = json.loads(docker("image", "inspect", BASE))[0]["Size"] / 1e6
    say(f"  {service}: image {size:.0f} MB, including the base of {base:.0f} MB; {found}")
    if service != "trainer":
        torch = subprocess.run(
            ["docker", "exec", seen["Id"], "python", "-c", "import torch"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert torch.returncode == 1
        assert "ModuleNotFoundError: No module named 'torch'" in torch.stderr
    if real_time:
        note = watch.ear.of(topics.HEALTH[service])[-1].note
        say(f"  {service}: {note or 'nothing to complain of'}")
        if limits():
            say("  NOT CHECKED: this engine may not raise limits, so there is no SCHED_FIFO")
        else:
            assert "SCHED_FIFO" not in note


def test_trainer_killed(project: Project, watch: Watch) -> None:
    before, mark = watch.run_of("trainer"), len(watch.ear.heard)
    project.kill("trainer")
    back = watch.returned("trainer", before)

    def from_the_new_one(message: m.Message) -> bool:
        return (
            isinstance(message, m.Tick)
            and message.weights is not None
            and message.weights.run_id == back.run_id
        )

    watch.until("its weights at the controller", from_the_new_one)
    watch.until("adopted", adopted)
    ticks = watch.ticks_since(mark)
    assert [t.seq for t in ticks] == list(range(ticks[0].seq, ticks[-1].seq + 1))
    assert_steady(watch.sources_since(mark))


def test_plant_killed(project: Project, watch: Watch) -> None:
    before, mark, controller = watch.run_of("plant"), len(watch.ear.heard), watch.run_of("controller")
    project.kill("plant")
    watch.returned("plant", before)
    watch.goes_on()
    assert watch.run_of("controller") == controller
    sources = watch.sources_since(mark)
    assert "hold" in sources
    assert_steady(sources[sources.index("hold") + 1 :])


def test_controller_killed(project: Project, watch: Watch) -> None:
    before, mark, plant = watch.run_of("controller"), len(watch.ear.heard), watch.run_of("plant")
    project.kill("controller")
    watch.until("the plant follows the plan", lambda x: isinstance(x, m.PlantState) and x.source == "plan")
    back = watch.returned("controller", before)
    watch.goes_on()
    sources = watch.sources_since(mark)
    say(f"  the plant was driven by {', '.join(sources)}")
    assert watch.run_of("plant") == plant
    assert set(sources) <= {"command", "plan", "safe"}
    keyframes = [message for _, message in watch.ear.heard[mark:] if isinstance(message, m.Keyframe)]
    # With the memory of the one that was killed: its checkpoint outlived the container's process.
    first = next(frame for frame in keyframes if (frame.run_id, frame.seq) == (back.run_id, -1))
    assert first.resumed == before


def test_recorder_killed(project: Project, watch: Watch) -> None:
    before, mark, logs = watch.run_of("recorder"), len(watch.ear.heard), project.logs()
    project.kill("recorder")
    watch.returned("recorder", before)
    watch.goes_on()
    ticks = watch.ticks_since(mark)
    assert [t.seq for t in ticks] == list(range(ticks[0].seq, ticks[-1].seq + 1))
    assert_steady(watch.sources_since(mark))
    assert len(project.logs()) == len(logs) + 1


def test_router_killed(project: Project, watch: Watch) -> None:
    before, mark, runs = (
        watch.run_of("router"),
        len(watch.ear.heard),
        [watch.run_of(p) for p in ("plant", "controller")],
    )
    project.kill("router")
    watch.returned("router", before)
    # Two keyframes with whole ticks between them, for the replay of the second log.
    watch.goes_on(220)
    say(f"  the plant was driven by {', '.join(watch.sources_since(mark))}")
    assert [watch.run_of(p) for p in ("plant", "controller")] == runs


def test_it_ends_cleanly_with_a_readable_log(project: Project, watch: Watch) -> None:
    began = clock.now()
    project.compose("stop")
    say(f"  stopped in {clock.now() - began:.1f} s")
    said = project.compose("logs", "--no-color")
    say("\n".join(line for line in said.splitlines() if line.startswith("recorder")))
    assert {name: project.inspect(name)["State"]["ExitCode"] for name in SERVICES} == dict.fromkeys(
        SERVICES, 0
    )
    assert "Traceback" not in said
    assert "INFO: /logs/" in said  # the recorder's last word: which log, how many messages
    assert {name: project.inspect(name)["RestartCount"] for name in SERVICES} == dict.fromkeys(SERVICES, 1)

    last = watch.ear.of(topics.TICK)[-1].seq
    first, second = project.logs()
    whole = json.loads(project.recorder("replay", first, "--json"))
    say(f"  {first}: {whole['ticks']} ticks of {len(whole['run_ids'])} controllers, equal: {whole['equal']}")
    assert whole["equal"]
    assert len(whole["run_ids"]) == 2
    assert whole["first_tick"] == 0
    report = json.loads(project.recorder("report", first, "--output", "/tmp", "--json"))
    say(
        f"  {first}: whole tick {report['tick_ms']} ms, late {report['late_ticks']}, skipped {report['skipped_slots']}"
    )
    assert report["tick_ms"]["p50" if limits() else "p99"] < 50.0
    # The second began in the middle of a run, and has the gap in it that the router left.
    part = json.loads(project.recorder("replay", second, "--from-tick", str(last - 20), "--json"))
    say(f"  {second}: {part['ticks']} ticks from {part['first_tick']}, equal: {part['equal']}")
    assert part["equal"]
    assert part["ticks"] >= 20


@pytest.fixture
def gateway() -> str:
    """An address of this machine that containers reach: that of the engine's own bridge."""
    options = json.loads(docker("network", "inspect", "bridge"))[0].get("Options") or {}
    bridge = options.get("com.docker.network.bridge.name", "docker0")
    show = ["ip", "-json", "addr", "show", "dev", bridge]
    return bridge_address(subprocess.run(show, capture_output=True, text=True, check=True).stdout)


@pytest.fixture
def keys(gateway: str, tmp_path: Path) -> Path:
    """As `tandem keys create` makes them, then given to the containers' user; `mine` is a copy for this test."""
    made = tmp_path / "keys"
    certificate_authority.create("jet1", [gateway], made, days=2)
    shutil.copytree(made / "viewer", tmp_path / "mine")
    docker(
        "run", "--rm", "--network=none", "-v", f"{made}:/keys", BASE, "chown", "-R", "10001:10001", "/keys"
    )
    return made


@pytest.fixture
def here(gateway: str, keys: Path) -> Iterator[Project]:
    """The machine of the plant."""
    with_keys = {"TANDEM_KEYS": str(keys), "TANDEM_BIND": gateway}
    yield from temporary(Project("tandem-test-here", [MAIN, REMOTE], **with_keys, **limits()))


@pytest.fixture
def there(gateway: str, keys: Path) -> Iterator[Project]:
    """The machine of the trainer: it has only the published address in common with the other."""
    elsewhere = {"TANDEM_KEYS": str(keys), "TANDEM_ENDPOINT": f"tls/{gateway}:7448"}
    yield from temporary(Project("tandem-test-there", [MAIN, REMOTE], **elsewhere, **limits()))


def temporary(project: Project) -> Iterator[Project]:
    project.compose("down", "-v", "--remove-orphans")
    try:
        yield project
    finally:
        project.compose("down", "-v", "--remove-orphans")


def test_a_trainer_elsewhere_and_ctrl_c(here: Project, there: Project, gateway: str, tmp_path: Path) -> None:
    as_operator = override(Config(), [f"bus.endpoint=tls/{gateway}:7448", f"bus.tls.keys={tmp_path}/mine"])
    there.compose("up", "--no-start", "--no-deps", "trainer", timeout_s=1800.0)
    here.compose("up", "--no-start", timeout_s=1800.0)
    with here.foreground() as up, Bus(as_operator, "monitor", "monitor-test") as bus:
        watch = Watch(bus)
        watch.until("the controller runs without a trainer", tick(60))
        assert not watch.ear.of(topics.HEALTH["trainer"])
        there.compose("up", "-d", "--no-deps", "trainer")
        watch.until("the trainer from elsewhere", health_of("trainer", status="running"))
        watch.until("its weights are adopted", adopted)
        assert docker("port", here.container("router")).split() == ["7448/tcp", "->", f"{gateway}:7448"]
        healthy(there, "trainer")
    say(f"  exit code of up after Ctrl-C: {up.returncode}")
    left = SERVICES - {"trainer"}
    assert {name: here.inspect(name)["State"]["ExitCode"] for name in left} == dict.fromkeys(left, 0)
    (log,) = here.logs()
    found = json.loads(here.recorder("replay", log, "--json"))
    say(f"  {log}: {found['ticks']} ticks, equal: {found['equal']}")
    assert found["equal"]
    assert found["first_tick"] == 0
