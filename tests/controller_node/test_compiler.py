"""Compiled kernels: equal numbers, a cache by content, and no failures."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from controller_node.codegen.compiler import Compiler, is_sealed
from lbmpc.casadi_buffers import Bound
from lbmpc.problem import build_problem
from lbmpc.solver.gauss_newton import Solver
from tests.helpers.paths import ROOT
from tests.helpers.science import compressor, function, oracle_named, trained_theta

MODEL = compressor()


def small() -> ca.Function:
    x = ca.MX.sym("x", 3, 11)
    a = ca.MX.sym("a", 7, 3)
    return ca.Function("small", [a, x], [ca.tanh(a @ x), a.T @ (a @ x)], ["a", "x"], ["y", "z"])


def is_compiled(f: ca.Function) -> bool:
    return "External" in f.class_name()


def evaluate(f: ca.Function, a: np.ndarray, x: np.ndarray) -> list[np.ndarray]:
    return [np.array(value) for value in f(a, x)]


def test_products_and_tanh_agree_with_the_virtual_machine(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    compiler = Compiler(tmp_path)
    shapes = [(1, 1, 1), (4, 4, 1), (8, 3, 4), (9, 5, 13), (32, 32, 300), (47, 7, 19), (47, 6, 1), (17, 2, 8)]
    for rows, inner, columns in shapes:
        a, x = ca.MX.sym("a", rows, inner), ca.MX.sym("x", inner, columns)
        f = ca.Function(f"p{rows}_{columns}", [a, x], [a @ x, ca.tanh(a @ x)])
        g = compiler(f)
        assert is_compiled(g)
        for size in (1e-3, 1.0, 30.0, 1e6):
            values = rng.normal(size=(rows, inner)) * size, rng.normal(size=(inner, columns))
            for ours, theirs in zip(evaluate(g, *values), evaluate(f, *values), strict=True):
                np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-14 * (1 + size))
    bad = evaluate(g, np.full((17, 2), np.nan), np.ones((2, 8)))
    assert np.isnan(bad[0]).all()
    assert np.isnan(bad[1]).all()
    wide = evaluate(g, np.full((17, 2), np.inf), np.ones((2, 8)))
    np.testing.assert_array_equal(wide[1], 1.0)


@pytest.mark.parametrize("name", ["linear", "constant", "l2nw", "dnn"])
def test_the_solver_gives_the_same_optimum_compiled(name: str, tmp_path: Path) -> None:
    oracle = oracle_named(name, MODEL)
    problem = build_problem(MODEL, oracle, 8)
    compiled, plain = Solver(problem, 30, 1e-10, Compiler(tmp_path)), Solver(problem, 30, 1e-10)
    theta = trained_theta(oracle, np.random.default_rng(0), size=0.003)
    for x in ([-0.35, -0.4, 0.0, 0.0], [0.1, 0.1, 0.0, 0.0]):
        a = compiled.solve(np.array(x), theta, np.zeros((8, 1)))
        b = plain.solve(np.array(x), theta, np.zeros((8, 1)))
        assert a.status == b.status
        np.testing.assert_allclose(a.v, b.v, atol=1e-9)


def test_a_second_start_compiles_nothing(tmp_path: Path) -> None:
    Compiler(tmp_path)(small())
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert len(before) == 1
    Compiler(tmp_path)(small())
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before


def test_functions_of_one_name_have_separate_libraries(tmp_path: Path) -> None:
    x = ca.MX.sym("x")
    twice, thrice = (ca.Function("f", [x], [factor * x]) for factor in (2, 3))
    compiler = Compiler(tmp_path)
    assert float(compiler(twice)(1)) == 2
    assert float(compiler(thrice)(1)) == 3
    assert len(list(tmp_path.iterdir())) == 2


def test_concurrent_starts_leave_one_complete_library(tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; sys.path.insert(0, sys.argv[2]);"
        "from tests.controller_node.test_compiler import small, is_compiled, Compiler; import numpy as np;"
        "f = Compiler(Path(sys.argv[1]))(small());"
        "print(is_compiled(f), float(np.array(f(np.ones((7, 3)), np.ones((3, 11)))[1]).sum()))"
    )
    command = [sys.executable, "-c", script, str(tmp_path), str(ROOT)]
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda _: subprocess.run(command, capture_output=True, text=True), range(4)))
    assert {run.stdout.strip() for run in runs} == {f"True {7 * 3 * 3 * 11}.0"}, [run.stderr for run in runs]
    assert [path.suffix for path in tmp_path.iterdir()] == [".so"]


def script(path: Path, body: str) -> str:
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("exit 1", "cannot compile|compiler failed"),
        ('if [ "$1" = --version ]; then echo fake 1; else echo "no disk" >&2; exit 1; fi', "no disk"),
        ('if [ "$1" = --version ]; then echo fake 2; else echo garbage > "$3"; fi', "cannot compile"),
        ('if [ "$1" = --version ]; then echo fake 3; fi', "cannot compile"),
        ("", "does not say its version"),
    ],
)
def test_a_broken_compiler_gives_one_warning_and_slower_functions(
    body: str, reason: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    compiler = Compiler(tmp_path / "cache", script(tmp_path / "cc", body))
    with caplog.at_level(logging.WARNING):
        f, g = compiler(small()), compiler(small())
    assert not is_compiled(f)
    assert np.array(g(np.ones((7, 3)), np.ones((3, 11)))[1]).sum() == 7 * 3 * 3 * 11
    assert len(caplog.records) == 1
    assert "virtual machine" in caplog.text
    import re

    assert re.search(reason, caplog.text)
    assert compiler.note.startswith("not compiled")


def test_without_a_compiler_there_is_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    compiler = Compiler(tmp_path)
    assert not is_compiled(compiler(small()))
    assert "no C compiler" in caplog.text


@pytest.mark.skipif(
    os.geteuid() == 0 and not Path("/proc").exists(), reason="needs a directory that is not writable"
)
def test_a_cache_that_cannot_be_written_is_replaced_by_a_temporary_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    blocked = tmp_path / "file"
    blocked.write_text("not a directory")
    assert is_compiled(Compiler(blocked / "cache")(small()))


def test_new_weights_recompile_nothing(tmp_path: Path) -> None:
    oracle = oracle_named("dnn", MODEL)
    bound = Bound(Compiler(tmp_path)(function(oracle)))
    rng = np.random.default_rng(1)
    for _ in range(3):
        theta = trained_theta(oracle, rng)
        bound.inputs["theta"][:, 0] = theta
        bound()
        fresh = function(oracle)(np.zeros(4), np.zeros(1), theta)
        np.testing.assert_allclose(bound.outputs["h"], np.array(fresh[0]), atol=1e-16)
    assert len(list(tmp_path.iterdir())) == 1


# -- damaged libraries ---------------------------------------------------------------------------------------

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another user")
OTHER_USER = 12345


def built(cache: Path) -> Path:
    """Return the library of `small` in a cache."""
    assert is_compiled(Compiler(cache)(small()))
    (library,) = cache.glob("small-*.so")
    return library


def replaced(library: Path, content: bytes) -> None:
    """Replace a file by a new inode, because this process may have the old one mapped."""
    library.unlink()
    library.write_bytes(content)
    library.chmod(0o600)


def runs_compiled(cache: Path, caplog: pytest.LogCaptureFixture) -> bool:
    """Return whether a start uses compiled code, after checking its results; `caplog` has the log lines."""
    caplog.clear()
    with caplog.at_level(logging.INFO):
        f = Compiler(cache)(small())
    assert float(evaluate(f, np.ones((7, 3)), np.ones((3, 11)))[1].sum()) == 7 * 3 * 3 * 11
    return is_compiled(f)


@pytest.mark.parametrize(
    "damaged",
    [
        lambda whole: whole[:5000],
        lambda whole: b"",
        lambda whole: os.urandom(len(whole)),
        lambda whole: whole[: len(whole) // 2] + b"\0" * 64 + whole[len(whole) // 2 + 64 :],
        lambda whole: whole[:-100],  # as written by a version without checksums
        lambda whole: whole[:-1],
    ],
    ids=["cut", "empty", "garbage", "one block of zeros", "no checksum", "cut checksum"],
)
def test_a_damaged_library_is_detected_and_compiled_again(
    damaged: Callable[[bytes], bytes], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    library = built(tmp_path)
    replaced(library, damaged(library.read_bytes()))
    assert runs_compiled(tmp_path, caplog)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert f"{library}: its content has changed" in caplog.text
    assert runs_compiled(tmp_path, caplog)
    assert not caplog.records


def test_a_library_cut_in_place_does_not_end_the_next_process(tmp_path: Path) -> None:
    library = built(tmp_path)
    content = library.read_bytes()
    replaced(library, content)
    os.truncate(library, 5000)
    code = (
        "import sys; from pathlib import Path; from tests.controller_node.test_compiler import *;"
        "print(is_compiled(Compiler(Path(sys.argv[1]))(small())))"
    )
    run = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, cwd=ROOT)
    assert (run.returncode, run.stdout) == (0, "True\n"), run.stderr
    assert is_sealed(library.read_bytes(), library.name)


def test_a_library_under_another_name_is_not_loaded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    x = ca.MX.sym("x")
    Compiler(tmp_path)(ca.Function("f", [x], [2 * x]))
    (other,) = tmp_path.iterdir()
    replaced(library := built(tmp_path), other.read_bytes())
    assert runs_compiled(tmp_path, caplog)
    assert f"{library}: its content has changed" in caplog.text


def test_several_damaged_libraries_give_one_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    x = ca.MX.sym("x")
    functions = [ca.Function("f", [x], [factor * x]) for factor in (2, 3)]
    for one in functions:
        Compiler(tmp_path)(one)
    for library in tmp_path.iterdir():
        replaced(library, b"")
    compiler = Compiler(tmp_path)
    assert [float(compiler(one)(1)) for one in functions] == [2, 3]
    assert len(caplog.records) == 1


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo, lambda path: path.symlink_to("elsewhere")])
def test_other_kinds_of_files_are_kept_and_avoided(
    make: Callable[[Path], None], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    library = built(tmp_path)
    library.unlink()
    make(library)
    kind = library.lstat().st_mode
    for _ in range(2):
        assert runs_compiled(tmp_path, caplog)
    assert library.lstat().st_mode == kind
    assert sorted(tmp_path.iterdir()) == sorted([library, library.with_suffix(".2.so")])


def test_the_output_of_a_broken_compiler_is_not_reused(tmp_path: Path) -> None:
    cache, name = tmp_path / "cache", 'if [ "$1" = --version ]; then cc --version'
    command = script(tmp_path / "cc", f'{name}; else echo garbage > "$3"; fi')
    assert not is_compiled(Compiler(cache, command)(small()))
    script(tmp_path / "cc", f'{name}; else exec cc "$@"; fi')
    assert is_compiled(Compiler(cache, command)(small()))


# -- ownership -----------------------------------------------------------------------------------------------


def test_only_the_owner_can_use_the_cache_for_any_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        library = built(tmp_path / "new" / "cache")
    finally:
        os.umask(before)
    for path in (library, library.parent, library.parent.parent):
        assert path.stat().st_mode & 0o077 == 0


def group_may_write(path: Path) -> None:
    path.chmod(path.stat().st_mode | 0o020)


def all_may_write(path: Path) -> None:
    path.chmod(0o777)


def of_another_user(path: Path) -> None:
    os.chown(path, OTHER_USER, -1)


def a_link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


@pytest.mark.parametrize(
    ("what", "change", "reason"),
    [
        ("folder", group_may_write, "can be written by others (mode 0720): chmod go-w"),
        ("folder", all_may_write, "can be written by others (mode 0777): chmod go-w"),
        ("folder", a_link, "is a link"),
        ("above", all_may_write, "which all users can write to"),
        ("library", group_may_write, "can be written by others (mode 0620): chmod go-w"),
        pytest.param("folder", of_another_user, "belongs to user 12345", marks=needs_root),
        pytest.param("above", of_another_user, "which belongs to user 12345", marks=needs_root),
        pytest.param("library", of_another_user, "belongs to user 12345", marks=needs_root),
    ],
)
def test_files_that_others_can_write_are_not_loaded(
    what: str, change: Callable[[Path], None], reason: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache = tmp_path / "above" / "cache"
    library = built(cache)
    change({"library": library, "folder": cache, "above": cache.parent}[what])
    assert not runs_compiled(cache, caplog)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert reason in caplog.text
    assert "virtual machine" in caplog.text


def test_a_cache_of_our_own_below_a_sticky_folder_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tmp_path.chmod(0o1777)
    built(tmp_path / "cache")
    assert runs_compiled(tmp_path / "cache", caplog)


@pytest.mark.parametrize("change", [a_link, pytest.param(of_another_user, marks=needs_root), all_may_write])
def test_the_temporary_folder_is_checked_without_following_links(
    change: Callable[[Path], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "file").write_text("no folder")
    wanted = tmp_path / "file" / "cache"
    built_there = tmp_path / f"tandem-kernels-{os.geteuid()}"
    built(built_there)
    assert runs_compiled(wanted, caplog)
    change(built_there)
    assert not runs_compiled(wanted, caplog)
    assert f"{wanted} cannot be written, and {built_there}" in caplog.text


def test_a_cache_mounted_noexec_is_reported_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    real = os.statvfs(tmp_path)
    mounted = os.statvfs_result((*real[:8], real.f_flag | os.ST_NOEXEC, real.f_namemax))
    monkeypatch.setattr(os, "statvfs", lambda path: mounted)
    assert not runs_compiled(tmp_path, caplog)
    assert "mounted noexec" in caplog.text
    assert "XDG_CACHE_HOME" in caplog.text
