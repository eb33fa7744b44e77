"""Certified sets on disk: the file written by `tandem sets compute`, the cache, and the choice of the sets in use.

A file is one JSON object, compressed with gzip if its name ends in .gz. Its sha256 covers all other content, and only
one encoding is accepted, so every edited byte is detected. The hash detects damage, not forgery. `tandem sets check`
proves the claim again.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import logging
import os
import zipfile
import zlib
from collections.abc import Iterator, MutableMapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from lbmpc.model import Model
from lbmpc.plants import PLANTS, Plant
from lbmpc.sets.certificate import FORMAT, Certificate, CertificateError, decode, encode, hashes, model_of
from lbmpc.sets.certificate import require_match as require_model
from lbmpc.sets.motion import over_any_delay, require_certifiable
from node_runtime.config.plant import initial_state
from node_runtime.config.sections import Config
from node_runtime.config.shipped import shipped
from node_runtime.config.strict import ConfigError
from node_runtime.private_folder import make_private, why_not_ours, why_not_private
from node_runtime.whole_file import read_regular, write_whole

log = logging.getLogger(__name__)

CONSTRUCTION = 2
"""Increased when the construction gives other sets for the same arguments."""
SLACK = 3e-4
SHIPPED = shipped("sets")
Kind = Literal["given", "box", "hull", "regions"]
PREFERRED: tuple[Kind, ...] = ("regions", "hull", "box")
"""Order of the search if no file is configured, largest sets first."""
LARGEST = 256 * 1024 * 1024
"""Largest size of sets in bytes after decompression, because a small file may expand to any size."""
GZIPPED = b"\x1f\x8b"


class Found(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Results of the construction and the check, for people."""

    volume_fraction: float
    """Share of X."""
    invariance_margin: float
    """The smallest slack beyond W, as a share of X's half-widths."""
    contains_x0: bool
    seconds: float
    """Duration of the construction."""


