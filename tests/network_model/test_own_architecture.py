"""An architecture in a file outside the package: the whole loop, its log, and the rule that logs load no files."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from network_model import registry
from network_model.description import NetworkDescription
from node_runtime.config.architecture import load_architecture
from node_runtime.config.loading import load
from node_runtime.config.strict import ConfigError
from protocol import topics
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from run_log.run import Run
from run_log.writing.save import save
from tandem.cli import main
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import simulate
from tandem.experiments.study.plan import Job
from tests.helpers.paths import DOCS, ROOT

EXAMPLE = ROOT / "examples" / "architecture" / "gru.py"
QUICK = [
    "controller.horizon=15",
    "network.hidden=[8, 8]",
    "trainer.steps=20",
    "controller.solver.compile=never",
]


@pytest.fixture(autouse=True)
def nothing_is_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Empty the registry, as in a process that has read no configuration."""
    monkeypatch.setattr(registry, "_given", {})
    monkeypatch.setattr(registry, "_names", {})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the architecture's file and a log made with it."""
    folder = tmp_path_factory.mktemp("own")
    file, log = folder / "gru.py", folder / "run.mcap"
    shutil.copy(EXAMPLE, file)
    save(simulate(load(None, [*QUICK, f"network.architecture={file}:GRU"]), 40), log)
    return file, log


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_given", {})
    monkeypatch.setattr(registry, "_names", {})


@pytest.fixture
def log(recorded: tuple[Path, Path]) -> Run:
    return read_run(recorded[1])


def own(folder: Path, *changes: tuple[str, str]) -> str:
    """Return a reference to a copy of the example with changes in its text."""
    text = EXAMPLE.read_text()
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    (folder / "gru.py").write_text(text)
    return f"{folder / 'gru.py'}:GRU"


def test_the_trainer_trains_it_and_the_controller_adopts_its_weights(log: Run) -> None:
    assert sum(result.weights_outcome == "adopted" for result in log.results) >= 2
    assert log.run_infos[0].versions["architecture"].startswith("gru.py:GRU@")


