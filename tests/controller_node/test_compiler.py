"""Compiled kernels: the same numbers, cached by content, and never a reason to fail."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from controller_node.codegen.compiler import Compiler
from lbmpc.casadi_buffers import Bound
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.problem import build_problem
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


@pytest.mark.parametrize("name", ["linear", "l2nw", "dnn"])
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


def test_another_function_is_another_library_although_its_name_is_the_same(tmp_path: Path) -> None:
    x = ca.MX.sym("x")
    twice, thrice = (ca.Function("f", [x], [factor * x]) for factor in (2, 3))
    compiler = Compiler(tmp_path)
    assert float(compiler(twice)(1)) == 2
    assert float(compiler(thrice)(1)) == 3
    assert len(list(tmp_path.iterdir())) == 2


def test_concurrent_starts_leave_one_whole_library(tmp_path: Path) -> None:
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
def test_a_broken_compiler_costs_speed_and_one_line(
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


def test_without_a_compiler_one_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    compiler = Compiler(tmp_path)
    assert not is_compiled(compiler(small()))
    assert "no C compiler" in caplog.text


@pytest.mark.skipif(os.geteuid() == 0 and not Path("/proc").exists(), reason="needs a directory that refuses")
def test_a_cache_that_cannot_be_written_is_replaced_by_a_temporary_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    blocked = tmp_path / "file"
    blocked.write_text("not a directory")
    assert is_compiled(Compiler(blocked / "cache")(small()))


def test_new_weights_rebuild_nothing_and_are_written_in_place(tmp_path: Path) -> None:
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
