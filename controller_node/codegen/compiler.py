"""Compiles CasADi functions to machine code, once per problem structure. Without a compiler functions are interpreted.

The key of the cache is the generated C, the compiler and its flags. The key is part of the library's *name*, because
the loader caches by path and would continue to run old code without notice. Concurrent starts are safe: a library gets
its name by an atomic rename, complete or not at all.

A loaded library runs code, and loading a damaged one can end the process. A library is therefore checked first: it and
its folder must belong to this user and be writable by no other, and its content must be unchanged.
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
REMEDY = "set XDG_CACHE_HOME to use another folder for the cache"
SEAL = b"\ntandem kernel, sha256 of name and content: "
"""Mark before the checksum at the end of a library. The loader ignores bytes that the ELF headers do not mention."""
LARGEST = 256 * 1024 * 1024
"""Largest size in bytes of a library that is read."""


class Compiler:
    """Turns CasADi functions into compiled ones with the same name and signature.

    Args:
        cache: folder of the libraries; None for the user's cache folder, or a temporary one if that is not writable.
        command: the compiler; None for the first of cc and gcc on the path.
    """

    def __init__(self, cache: Path | None = None, command: str | None = None):
        self._cache = cache
        self._command = command or shutil.which("cc") or shutil.which("gcc")
        self._complained = self._mended = False
        self.note = ""
        """The compiler of the functions, or the reason why none was used, for the log of a run."""

    def __call__(self, function: ca.Function) -> ca.Function:
        """Return the compiled function, or the function itself with one warning if it cannot be compiled."""
        try:
            library = self._library(function)
            try:
                compiled = ca.external(function.name(), str(library))
            except RuntimeError:
                # The result of a broken compiler must not be found again by a better one.
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
        with contextlib.suppress(OSError):  # checked and reported below
            make_private(wanted)
        if not (wanted.is_dir() and os.access(wanted, os.W_OK)):
            directory = Path(tempfile.gettempdir()) / f"tandem-kernels-{os.geteuid()}"
            make_private(directory)
        # Anyone who can write there decides which code runs here.
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
            log.warning("%s: its content has changed, so it is not loaded but compiled again", library)

    def _complain(self, reason: str) -> None:
        self.note = f"not compiled: {reason}"
        if not self._complained:
            self._complained = True
            log.warning("%s; %s", reason, COST)


class CannotCompile(Exception):
    """The reason why functions are interpreted."""


def sealed(content: bytes, name: str) -> bytes:
    """Return the file content of the library `name`: its code and the checksum of both."""
    return content + SEAL + _checksum(content, name)


def is_sealed(data: bytes, name: str) -> bool:
    """Return whether a file is exactly the one written for the library `name`."""
    content, mark, checksum = data.rpartition(SEAL)
    return bool(mark) and checksum == _checksum(content, name)


def _checksum(content: bytes, name: str) -> bytes:
    return hashlib.sha256(name.encode() + b"\0" + content).hexdigest().encode()


def _place(directory: Path, name: str) -> Path:
    """Return the path for the library, avoiding names of anything other than a regular file."""
    path = directory / name
    for number in count(2):
        if not os.path.lexists(path) or stat.S_ISREG(path.lstat().st_mode):
            break
        path = (directory / name).with_suffix(f".{number}.so")
    return path


def _read(library: Path) -> bytes | None:
    """Read a library in a trusted folder; None if it does not exist. Raises `CannotCompile` if others can write it."""
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
    """Return the instruction set of -march=native, because machines that share a cache may differ."""
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
