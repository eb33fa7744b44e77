"""Pictures do not depend on the user's Matplotlib settings."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest
from matplotlib.figure import Figure

from run_log.reporting.canvas import PictureError, drawing, save

PROGRAM = """
import sys
from pathlib import Path
from run_log.reporting.canvas import drawing, save
with drawing("x"):
    from matplotlib.figure import Figure
def make():
    figure = Figure()
    figure.subplots().set_title("title $x_e$")
    return figure
save(make, Path(sys.argv[1]))
"""
OTHERS = "text.usetex: True\nsavefig.format: pdf\nfigure.facecolor: red\nsavefig.dpi: 7\nbackend: gtk4agg\n"


def drawn(folder: Path, **environment: str) -> bytes:
    folder.mkdir(exist_ok=True)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(folder / "x.png")],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return (folder / "x.png").read_bytes()


@pytest.mark.long
def test_a_picture_is_the_same_under_any_settings(tmp_path: Path) -> None:
    plain = drawn(tmp_path / "plain")
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "matplotlibrc").write_text(OTHERS)
    assert drawn(tmp_path / "own", MPLBACKEND="nonsense") == plain
    elsewhere = tmp_path / "own" / "matplotlibrc"
    assert drawn(tmp_path / "named", MATPLOTLIBRC=str(elsewhere), MPLBACKEND="") == plain
    not_text = tmp_path / "bytes.rc"
    not_text.write_bytes(b"font.size: \xff\n")
    assert drawn(tmp_path / "bytes", MATPLOTLIBRC=str(not_text)) == plain
    for name in ("here", "home"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "matplotlibrc").write_bytes(not_text.read_bytes())
    assert drawn(tmp_path / "here") == plain
    assert drawn(tmp_path / "elsewhere", MPLCONFIGDIR=str(tmp_path / "home")) == plain


@pytest.mark.parametrize("command", [["experiment", "list"], ["report", "none.mcap"]])
def test_settings_that_are_not_utf_8_stop_no_command(tmp_path: Path, command: list[str]) -> None:
    (tmp_path / "matplotlibrc").write_bytes(b"font.size: \xff\n")
    done = subprocess.run(
        [sys.executable, "-m", "tandem", *command],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "Traceback" not in done.stderr
    assert (done.returncode == 0) == (command[0] == "experiment")


def test_the_current_folder_and_the_environment_do_not_change(tmp_path: Path) -> None:
    (tmp_path / "matplotlibrc").write_text("font.size: 31\n")
    code = (
        "import os\nfrom run_log.reporting.canvas import load_matplotlib\nload_matplotlib()\n"
        "import matplotlib\nassert matplotlib.rcParams['font.size'] == 10.0\n"
        "print(os.getcwd(), os.environ.get('MATPLOTLIBRC'), os.environ['MPLBACKEND'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "MPLBACKEND": "nonsense"},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.split() == [str(tmp_path.resolve()), "None", "nonsense"]


def test_settings_of_the_calling_program_do_not_change() -> None:
    with matplotlib.rc_context({"font.size": 31.0}):
        with drawing("x"):
            assert matplotlib.rcParams["font.size"] == matplotlib.rcParamsDefault["font.size"]
        assert matplotlib.rcParams["font.size"] == 31.0


def test_any_failure_of_a_picture_is_one_line(tmp_path: Path) -> None:
    def broken() -> Figure:
        figure = Figure()
        figure.text(0, 0, r"$\bad{$")
        return figure

    with pytest.raises(PictureError, match=r"x\.png: cannot be drawn: .*ValueError") as caught:
        save(broken, tmp_path / "x.png")
    assert len(str(caught.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_an_impossible_format_or_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(PictureError, match=r"x\.zzz: not a picture format; use \.png"):
        save(Figure, tmp_path / "x.zzz")
    (tmp_path / "file").write_text("")
    with pytest.raises(PictureError, match="cannot be written"):
        save(Figure, tmp_path / "file" / "x.png")
