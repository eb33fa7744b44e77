"""User objects that a configuration names: "tanks.py:TANKS" in a file, "mypackage.module:PLANT" in a package.

Only a configuration may name code. Code named in a log is never loaded.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from node_runtime.config.strict import ConfigError, did_you_mean

PREFIX = "tandem_reference_"
"""Prefix of the module names of loaded files, so that they cannot replace an installed module."""
APPENDED = "__tandem_appended__"
"""Attribute of such a module: the folder that was added to `sys.path` for it."""
LONGEST_TEXT = 300


class Loaded(NamedTuple):
    """An object and its file."""

    value: Any
    file: str
    """Path of the file; "" for a package without a file."""
    sha256: str
    """SHA-256 of the file's bytes when it was loaded, in hexadecimal."""


def load(reference: str, fits: Callable[[Any], bool] | None = None, what: str = "object") -> Any:
    """Return the object of `reference`: "tanks.py:TANKS", "/abs/tanks.py:TANKS" or "mypackage.module:PLANT".

    If a file contains exactly one such object, its name may be omitted.

    A file runs once per process as long as its content does not change. Its folder is appended to `sys.path`, so it may
    import its neighbours, but they cannot replace installed modules. A package must be installed; the current folder
    and the folders of loaded files are not searched.

    Args:
        reference: the reference.
        fits: returns whether an object is of the right kind.
        what: the kind in a word for messages, such as "plant".

    Raises:
        ConfigError: the object does not exist or is of another kind, or its code raises an exception.
    """
    return loaded(reference, fits, what).value


def loaded(reference: str, fits: Callable[[Any], bool] | None = None, what: str = "object") -> Loaded:
    """Return the object as `load` does, together with its file."""
    place, name = _parts(reference)
    if place.endswith(".py"):
        module, sha256 = _from_file(Path(os.path.expanduser(place)))
    else:
        module, sha256 = _from_package(place, name)
    there = [key for key in vars(module) if not key.startswith("_")]
    right = [key for key in there if fits is None or fits(getattr(module, key))]
    few = ", ".join(right[:10]) + (", ..." if len(right) > 10 else "")
    known = f"it has {few}" if right else f"it has no {what}"
    if not name and len(right) == 1:
        name = right[0]
    if not name:
        example = f"write {place}:{right[0] if right else 'NAME'}"
        raise ConfigError(f"{reference}: give the name of the {what}: {example}; {known}")
    if name not in there:
        hint = did_you_mean(name, right, known)
        raise ConfigError(f"{reference}: {place} has nothing called {name!r}; {hint}")
    value = getattr(module, name)
    if fits is not None and name not in right:
        raise ConfigError(f"{reference}: {name} is no {what} but {_kind(value)}; {known}")
    return Loaded(value, getattr(module, "__file__", None) or "", sha256)


def sha256_of(reference: str) -> str | None:
    """Return the SHA-256 of the file without running it; None if it does not exist or its package is not loaded."""
    place, _name = _parts(reference)
    file = (
        os.path.expanduser(place)
        if place.endswith(".py")
        else getattr(sys.modules.get(place), "__file__", None)
    )
    try:
        return hashlib.sha256(Path(file or "").read_bytes()).hexdigest()
    except (OSError, ValueError):
        return None


def sha256_of_imports(reference: str) -> dict[str, str]:
    """Return the SHA-256 of the modules beside a file that it imports, by file name. Their imports count too.

    Nothing is run. Packages in the folder do not count, nor do references to packages.
    """
    place, _name = _parts(reference)
    first = Path(os.path.expanduser(place))
    found: dict[str, str] = {}
    todo = [first] if place.endswith(".py") else []
    while todo:
        path = todo.pop()
        try:
            source = path.read_bytes()
        except (OSError, ValueError):
            continue
        found[path.name] = hashlib.sha256(source).hexdigest()
        beside = {first.parent / f"{name}.py" for name in _imports(source)}
        todo += [path for path in beside if path.name not in found and path not in todo]
    found.pop(first.name, None)
    return dict(sorted(found.items()))