def test_a_replay_loads_no_file_named_in_the_log(
    recorded: tuple[Path, Path], log: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("node_runtime.config.architecture.loaded", None)
    with pytest.raises(LogError, match=r"its network is gru\.py:GRU, .* add --architecture gru\.py:GRU"):
        replay(log)


def test_a_replay_with_the_file_is_byte_equal(recorded: tuple[Path, Path], log: Run) -> None:
    found = replay(log, architecture=load_architecture(f"{recorded[0]}:GRU"))
    assert found.equal
    assert not any("content of the file differs" in note for note in found.notes)


def test_a_log_cannot_replace_a_shipped_architecture(recorded: tuple[Path, Path], log: Run) -> None:
    (entry,) = log.streams[topics.RUN_INFO["controller"].name]
    info = msgspec.structs.replace(entry.message, versions={**entry.message.versions, "architecture": "mlp"})
    log.streams[topics.RUN_INFO["controller"].name] = [replace(entry, message=info)]
    replay(log, architecture=load_architecture(f"{recorded[0]}:GRU"))
    assert registry.get_architecture("mlp").options == {}
    assert list(registry._given) == [load_architecture(f"{recorded[0]}:GRU").name]


def test_a_file_with_a_changed_comment_replays_with_a_note(tmp_path: Path, log: Run) -> None:
    found = replay(log, architecture=load_architecture(own(tmp_path, ("GRU = Gru()", "GRU = Gru()  # mine"))))
    assert found.equal
    assert any(
        "replayed with gru.py:GRU@" in note and "content of the file differs" in note for note in found.notes
    )


def test_a_file_with_a_changed_function_gives_a_note_and_a_difference(tmp_path: Path, log: Run) -> None:
    other = load_architecture(own(tmp_path, ("k * state + (1 - k) * new", "0.5 * state + 0.5 * new")))
    found = replay(log, architecture=other)
    assert not found.equal
    assert any("content of the file differs" in note for note in found.notes)


def test_a_replay_can_use_a_file_on_the_log_of_a_shipped_architecture(tmp_path: Path) -> None:
    run = simulate(load(None, [*QUICK, "network.architecture=rnn"]), 25)
    with pytest.raises(LogError, match="its network is Tandem's own rnn"):
        replay(run, architecture=load_architecture(own(tmp_path)))
    assert not replay(run, overrides=[f"network.architecture={own(tmp_path)}"]).equal


def test_a_report_needs_no_file(
    recorded: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The whole report is in the first picture.
    monkeypatch.setattr("run_log.reporting.plots.pictures", lambda data: {})
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    # The report runs in a folder where the file does not exist.
    log = shutil.copy(recorded[1], folder / "run.mcap")
    aside = recorded[0].rename(tmp_path / "gru.away")
    try:
        assert main(["report", str(log)]) == 0
    finally:
        aside.rename(recorded[0])


def test_a_description_of_a_file_that_was_not_loaded_is_refused(
    tmp_path: Path, recorded: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trainer decodes a controller's description in this way, as does any other reader of the bus."""
    reference = f"{recorded[0]}:GRU"
    theirs = load_architecture(reference)
    registry.register(reference, *theirs)
    description = NetworkDescription(
        states=1,
        inputs=1,
        hidden=[3],
        activations=["tanh"],
        input_scale=[1.0, 1.0],
        output_scale=[1.0],
        architecture=theirs.name,
        window=2,
    )
    sent = msgspec.json.encode(description)
    assert msgspec.json.decode(sent, type=NetworkDescription) == description
    forget(monkeypatch)
    with pytest.raises(ValueError, match=r"a file that this process did not load"):
        msgspec.json.decode(sent, type=NetworkDescription)
    mine = own(tmp_path, ("GRU = Gru()", "GRU = Gru()  # mine"))
    registry.register(mine, *load_architecture(mine))
    with pytest.raises(ValueError, match=r"this process has gru\.py:GRU@\w+: the texts of the files differ"):
        msgspec.json.decode(sent, type=NetworkDescription)


@pytest.mark.parametrize(
    ("change", "settings", "said"),
    [
        (None, [], "no such file"),
        (("GRU = Gru()", "GRU = Gru"), [], "no architecture but the class Gru"),
        (("GRU = Gru()", "LSTM = Gru()"), [], "has nothing called 'GRU'"),
        (("GRU = Gru()", "GRU = Gru())"), [], "not valid Python"),
        (("    window = 5", "    window = 1"), [], "at least 2 pairs"),
        (("    window = 5", "    window = 5"), ["network.options.kernel=2"], "the options of gru.py:GRU"),
    ],
)
def test_an_error_says_what_is_wrong_with_the_file(
    change: tuple[str, str] | None, settings: list[str], said: str, tmp_path: Path
) -> None:
    reference = f"{tmp_path / 'gru.py'}:GRU" if change is None else own(tmp_path, change)
    with pytest.raises(ConfigError, match=said):
        simulate(load(None, [*QUICK, *settings, f"network.architecture={reference}"]), 1)


@pytest.mark.long
def test_an_own_architecture_is_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled functions and CasADi's virtual machine round differently, so results agree to a tolerance only."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    small = [
        "controller.horizon=2",
        "network.window=2",
        "network.hidden=[3]",
        f"network.architecture={EXAMPLE}:GRU",
    ]
    runs = [
        simulate(load(None, [*small, f"controller.solver.compile={mode}"]), 8) for mode in ("auto", "never")
    ]
    assert "virtual machine" not in runs[0].run_infos[0].versions["kernels"]
    u, v = ([command.u for command in run.commands] for run in runs)
    np.testing.assert_allclose(u, v, atol=1e-7)


@pytest.mark.parametrize("process", ["controller", "trainer", "run"])
def test_a_process_reports_a_missing_architecture_file(
    process: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([process, "--set", "network.architecture=absent.py:GRU"]) == 2
    said = capsys.readouterr().err + caplog.text
    assert f"network.architecture: {tmp_path / 'absent.py'}: no such file" in said
    assert not list(tmp_path.iterdir())


def test_an_experiment_runs_again_after_a_change_of_the_file(tmp_path: Path) -> None:
    config = load(None, [f"network.architecture={own(tmp_path)}"])
    job = Job(config=config, steps=1, episodes=1, faults=Faults())
    before = job.key
    own(tmp_path, ("GRU = Gru()", "GRU = Gru()  # mine"))
    assert job.key != before


# -- tandem architecture check ---------------------------------------------------------------------------------


def test_the_check_passes_and_skips_sizes_that_the_architecture_refuses(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["architecture", "check", f"{EXAMPLE}:GRU", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["holds"]
    assert found["networks"] + sum(found["refused"].values()) == 60
    assert found["networks"] > 20
    assert any("at least 2 pairs" in text for text in found["refused"])


@pytest.mark.parametrize(
    ("before", "after", "code", "said"),
    [
        # phi is not bounded; or phi differs in torch, whose values are the only ones with a `dim`.
        ("        return dense(", "        return 2.0 * dense(", 1, "it must be bounded by 1"),
        (
            "        return dense(",
            '        if hasattr(state, "dim"):\n            state = 0.9 * state\n        return dense(',
            1,
            "DIFFER",
        ),
        (
            "        return dense(",
            "        return np.tanh(state)\n        return dense(",
            2,
            "with numpy, hidden = ",
        ),
        ("if sizes.window < 2", "if sizes.window < 99", 2, "refuses all 60 random sizes"),
    ],
)
def test_the_check_reports_the_fault(
    before: str, after: str, code: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["architecture", "check", own(tmp_path, (before, after))]) == code
    printed = capsys.readouterr()
    assert said in printed.out + printed.err


def test_the_page_shows_the_example() -> None:
    assert f"```python\n{EXAMPLE.read_text()}```" in (DOCS / "tutorials/architectures.md").read_text()