class _Content(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    sha256: str
    found: Found
    certificate: msgspec.Raw


@dataclass(frozen=True, eq=False)
class CertifiedSets:
    """A certificate with its results; `sha256` covers both."""

    sha256: str
    found: Found
    certificate: Certificate

    @classmethod
    def of(cls, certificate: Certificate, found: Found) -> CertifiedSets:
        return cls(_hash(found, encode(certificate)), found, certificate)

    @classmethod
    def from_bytes(cls, data: bytes) -> CertifiedSets:
        """Read the bytes of a file. Raises `CertificateError` if they are not such a file, edited, or inconsistent."""
        if data.startswith(GZIPPED):
            try:
                with gzip.open(io.BytesIO(data)) as file:
                    data = file.read(LARGEST + 1)
            except (OSError, EOFError, zlib.error) as error:
                raise CertificateError(f"damaged gzip file: {error}") from error
            if len(data) > LARGEST:
                raise CertificateError(
                    f"more than {LARGEST / 1e6:.0f} MB after decompression; certified sets are smaller"
                )
        try:
            content = msgspec.json.decode(data, type=_Content)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise CertificateError(f"not a file of certified sets, or a damaged one: {error}") from error
        actual = _hash(content.found, bytes(content.certificate))
        if actual != content.sha256:
            raise CertificateError(
                f"its content has sha256 {actual[:12]}, but it states {content.sha256[:12]}: it was edited or damaged"
            )
        sets = cls(content.sha256, content.found, decode(bytes(content.certificate)))
        if sets.to_bytes().strip() != data.strip():
            raise CertificateError("its bytes differ from the original encoding: it was edited")
        return sets

    def to_bytes(self) -> bytes:
        content = _Content(self.sha256, self.found, msgspec.Raw(encode(self.certificate)))
        return msgspec.json.encode(content) + b"\n"

    @property
    def facets(self) -> list[int]:
        """Number of facets of each set."""
        return [len(piece.g) for piece in self.certificate.pieces]


def _hash(found: Found, certificate: bytes) -> str:
    return hashlib.sha256(msgspec.json.encode(found) + b"\n" + certificate).hexdigest()


def read_sets(path: Path) -> CertifiedSets:
    """Read a file. Raises `CertificateError` with the file's name."""
    try:
        data = read_regular(path, LARGEST + 1)
        if len(data) > LARGEST:
            raise CertificateError(f"more than {LARGEST / 1e6:.0f} MB; certified sets are smaller")
        return CertifiedSets.from_bytes(data)
    except OSError as error:
        raise CertificateError(f"{path}: cannot be read: {error.strerror}") from error
    except CertificateError as error:
        raise CertificateError(f"{path}: {error}") from error


def write_sets(sets: CertifiedSets, path: Path, mode: int = 0o644) -> None:
    """Write the whole file or nothing. Raises `OSError`."""
    data = sets.to_bytes()
    # The archive contains no time, so equal sets give equal files.
    write_whole(path, gzip.compress(data, mtime=0) if path.suffix == ".gz" else data, mode)


# -- the cache ----------------------------------------------------------------------------------


def default_cache() -> Path:
    """Return the user's cache folder, which XDG_CACHE_HOME can move."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tandem" / "sets"


@dataclass(frozen=True)
class Work:
    """One construction: the key of its arguments, and the files of its results."""

    key: str
    sets: Path
    """File of the finished sets."""
    folder: Path
    """Folder of intermediate results. `hull` and `regions` share it, because they begin with the same sets."""

    @classmethod
    def of(
        cls, model: Model, kind: Kind, start: np.ndarray, W: np.ndarray | None, slack: float, cache: Path
    ) -> Work:
        """Describe a construction from `start` (d,) in deviations, and W (d,) as for `construct`."""
        given = None
        if kind == "given":
            given = over_any_delay(model, model.plant.W * model.period if W is None else W).tolist()
        base = {
            "model": hashes(model_of(model)),
            "equations": _equations(model, kind),
            "kind": "hull" if kind == "regions" else kind,
            "W": given,
            "slack": slack,
            "construction": [FORMAT, CONSTRUCTION],
        }
        whole = _key(base | {"kind": kind, "start": start.tolist()})
        return cls(whole, cache / f"{whole}.json", cache / _key(base))

    def save(self, sets: CertifiedSets) -> None:
        """Write the sets into the cache, readable and writable for this user only. Raises `OSError`."""
        make_private(self.sets.parent)
        write_sets(sets, self.sets, 0o600)


def _equations(model: Model, kind: Kind) -> str | None:
    """Return the hash of the equations that bound h, because two plants may have the same linear model."""
    if kind == "given" or model.equations is None:
        return None
    return _sha256_of(model.equations)


def _sha256_of(equations: Plant) -> str:
    return hashlib.sha256(equations.function().serialize().encode()).hexdigest()


def _comes_with_tandem(model: Model) -> bool:
    """Check the equations, because a user's plant may share name and linear part with a shipped one, but not h."""
    shipped, equations = PLANTS.get(model.plant.name), model.equations
    if not isinstance(shipped, Plant) or equations is None:
        return False
    return equations.rhs is shipped.rhs or _sha256_of(equations) == _sha256_of(shipped)


def why_not_trusted(work: Work) -> str | None:
    """Return why another user may have written a construction's files in the cache, and what to do; None if none can.

    Missing files are accepted.
    """
    cache = work.sets.parent
    for path, reason_of in (
        (cache, why_not_private),
        (work.sets, _why_not_ours),
        (work.folder, _why_not_ours),
    ):
        try:
            reason = reason_of(path)
        except FileNotFoundError:
            continue
        except OSError as error:
            reason = f"{path}: {error.strerror}"
        if reason is not None:
            return (
                f"the cache of certified sets is not trusted: {reason}. If you trust its content, run "
                f"chmod -R go-w {cache}; otherwise remove it"
            )
    return None


def _why_not_ours(path: Path) -> str | None:
    return why_not_ours(path, path.lstat())


def _key(parts: object) -> str:
    return hashlib.sha256(msgspec.json.encode(parts, order="sorted")).hexdigest()[:24]


class SavedArrays(MutableMapping[str, dict[str, np.ndarray]]):
    """Named sets of arrays in a folder, one .npz file each. Unreadable and foreign files count as missing."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __getitem__(self, name: str) -> dict[str, np.ndarray]:
        try:
            if _why_not_ours(self._path(name)) is not None:
                raise KeyError(name)
            with np.load(io.BytesIO(read_regular(self._path(name))), allow_pickle=False) as saved:
                return {key: saved[key] for key in saved.files}
        except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise KeyError(name) from error

    def __setitem__(self, name: str, arrays: dict[str, np.ndarray]) -> None:
        content = io.BytesIO()
        np.savez(content, **arrays)  # type: ignore[arg-type]
        make_private(self.folder)
        write_whole(self._path(name), content.getvalue(), 0o600)

    def __delitem__(self, name: str) -> None:
        try:
            self._path(name).unlink()
        except FileNotFoundError as error:
            raise KeyError(name) from error

    def __iter__(self) -> Iterator[str]:
        return (path.stem for path in sorted(self.folder.glob("*.npz")))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


# -- the sets in use ---------------------------------------------------------------------------


def find_sets(config: Config, model: Model, cache: Path | None = None) -> CertifiedSets:
    """Return the sets of `controller.sets`, or those of the cache or of this installation for exactly this model.

    Raises:
        ConfigError: there are none, they were edited, they are for another model, or the plant allows none.
    """
    try:
        require_certifiable(model)
    except CertificateError as error:
        raise ConfigError(f"controller.tightening = 'invariant': {error}") from error
    named = config.controller.sets
    if named is not None:
        try:
            sets = _sets_for(model, Path(named))
        except CertificateError as error:
            raise ConfigError(f"controller.sets: {error}") from error
        _require_claim(sets, named)
        return sets
    cache = default_cache() if cache is None else cache
    start = start_of(config, model)
    doubts: list[str] = []
    for kind in PREFERRED:
        work = Work.of(model, kind, start, None, SLACK, cache)
        doubt = why_not_trusted(work) if work.sets.exists() else None
        candidates = [work.sets] if doubt is None else []
        doubts += [doubt] if doubt is not None else []
        if _comes_with_tandem(model):
            candidates += sorted(SHIPPED.glob(f"{model.plant.name}-*-{kind}.json*"))
        for path in candidates:
            usable = _usable(path, model)
            if usable is not None:
                for text in dict.fromkeys(doubts):
                    log.warning("%s", text)
                return usable
    raise ConfigError(
        "controller.tightening = 'invariant' needs certified sets, and there are none for this plant, rate and bounds: "
        "compute them with `tandem sets compute` and this configuration, or set controller.sets = 'FILE'"
        + "".join(f"; {text}" for text in dict.fromkeys(doubts))
    )


def start_of(config: Config, model: Model) -> np.ndarray:
    """Return the configured x0 in deviation coordinates, (d,)."""
    return np.asarray(initial_state(config, model.plant) - model.plant.x_e)


def _sets_for(model: Model, path: Path) -> CertifiedSets:
    """Read sets for a model. Raises `CertificateError` with the file's name if unreadable or for another model."""
    sets = read_sets(path)
    try:
        require_model(sets.certificate, model)
    except CertificateError as error:
        raise CertificateError(f"{path}: {error}") from error
    return sets


def _usable(path: Path, model: Model) -> CertifiedSets | None:
    if not path.exists():
        return None
    try:
        sets = _sets_for(model, path)
    except CertificateError:
        return None  # for another model, or damaged: treat it as missing
    return sets if sets.certificate.certified else None


def _require_claim(sets: CertifiedSets, name: str) -> None:
    if not sets.certificate.certified:
        raise ConfigError(
            f"controller.sets: {name}: a {sets.certificate.kind} is not certified; the tightening `invariant` "
            "needs certified sets"
        )
