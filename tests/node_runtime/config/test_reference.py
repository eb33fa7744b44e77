"""Objects named by references: loading, refusals, and error messages."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

from node_runtime.config.reference import absolute, is_reference, load, loaded, sha256_of_imports
from node_runtime.config.strict import ConfigError
from tests.helpers.paths import ROOT

TANKS = "HEIGHT = 3\nTANKS, OTHER = {'height': HEIGHT}, {}\n"


def is_table(value: object) -> bool:
    return isinstance(value, dict)


def message(reference: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(reference, is_table, "plant")
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    (tmp_path / "tanks.py").write_text(TANKS)
    return tmp_path


def test_object_of_a_file(here: Path):
    assert load("tanks.py:TANKS") == {"height": 3}
    assert load(f"{here}/tanks.py:TANKS", is_table, "plant") == {"height": 3}


def test_file_is_identified_by_its_hash(here: Path):
    of = loaded("tanks.py:TANKS")
    assert (of.file, of.sha256) == (str(here / "tanks.py"), hashlib.sha256(TANKS.encode()).hexdigest())


def test_file_runs_once_until_it_changes(here: Path):
    first = load("tanks.py:TANKS")
    assert load("tanks.py:TANKS") is first
    (here / "tanks.py").write_text("TANKS = {'height': 4}\n")
    assert load("tanks.py:TANKS") == {"height": 4}


def test_loading_creates_no_other_files(here: Path):
    load("tanks.py:TANKS")
    assert [file.name for file in here.iterdir()] == ["tanks.py"]


def test_file_named_as_an_installed_module_replaces_nothing(here: Path):
    (here / "json.py").write_text("import json\nPLANT = {'loads': json.loads('[1]')}\n")
    program = (
        "import sys; sys.path.remove('') if '' in sys.path else None\n"
        "from node_runtime.config.reference import load\n"
        f"print(load({str(here / 'json.py')!r} + ':PLANT'), sys.modules['json'].__file__)"
    )
    # This needs a new process, because the present one has imported json already.
    done = subprocess.run(
        [sys.executable, "-P", "-c", program],
        env={"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.startswith("{'loads': [1]} ")
    assert str(here) not in done.stdout


def test_file_imports_its_neighbours_after_installed_modules(here: Path, monkeypatch: pytest.MonkeyPatch):
    folder = here / "plants"
    folder.mkdir()
    (folder / "neighbour_of_one.py").write_text("LENGTH = 2\n")
    (folder / "msgspec.py").write_text("raise SystemExit('imported from the folder of a plant file')\n")
    (folder / "one.py").write_text(
        "import msgspec\nfrom neighbour_of_one import LENGTH\nPLANT = {'length': LENGTH}\n"
    )
    assert load("plants/one.py:PLANT") == {"length": 2}
    assert sys.path[-1] == str(folder)
    # Only the file may import it, because it is not an installed package.
    assert "no package called 'neighbour_of_one' is installed" in message("neighbour_of_one:LENGTH")


def test_imports_from_the_folder_of_a_file_are_found_without_running_them(here: Path):
    (here / "tanks.py").write_text("import numpy, package.parts\n\ndef late():\n    from valve import V\n")
    (here / "valve.py").write_text("import tanks, gone, wrong\nraise SystemExit('was run')\n")
    (here / "other.py").write_text("X = 1\n")
    (here / "package").mkdir()
    (here / "package" / "parts.py").write_text("X = 1\n")
    (here / "wrong.py").write_text("not Python\n")
    found = sha256_of_imports(f"{here}/tanks.py:TANKS")
    assert sorted(found) == ["valve.py", "wrong.py"]
    assert found["valve.py"] == hashlib.sha256((here / "valve.py").read_bytes()).hexdigest()
    assert sha256_of_imports("tandem.loop:Loop") == sha256_of_imports("gone.py:TANKS") == {}


def test_object_of_an_installed_package(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
):
    site = tmp_path_factory.mktemp("site")
    (site / "mypackage_of_tests").mkdir()
    (site / "mypackage_of_tests" / "__init__.py").touch()
    (site / "mypackage_of_tests" / "module.py").write_text("PLANT = {'of': 'package'}\n")
    monkeypatch.setattr(sys, "path", [*sys.path, str(site)])
    of = loaded("mypackage_of_tests.module:PLANT")
    assert of.value == {"of": "package"}
    assert of.sha256 == hashlib.sha256(b"PLANT = {'of': 'package'}\n").hexdigest()
    said = message("mypackage_of_tests.modul:PLANT")
    assert said == "mypackage_of_tests.modul: mypackage_of_tests has no module called 'modul'"


def test_package_of_the_current_folder_is_not_installed(here: Path):
    assert message("tanks:TANKS") == (
        "tanks: no package called 'tanks' is installed; did you mean 'tanks.py:TANKS'?"
    )
    (here / "other").mkdir()
    (here / "other" / "__init__.py").write_text("PLANT = {}\n")
    assert "no package called 'other' is installed" in message("other:PLANT")


@pytest.mark.parametrize(
    ("reference", "text"),
    [
        ("tank.py:TANKS", "{here}/tank.py: no such file; did you mean 'tanks.py'?"),
        ("{here}/x/tanks.py:TANKS", "{here}/x/tanks.py: no such file"),
        ("tanks.py:TANK", "tanks.py:TANK: tanks.py has nothing called 'TANK'; did you mean 'TANKS'?"),
        ("tanks.py:PLANT", "tanks.py:PLANT: tanks.py has nothing called 'PLANT'; it has TANKS, OTHER"),
        ("tanks.py:HEIGHT", "tanks.py:HEIGHT: HEIGHT is no plant but of type int; it has TANKS, OTHER"),
        ("tanks.py", "tanks.py: give the name of the plant: write tanks.py:TANKS; it has TANKS, OTHER"),
        (
            "./tanks:TANKS",
            "neither a file that ends in .py nor the name of a package; did you mean './tanks.py:TANKS'?",
        ),
        (
            "notes.txt:TANKS",
            "no package called 'notes' is installed; the name of a file with code ends in .py",
        ),
        (":TANKS", "neither a file that ends in .py nor the name of a package"),
        (".", "neither a file that ends in .py nor the name of a package"),
        ("a\0.py:TANKS", "cannot be read: embedded null byte"),
        ("x" * 300 + ".py:TANKS", ".py: cannot be read: File name too long"),
        ("x" * 300 + ":TANKS", "is installed; a file is written as tanks.py:TANKS"),
        (
            "nowhere:TANKS",
            "nowhere: no package called 'nowhere' is installed; a file is written as tanks.py:TANKS",
        ),
    ],
)
def test_mistakes_in_a_reference(here: Path, reference: str, text: str):
    (here / "notes.txt").touch()
    assert text.format(here=here) in message(reference.format(here=here))


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("\nTANKS = 1 / 0\n", "{file}, line 2: ZeroDivisionError: division by zero"),
        ("def f():\n    return int('x')\nf()\n", "{file}, line 2: ValueError: invalid literal"),
        ("\n\nraise ValueError('two\\nlines')\n", "{file}, line 3: ValueError: two lines"),
        (
            "import absent_module_of_tests\n",
            "{file}, line 1: ModuleNotFoundError: No module named 'absent_module",
        ),
        ("import sys\nsys.exit(3)\n", "{file}, line 2: SystemExit: 3"),
        ("import numpy\nnumpy.zeros(2) @ numpy.zeros(3)\n", "{file}, line 2: ValueError: matmul"),
        ("TANKS = {\n", "{file}, line 1: not valid Python: '{{' was never closed"),
        ("TANKS = 1\x00", "{file}: "),
    ],
)
def test_file_that_raises(here: Path, source: str, text: str):
    file = here / "bad.py"
    file.write_text(source)
    assert message("bad.py:TANKS").startswith(text.format(file=file))
    assert message("bad.py:TANKS").startswith(text.format(file=file))
    # Nothing of the failed load remains, so the corrected file is loaded.
    file.write_text(TANKS)
    assert load("bad.py:TANKS") == {"height": 3}


def test_file_that_cannot_be_read(here: Path):
    (here / "folder.py").mkdir()
    assert message("folder.py:PLANT") == f"{here}/folder.py: cannot be read: Is a directory"


def test_interruption_is_not_an_error_of_the_file(here: Path):
    (here / "slow.py").write_text("raise KeyboardInterrupt\n")
    with pytest.raises(KeyboardInterrupt):
        load("slow.py:PLANT")


def test_reference_or_shipped_name():
    assert [is_reference(text) for text in ("tanks.py:TANKS", "mypackage:PLANT", "tanks.py", "./tanks")] == [
        True
    ] * 4
    assert not is_reference("moore_greitzer")


def test_absolute(here: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", "/home/me")
    assert absolute("tanks.py:TANKS", here) == f"{here}/tanks.py:TANKS"
    assert absolute("../a/tanks.py", here / "b") == f"{here}/a/tanks.py"
    assert absolute("/elsewhere/tanks.py:TANKS", here) == "/elsewhere/tanks.py:TANKS"
    assert absolute("~/tanks.py:TANKS", here) == "/home/me/tanks.py:TANKS"
    assert absolute("mypackage.module:PLANT", here) == "mypackage.module:PLANT"
    with pytest.raises(ConfigError, match="no home folder of ~no-such-user is known"):
        absolute("~no-such-user/tanks.py:TANKS", here)
