"""Compiles CasADi functions to machine code, once for each problem structure; without a compiler nothing breaks.

The cache is keyed by the content of the generated C, the compiler and its flags. The key is in the library's *name*,
because the loader caches by path and would silently go on running old code. Concurrent starts are safe: a library
appears under its name by an atomic rename, whole or not at all.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import casadi as ca

from controller_node.codegen.fast_loops import with_fast_loops

log = logging.getLogger(__name__)

FLAGS = (
    "-shared",
    "-fPIC",
    "-O3",
    "-march=native",
    "-fno-semantic-interposition",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-lm",
)
TIMEOUT = 300.0
COST = "solves in CasADi's virtual machine instead, about 4 times slower"


class Compiler:
    """Turns CasADi functions into compiled ones with the same name and signature.

    Args:
        cache: where libraries are kept; None: the user's cache directory, or a temporary one where that
            cannot be written.
        command: the compiler; None: the first of cc and gcc on the path.
    """

    def __init__(self, cache: Path | None = None, command: str | None = None):
        self._cache = cache
        self._command = command or shutil.which("cc") or shutil.which("gcc")
        self._complained = False
        self.note = ""
        """Which compiler made the functions, or why none did; for the log of a run."""

    def __call__(self, function: ca.Function) -> ca.Function:
        """The compiled function, or the function itself where it cannot be compiled, with one warning."""
        try:
            library = self._library(function)
            compiled = ca.external(function.name(), str(library))
        except (OSError, subprocess.SubprocessError, RuntimeError, CannotCompile) as error:
            self._complain(_reason(error))
            return function
        return compiled

    def _library(self, function: ca.Function) -> Path:
        if self._command is None:
            raise CannotCompile("no C compiler on this machine")
        source = _source(function)
        version = _version(self._command)
        key = "\n".join([source, version, *FLAGS, _processor()])
        name = f"{function.name()}-{hashlib.sha256(key.encode()).hexdigest()[:24]}.so"
        self.note = self.note or f"compiled with {version}"
        directory = self._directory()
        library = directory / name
        if library.is_file():
            return library
        with tempfile.TemporaryDirectory(dir=directory) as work:
            text, built = Path(work) / "kernel.c", Path(work) / name
            text.write_text(source)
            subprocess.run(
                [self._command, str(text), "-o", str(built), *FLAGS],
                check=True,
                capture_output=True,
                text=True,
                timeout=TIMEOUT,
            )
            built.replace(library)
        return library

    def _directory(self) -> Path:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        wanted = self._cache or Path(home) / "tandem" / "kernels"
        try:
            wanted.mkdir(parents=True, exist_ok=True)
            if os.access(wanted, os.W_OK):
                return wanted
        except OSError:
            pass
        fallback = Path(tempfile.gettempdir()) / f"tandem-kernels-{os.getuid()}"
        fallback.mkdir(mode=0o700, exist_ok=True)
        # Someone else's directory of that name must not decide what code runs here.
        if fallback.stat().st_uid != os.getuid():
            raise CannotCompile(f"{wanted} cannot be written and {fallback} belongs to somebody else")
        return fallback

    def _complain(self, reason: str) -> None:
        self.note = f"not compiled: {reason}"
        if not self._complained:
            self._complained = True
            log.warning("%s; %s", reason, COST)


class CannotCompile(Exception):
    """Why functions stay in the virtual machine."""


def _source(function: ca.Function) -> str:
    generator = ca.CodeGenerator("kernel.c", {"with_header": False})
    generator.add(function)
    return with_fast_loops(generator.dump())


def _version(command: str) -> str:
    answer = subprocess.run([command, "--version"], check=True, capture_output=True, text=True, timeout=20)
    if not answer.stdout:
        raise CannotCompile(f"{command} does not say its version")
    return answer.stdout.splitlines()[0]


def _processor() -> str:
    """Which instructions -march=native may use here: a cache shared between machines must not mix them."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


def _reason(error: Exception) -> str:
    if isinstance(error, subprocess.CalledProcessError):
        lines = [line for line in str(error.stderr).splitlines() if line.strip()]
        return f"the C compiler failed ({lines[-1][:200] if lines else f'exit {error.returncode}'})"
    if isinstance(error, subprocess.TimeoutExpired):
        return f"the C compiler did not finish within {TIMEOUT:.0f} s"
    return f"cannot compile: {error}"
