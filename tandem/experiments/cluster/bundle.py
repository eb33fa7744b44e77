"""The files of a configuration, for a machine that does not have them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

import msgspec

from node_runtime.config.reference import is_reference
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.whole_file import read_regular, write_whole

LARGEST = 32 * 2**20
"""Largest total size in bytes."""
REMEDY = "move the file that the configuration names to a folder of its own"


class Bundle(msgspec.Struct, frozen=True):
    """Files by folder and name; folders have the client's paths."""

    folders: dict[str, dict[str, bytes]]

    @property
    def sha256(self) -> str:
        return hashlib.sha256(msgspec.msgpack.encode(self, order="sorted")).hexdigest()


def gather(configs: Iterable[Config]) -> Bundle:
    """Return the files of the configurations: the folder of a file with code, without subfolders, and files of sets.

    A file with code may import and read other files of its folder. Hidden files are left out.

    Raises:
        ConfigError: they are too large, or certified sets are needed and not named.
    """
    folders: dict[str, dict[str, bytes]] = {}
    code: set[Path] = set()
    for config in configs:
        code.update(Path(path).parent for path in _code(config).values())
        if (sets := _sets(config)) is not None:
            folders.setdefault(str(sets.parent), {})[sets.name] = _read(sets)
    total = sum(len(content) for files in folders.values() for content in files.values())
    for folder in sorted(code):
        files = folders.setdefault(str(folder), {})
        for path in sorted(folder.iterdir()):
            if path.name.startswith(".") or not path.is_file():
                continue
            total += path.stat().st_size
            if total > LARGEST:
                raise ConfigError(
                    f"{folder}: its files must be sent to the workers, and they exceed {LARGEST >> 20} MiB; "
                    f"{REMEDY}"
                )
            files[path.name] = _read(path)
    return Bundle(folders)


def unpack(bundle: Bundle, root: Path) -> None:
    """Write the files below `root`."""
    for folder, files in bundle.folders.items():
        for name, content in files.items():
            if Path(name).name != name:
                raise ConfigError(f"{name!r} is not the name of a file")
            write_whole(_place(root, folder) / name, content)


def moved(config: Config, root: Path) -> Config:
    """Return the configuration with the paths to which `unpack` has written its files."""

    def new(path: str) -> str:
        return str(_place(root, str(Path(path).parent)) / Path(path).name)

    changed = {}
    for key, path in _code(config).items():
        reference: str = getattr(*_owner(config, key))
        changed[key] = new(path) + reference[len(path) :]
    plant = msgspec.structs.replace(
        config.plant,
        model=changed.get("plant.model", config.plant.model),
        truth=changed.get("plant.truth", config.plant.truth),
    )
    architecture = changed.get("network.architecture", config.network.architecture)
    network = msgspec.structs.replace(config.network, architecture=architecture)
    controller = config.controller
    if (sets := _sets(config)) is not None:
        controller = msgspec.structs.replace(controller, sets=new(str(sets)))
    return msgspec.structs.replace(config, plant=plant, network=network, controller=controller)


def _place(root: Path, folder: str) -> Path:
    return root / hashlib.sha256(folder.encode()).hexdigest()[:16]


def _code(config: Config) -> dict[str, str]:
    """Return the paths of files with code, by key."""
    found = {}
    for key in ("plant.model", "plant.truth", "network.architecture"):
        text = getattr(*_owner(config, key))
        if isinstance(text, str) and is_reference(text):
            place, colon, _name = text.rpartition(":")
            path = place if colon else text
            if path.endswith(".py"):
                found[key] = path
    return found


def _owner(config: Config, key: str) -> tuple[object, str]:
    section, _, name = key.partition(".")
    return getattr(config, section), name


def _sets(config: Config) -> Path | None:
    if config.controller.tightening != "invariant":
        return None
    if config.controller.sets is None:
        raise ConfigError(
            "controller.tightening = 'invariant': a worker does not have this machine's certified sets; name their "
            "file, controller.sets = 'FILE'"
        )
    return Path(config.controller.sets)


def _read(path: Path) -> bytes:
    try:
        return read_regular(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
