"""Builds the wheel and the source distribution from a copy of the sources, because a build leaves files behind."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

from tests.helpers.paths import ROOT

INSTALLED = (
    *("network_model", "lbmpc", "protocol", "node_runtime", "controller_node", "trainer_node", "plant_sim"),
    *("run_log", "tandem"),
)
"""The packages that the wheel contains."""
BESIDE = ("benchmarks", "verification", "tests", "configs")
"""Other folders that a build reads."""
_CACHES = shutil.ignore_patterns("__pycache__", "*.egg-info")


def copy_sources(folder: Path) -> Path:
    """Copy the sources into a new folder; links stay links."""
    for name in (*INSTALLED, *BESIDE):
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=_CACHES)
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, folder)
    return folder


def build_wheel(sources: Path, out: Path) -> Path:
    """Build the wheel of these sources in `out`; return its path."""
    return _build("wheel", sources, out)


def unpacked_sdist(sources: Path, out: Path) -> Path:
    """Build and unpack the source distribution in `out`; return the folder."""
    with tarfile.open(_build("sdist", sources, out)) as archive:
        archive.extractall(out, filter="data")
    (folder,) = (path for path in out.iterdir() if path.is_dir())
    return folder


def _build(kind: str, sources: Path, out: Path) -> Path:
    out.mkdir(parents=True)
    program = f"import sys; from setuptools.build_meta import build_{kind} as build; build(sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", program, str(out)], cwd=sources, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (built,) = out.iterdir()
    return built
