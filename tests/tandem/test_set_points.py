"""Set-points as arguments and tables, and the answers of `tandem set-point` and `tandem simulate`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from protocol import messages as m
from tandem.cli import main
from tandem.commands.operating.set_point import words
from tandem.operating.set_points import from_file, from_words
from tandem.terminal import Refused


def table(folder: Path, text: str) -> Path:
    path = folder / "steps.csv"
    path.write_text(text)
    return path


def test_a_table_is_a_sequence(tmp_path: Path) -> None:
    read = from_file(table(tmp_path, "time, y,z\n0,1.65,0.5\n\n2.5,1.7,0.45\n2.5, 1.75,0.4\n"), lease=3.0)
    assert (read.kind, read.outputs, read.lease) == ("set", ["y", "z"], 3.0)
    assert (read.times, read.values) == ([0.0, 2.5, 2.5], [[1.65, 0.5], [1.7, 0.45], [1.75, 0.4]])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the first line must name the columns"),
        ("y,time\n1,2\n", "the first line must name the columns"),
        ("time;y\n1;2\n", "and it is 'time;y'"),
        ("time,y,y\n0,1,1\n", "each once"),
        ("time,y\n", "0 rows"),
        ("time,y\n" + "0,1.7\n" * 1001, "1001 rows"),
        ("time,y\n0,1.7\n1\n", "row 3 has 1 entries"),
        ("time,y\n0,high\n", "row 2: could not convert"),
    ],
)
def test_an_invalid_table_is_refused_with_its_row(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(Refused, match=said):
        from_file(table(tmp_path, text))


def test_words_are_names_and_numbers() -> None:
    assert from_words(["y=1.8", "z=.5"]) == {"y": 1.8, "z": 0.5}
    for bad in (["y"], ["y=high"], ["y=nan"], ["y=1", "y=2"], ["y=inf"]):
        with pytest.raises(Refused, match="NAME=VALUE"):
            from_words(bad)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["y=3"], "y=3: y = 3 is outside X: 1.1875 to 2.1875"),
        (["x=1"], "'x' is no state of moore_greitzer: z, y, r, rdot"),
        ([], "give exactly one of NAME=VALUE, --file and --configured"),
        (["y=1.7", "--configured"], "one of NAME=VALUE"),
        (["y=1.7", "--over", "-1"], "--over"),
        (["y=1.7", "--for", "61"], "--for"),
        (["--file", "/nowhere.csv"], "/nowhere.csv: cannot be read"),
    ],
)
def test_an_impossible_request_is_refused_before_any_message(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["set-point", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_the_controllers_answer_is_printed_in_words() -> None:
    result = m.TickResult(
        run_id="c-1", seq=7, x=[], u=[], mode="solver", status="", iterations=1, slack=0.0, slack_row="", h=None,
        h_hat=None, prediction_error=None, oracle_norms=[], hidden_version=-1, hidden_sha256="", tick_crc32=0,
        input_delay=0.0, weights_verdict="none", target_status="nearest", target_distance=0.0917,
        reference={"y": 2.18},
    )  # fmt: skip
    assert (
        words(result)
        == "taken in tick 7: y 2.18 now, out of reach: the nearest steady state differs by 9.17 % of a half-width"
    )
    assert words(result, "y=1.7 in 5 s").endswith("of a half-width; y=1.7 in 5 s")


def test_a_simulation_follows_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = table(tmp_path, "time,y\n0,1.7\n")
    common = ["simulate", "--config", "compressor-cheap", "--oracle", "constant", "--steps", "3", "--json"]
    quick = ["--set", "controller.solver.compile=never", "--set", "controller.horizon=5"]
    assert main([*common, *quick, "--set-points", str(path)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["unreached_ticks"] == 0
    assert list(found["offset"]) == ["y"]
    path.write_text("time,y\n0,9\n")
    assert main([*common, *quick, "--set-points", str(path)]) == 2
    assert "outside X" in capsys.readouterr().err
