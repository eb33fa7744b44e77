"""Compiles CasADi functions to machine code, once for each problem structure; without a compiler nothing breaks.

The cache is keyed by the content of the generated C, the compiler and its flags. The key is in the library's *name*,
because the loader caches by path and would silently go on running old code. Concurrent starts are safe: a library
appears under its name by an atomic rename, whole or not at all.

What is loaded runs, and what is damaged may end the process while it is loaded. So a library is looked at before:
it and its folder belong to this user and nobody else can write there, and its content is what was written.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import stat
import subprocess
import tempfile
from itertools import count
from pathlib import Path

import casadi as ca

from controller_node.codegen.fast_loops import with_fast_loops
from node_runtime.private_folder import make_private, why_not_ours, why_not_private
from node_runtime.whole_file import read_regular, write_whole

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
REMEDY = "XDG_CACHE_HOME names another folder for the cache"
SEAL = b"\ntandem kernel, sha256 of name and content: "
"""Behind it, at the end of a library, is the checksum. The loader reads what an ELF file's headers name, no further."""
LARGEST = 256 * 1024 * 1024
"""Bytes of a library that is read at all."""


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
        self._complained = self._mended = False
        self.note = ""
        """Which compiler made the functions, or why none did; for the log of a run."""

    def __call__(self, function: ca.Function) -> ca.Function:
        """The compiled function, or the function itself where it cannot be compiled, with one warning."""
        try:
            library = self._library(function)
            try:
                compiled = ca.external(function.name(), str(library))
            except RuntimeError:
                # What a broken compiler made must not be found again when there is a better one.
                library.unlink()
                raise
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
        library = _place(directory, name)
        if (data := _read(library)) is not None:
            if is_sealed(data, library.name):
                return library
            self._mend(library)
        with tempfile.TemporaryDirectory(dir=directory) as work:
            text, built = Path(work) / "kernel.c", Path(work) / name
            text.write_text(source)
            subprocess.run(
                [self._command, str(text), "-o", str(built), *FLAGS],
                check=True,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=TIMEOUT,
            )
            write_whole(library, sealed(built.read_bytes(), library.name), mode=0o600)
        return library

    def _directory(self) -> Path:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        wanted = self._cache or Path(home) / "tandem" / "kernels"
        directory = wanted
        with contextlib.suppress(OSError):  # said below, by what is there or not
            make_private(wanted)
        if not (wanted.is_dir() and os.access(wanted, os.W_OK)):
            directory = Path(tempfile.gettempdir()) / f"tandem-kernels-{os.geteuid()}"
            make_private(directory)
        # Whoever can write there decides what code runs here.
        if (reason := why_not_private(directory)) is not None:
            elsewhere = "" if directory == wanted else f"{wanted} cannot be written, and "
            raise CannotCompile(f"no place for compiled code: {elsewhere}{reason}; {REMEDY}")
        if os.statvfs(directory).f_flag & os.ST_NOEXEC:
            raise CannotCompile(
                f"{directory} is on a file system mounted noexec, where no code may run; {REMEDY}"
            )
        return directory

    def _mend(self, library: Path) -> None:
        if not self._mended:
            self._mended = True
            log.warning("%s: is not as it was written, and is not loaded; compiled again", library)

    def _complain(self, reason: str) -> None:
        self.note = f"not compiled: {reason}"
        if not self._complained:
            self._complained = True
            log.warning("%s; %s", reason, COST)


class CannotCompile(Exception):
    """Why functions stay in the virtual machine."""


def sealed(content: bytes, name: str) -> bytes:
    """What is written for the library `name`: its content, and the checksum of both."""
    return content + SEAL + _checksum(content, name)


def is_sealed(data: bytes, name: str) -> bool:
    """Whether a file holds exactly what was once written for the library `name`."""
    content, mark, checksum = data.rpartition(SEAL)
    return bool(mark) and checksum == _checksum(content, name)


def _checksum(content: bytes, name: str) -> bytes:
    return hashlib.sha256(name.encode() + b"\0" + content).hexdigest().encode()


def _place(directory: Path, name: str) -> Path:
    """Where the library goes: beside whatever else than a file has its name."""
    path = directory / name
    for number in count(2):
        if not os.path.lexists(path) or stat.S_ISREG(path.lstat().st_mode):
            break
        path = (directory / name).with_suffix(f".{number}.so")
    return path


def _read(library: Path) -> bytes | None:
    """A library in a folder of ours; None where there is none. Raises `CannotCompile`: others may have written it."""
    try:
        status = library.lstat()
    except FileNotFoundError:
        return None
    if (reason := why_not_ours(library, status)) is not None:
        raise CannotCompile(f"compiled code that is not trusted: {reason}; remove it")
    return read_regular(library, LARGEST)


def _source(function: ca.Function) -> str:
    generator = ca.CodeGenerator("kernel.c", {"with_header": False})
    generator.add(function)
    return with_fast_loops(generator.dump())


def _version(command: str) -> str:
    answer = subprocess.run(
        [command, "--version"], check=True, capture_output=True, text=True, errors="replace", timeout=20
    )
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
