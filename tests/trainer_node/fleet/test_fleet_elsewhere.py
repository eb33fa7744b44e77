"""One trainer and plants with a router each: every link has its own certificate, and none delays another."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from node_runtime.config.loading import from_json, load, override, to_json, to_toml
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from protocol.messages import Health
from tandem import certificate_authority
from tests.helpers.certificates import issue
from tests.helpers.live import HANG_S, Process, free_endpoint, live_config, wait_for
from tests.trainer_node.partner import TRAINING, Controller
from trainer_node.fleet.discovery import RouterPerPlant
from trainer_node.main import main
from trainer_node.node import TrainerNode

pytestmark = pytest.mark.live


def site(folder: Path, name: str, *more: str) -> Config:
    """Return the configuration of one plant's machine: a router with a local and a remote endpoint, and its keys."""
    certificate_authority.create(name, [], folder / name, 30)
    door = free_endpoint().replace("tcp/", "tls/")
    return live_config(
        f"name={name}", f'bus.remote="{door}"', f'bus.tls.keys="{folder / name / "router"}"', *more
    )


def fleet(folder: Path, *sites: Config) -> Config:
    """Return the trainer's configuration: all sites, with the trainer's folder of each."""
    places = ", ".join(
        f'{{name="{one.name}", endpoint="{one.bus.remote}", keys="{folder / one.name / "trainer"}"}}'
        for one in sites
    )
    return override(Config(trainer=TRAINING), [f"trainer.fleet=[{places}]"])


@contextmanager
def routing(config: Config) -> Iterator[None]:
    with Process("node_runtime.router", config) as process:
        assert any("with certificates, on" in line for line in process.lines())
        # Keep reading, because a full pipe would block the process.
        threading.Thread(target=lambda: list(process.lines()), daemon=True).start()
        yield


@contextmanager
def training(config: Config) -> Iterator[None]:
    stop = threading.Event()
    ended: list[int] = []
    thread = threading.Thread(target=lambda: ended.append(main(config, stop)))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(HANG_S)
    assert ended == [0]


def published(health: Health) -> bool:
    return health.counters.get("published", 0) > 0


def test_plants_behind_routers_of_their_own_get_weights_from_one_trainer(tmp_path: Path) -> None:
    sites = [site(tmp_path, name) for name in ("jet1", "jet2")]
    absent = site(tmp_path, "jet3")  # its router never runs
    with ExitStack() as stack:
        for one in sites:
            stack.enter_context(routing(one))
        plants = [
            stack.enter_context(Controller(one, f"controller-{k}", seed=k)) for k, one in enumerate(sites)
        ]
        stack.enter_context(training(fleet(tmp_path, *sites, absent)))
        for plant in plants:
            plant.until(published, tick=True)
        for plant in plants:
            plant.until(lambda health: health.counters.get("adopted", 0) > 0, tick=True)
            assert plant.adopted[-1].for_run == plant.run_id


def test_a_refusing_router_delays_no_other_plant_and_is_retried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("trainer_node.fleet.discovery.TRY_AGAIN_S", 0.2)
    good, other = site(tmp_path, "jet1"), site(tmp_path, "jet2")
    right = tmp_path / "jet2" / "trainer"
    kept = tmp_path / "kept"
    right.rename(kept)
    with ExitStack() as stack:
        for one in (good, other):
            stack.enter_context(routing(one))
        first = stack.enter_context(Controller(good, "controller-1"))
        second = stack.enter_context(Controller(other, "controller-2"))
        stack.enter_context(training(fleet(tmp_path, good, other)))
        first.until(published, tick=True)
        assert any("jet2" in text and "no such folder" in text for text in caplog.messages)
        # Its folder is copied to the right place at last.
        kept.rename(right)
        second.until(published, tick=True)


def test_an_unexpected_error_of_one_plant_does_not_end_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("trainer_node.fleet.fleet.PAUSE_S", 0.5)
    listen = TrainerNode.listen
    looks: list[float] = []

    def fails_once(node: TrainerNode, now: float) -> None:
        if node._config.name == "jet1":
            looks.append(now)
            if len(looks) == 1:
                raise MemoryError("a network for a larger machine")
        listen(node, now)

    monkeypatch.setattr(TrainerNode, "listen", fails_once)
    sites = [site(tmp_path, name) for name in ("jet1", "jet2")]
    with ExitStack() as stack:
        for one in sites:
            stack.enter_context(routing(one))
        plants = [stack.enter_context(Controller(one, f"controller-{k}")) for k, one in enumerate(sites)]
        stack.enter_context(training(fleet(tmp_path, *sites)))
        for plant in reversed(plants):
            plant.until(published, tick=True)
    assert looks[1] - looks[0] >= 0.5
    assert any("jet1: dropped for" in text for text in caplog.messages)


def test_no_plant_receives_the_list_of_the_others(tmp_path: Path) -> None:
    sites = [site(tmp_path, name) for name in ("jet1", "jet2")]
    config = fleet(tmp_path, *sites)
    said = to_json(RouterPerPlant(config, config.trainer.fleet, threading.Event()).config("jet1"))
    assert sites[0].bus.remote in said
    assert sites[1].bus.remote not in said


def test_a_pattern_chooses_from_the_list(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert main(fleet(tmp_path, Config(name="jet1")), threading.Event(), "pump*") == 2
    assert "no plant of trainer.fleet matches 'pump*'; it has jet1" in caplog.text


def test_the_list_is_read_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "fleet.toml"
    text = '[[trainer.fleet]]\nname = "jet1"\nendpoint = "tls/10.0.0.5:7448"\n'
    file.write_text(text)
    config = load(file)
    assert config.trainer.fleet[0].endpoint == "tls/10.0.0.5:7448"
    assert from_json(to_json(config)) == config
    (tmp_path / "again.toml").write_text(to_toml(config))
    assert load(tmp_path / "again.toml") == config
    for wrong, says in (
        (text + 'kees = "k"\n', "did you mean 'trainer.fleet[0].keys'"),
        (text + text, "'jet1' is used twice"),
        (text.replace("jet1", "jet 1"), "name"),
        (text.replace("endpoint", "#"), "endpoint"),
    ):
        file.write_text(wrong)
        with pytest.raises(ConfigError, match="trainer") as raised:
            load(file)
        assert says in str(raised.value)
        assert str(file) in str(raised.value)


def test_a_link_with_an_expired_certificate_is_reopened_with_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("trainer_node.fleet.discovery.TRY_AGAIN_S", 0.2)
    only = site(tmp_path, "jet1")
    folder = tmp_path / "jet1"
    issue(folder, "trainer", "trainer.jet1", 6.0 / 86400.0)
    with ExitStack() as stack:
        stack.enter_context(routing(only))
        plant = stack.enter_context(Controller(only, "controller-1"))
        stack.enter_context(training(fleet(tmp_path, only)))
        first = plant.until(published, tick=True)
        wait_for(lambda: any("expired on" in text for text in caplog.messages))
        certificate_authority.renew("trainer", folder, [], 30, None)
        plant.until(published, tick=True, ignored=first.run_id)
    assert any("the links to" in text for text in caplog.messages)