@lru_cache(maxsize=256)
def _imports(source: bytes) -> frozenset[str]:
    """Return the first names of all modules that a source imports."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError):
        return frozenset()
    names = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    return frozenset(name.partition(".")[0] for name in names)


def is_reference(text: str) -> bool:
    """Return whether `text` refers to user code. Names of objects that come with Tandem contain none of these signs."""
    return any(sign in text for sign in ":/.")


def absolute(reference: str, folder: Path) -> str:
    """Return the reference of a file with an absolute path, relative to `folder`; other references are unchanged.

    Raises:
        ConfigError: `~user` has no home folder.
    """
    place, name = _parts(reference)
    if not (place.endswith(".py") or "/" in place):
        return reference
    there = os.path.expanduser(place)
    if there.startswith("~"):
        raise ConfigError(
            f"{reference}: no home folder of {place.partition('/')[0]} is known; write the full path"
        )
    return os.path.abspath(folder / there) + (f":{name}" if name else "")


def _parts(reference: str) -> tuple[str, str]:
    """Split into file or package, and the name in it, which may be ""."""
    place, colon, name = reference.rpartition(":")
    return (place, name.strip()) if colon else (name, "")


def _from_file(path: Path) -> tuple[ModuleType, str]:
    path = Path(os.path.abspath(path))
    try:
        source = path.read_bytes()
    except FileNotFoundError:
        hint = did_you_mean(path.name, [file.name for file in path.parent.glob("*.py")], "")
        raise ConfigError(f"{path}: no such file{hint and f'; {hint}'}") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', error)}") from error
    sha256 = hashlib.sha256(source).hexdigest()
    name = PREFIX + hashlib.sha256(os.fsencode(path) + b"\0" + source).hexdigest()[:16]
    if name in sys.modules:
        return sys.modules[name], sha256
    module = ModuleType(name)
    module.__file__ = str(path)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
        setattr(module, APPENDED, str(path.parent))
    # Dataclasses look up their module while it runs.
    sys.modules[name] = module
    try:
        exec(compile(source, str(path), "exec", dont_inherit=True), vars(module))
    except BaseException as error:
        del sys.modules[name]
        if not isinstance(error, Exception | SystemExit):
            raise
        raise _user_code_error(error, str(path)) from error
    return module, sha256


def _from_package(package: str, name: str) -> tuple[ModuleType, str]:
    if not all(part.isidentifier() for part in package.split(".")):
        raise ConfigError(
            f"{package}: neither a file that ends in .py nor the name of a package{_suggestion(package, name)}"
        )
    top = package.partition(".")[0]
    with _installed_only():
        found = next(filter(None, (finder.find_spec(top, None) for finder in sys.meta_path)), None)
        if found is None:
            raise ConfigError(
                f"{package}: no package called {top!r} is installed{_suggestion(package, name)}"
            )
        try:
            module = importlib.import_module(package)
        except (Exception, SystemExit) as error:
            absent = error.name if isinstance(error, ModuleNotFoundError) else None
            if absent is not None and f"{package}.".startswith(f"{absent}."):
                inside, _, last = absent.rpartition(".")
                raise ConfigError(f"{package}: {inside} has no module called {last!r}") from None
            raise _user_code_error(error, found.origin or package) from error
    file = Path(module.__file__ or "")
    return module, hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""


def _suggestion(place: str, name: str) -> str:
    """Suggest the file that may have been meant instead of a package, as the end of a message."""
    file = os.path.splitext(place)[0] + ".py"
    if os.path.isfile(os.path.expanduser(file)):
        return f"; did you mean '{file}:{name or 'NAME'}'?"
    if os.path.isfile(os.path.expanduser(place)):
        return "; the name of a file with code ends in .py"
    return "; a file is written as tanks.py:TANKS"


@contextmanager
def _installed_only() -> Iterator[None]:
    """Hide the folder that `python -m` puts first in `sys.path`, and the folders of loaded files."""
    before = list(sys.path)
    hidden = {
        vars(module).get(APPENDED) for name, module in list(sys.modules.items()) if name.startswith(PREFIX)
    }
    kept = [entry for entry in before if entry and entry not in hidden]
    if not sys.flags.safe_path and before[:1] == kept[:1] == [os.getcwd()]:
        del kept[0]
    sys.path[:] = kept
    try:
        yield
    finally:
        sys.path[:] = [*before, *(entry for entry in sys.path if entry not in before)]


def _user_code_error(error: BaseException, file: str) -> ConfigError:
    """Describe an exception of user code in one line, with the last line of the user's code that led to it."""
    folder = os.path.dirname(file)
    lines = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    if isinstance(error, SyntaxError) and error.filename:
        lines.append((error.filename, error.lineno or 0))
        said = f"not valid Python: {error.msg}"
    else:
        said = " ".join(traceback.format_exception_only(error)[0].split())
    theirs = [f"{at}, line {line}" for at, line in lines if at.startswith(folder + os.sep)]
    return ConfigError(f"{theirs[-1] if theirs else file}: {said[:LONGEST_TEXT]}")


def _kind(value: object) -> str:
    return f"the class {value.__name__}" if isinstance(value, type) else f"of type {type(value).__name__}"
