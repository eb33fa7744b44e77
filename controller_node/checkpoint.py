"""The controller's memory in a local file, so that a restarted controller continues with everything it has learned.

A thread writes it: soon after the start, then about once a second, and at an orderly end. It writes a temporary file,
calls fsync and renames it, so the file is complete at every moment. A damaged file, or one of another controller, is
reported, renamed and not used.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol

import msgspec
import numpy as np

from controller_node.outbox import Outbox
from node_runtime.whole_file import read_regular, require_regular, write_whole
from protocol import codec, topics
from protocol import messages as m

log = logging.getLogger(__name__)

EVERY = 1.0
"""Seconds between two files."""
FIRST = 0.1
"""Seconds until the first file, and increase of each further interval, because most is learned at the beginning."""
MAGIC = b"tandem checkpoint 1\n"
LARGEST = 256 * 1024 * 1024
"""Largest size in bytes of a file that is read."""
DAMAGED, OTHER = ".damaged", ".other"
"""Suffixes of files that are renamed because they cannot be used."""


class CheckpointError(Exception):
    """The checkpoint cannot be used. The text says which one and why."""

    aside = DAMAGED


class OtherController(CheckpointError):
    """A valid checkpoint of a controller of another plant, network or model."""

    aside = OTHER


class Checkpoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The part of a controller's state that survives its process."""

    belongs: dict[str, str]
    """Identity of the controller, as texts that must be equal."""
    run_id: str
    seq: int
    """The last tick in the checkpoint."""
    arrays: dict[str, m.Array]
    counters: dict[str, int]
    samples: list[bytes]
    """Encoded `Samples`, oldest first."""

    def batches(self) -> list[m.Samples]:
        return [codec.decode_as(m.Samples, payload) for payload in self.samples]


class Resumes(Protocol):
    """An object that can continue from a checkpoint, such as `controller_node.memory.Memory`."""

    def belongs(self) -> dict[str, str]: ...

    def go_on(self, lasting: dict[str, m.Array], run_id: str) -> None: ...


@dataclass(frozen=True)
class Snapshot:
    """The memory that the loop hands over: references to objects that it never changes again."""

    seq: int
    arrays: dict[str, m.Array]
    counters: dict[str, int]


# -- reading -------------------------------------------------------------------------------------------------


def resume(memory: Resumes, path: Path) -> Checkpoint | None:
    """Let a controller continue with the memory in a file, before its first tick.

    Returns:
        The checkpoint; None after a log line if there is no usable file. An unusable file is renamed, because the next
        checkpoint takes its name.
    """
    try:
        found = read(path, memory.belongs())
        try:
            memory.go_on(found.arrays, found.run_id)
        except ValueError as error:
            raise OtherController(
                f"the checkpoint belongs to a controller with other settings: {error}"
            ) from error
        log.info("%s: continuing from %s, tick %d", path, found.run_id, found.seq)
        return found
    except FileNotFoundError:
        log.info("%s: no checkpoint yet; starting without memory", path)
    except OSError as error:
        log.warning("%s: the checkpoint cannot be read (%s); starting without memory", path, error.strerror)
    except CheckpointError as error:
        log.warning("%s: %s; starting without memory%s", path, error, keep_aside(path, error))
    return None


def read(path: Path, belongs: Mapping[str, str]) -> Checkpoint:
    """Read and check a file.

    Raises:
        OSError: it cannot be read.
        CheckpointError: it is damaged, or belongs to another controller.
    """
    content = read_regular(path, LARGEST + 1)
    if len(content) > LARGEST:
        raise CheckpointError(f"more than {LARGEST} bytes: not a checkpoint")
    if not content.startswith(MAGIC):
        raise CheckpointError("not a checkpoint, or one of another version of Tandem")
    start = len(MAGIC) + hashlib.sha256().digest_size
    if hashlib.sha256(content[start:]).digest() != content[len(MAGIC) : start]:
        raise CheckpointError("damaged or cut off: its sha256 does not match its content")
    try:
        found = msgspec.msgpack.decode(content[start:], type=Checkpoint)
        for payload in found.samples:
            codec.decode(topics.SAMPLES, payload)
    except (msgspec.DecodeError, codec.BadMessage, UnicodeDecodeError, ValueError) as error:
        raise CheckpointError(f"complete, but not readable: {error}") from error
    differs = [
        f"{name} is {found.belongs.get(name, 'not named')} there and {belongs.get(name, 'not named')} here"
        for name in sorted(found.belongs.keys() | belongs.keys())
        if found.belongs.get(name) != belongs.get(name)
    ]
    if differs:
        raise OtherController(f"the checkpoint belongs to another controller: {'; '.join(differs)}")
    for name, array in found.arrays.items():
        if array.dtype != "<i8" and not np.isfinite(array.numpy()).all():
            raise CheckpointError(f"array {name} is not finite")
    return found


def keep_aside(path: Path, error: CheckpointError) -> str:
    """Rename an unusable file; return the result as the end of a sentence."""
    aside = path.with_name(path.name + error.aside)
    try:
        require_regular(path)
        require_regular(aside)
        path.replace(aside)
    except OSError as failed:
        return f"; it could not be renamed ({failed.strerror})"
    return f"; it is kept as {aside}"


# -- writing -------------------------------------------------------------------------------------------------


class CheckpointWriter:
    """Writes checkpoints in a thread of its own. A context manager.

    The loop checks `wanted` after each tick and hands over its memory if it is true. The loop's thread does nothing
    else.

    Args:
        path: the file.
        belongs: identity of the controller.
        outbox: its newest samples are saved too.
        samples: number of these samples.
        counts: counters, which are updated here.
        every: seconds between two files in the long run.
    """

    def __init__(
        self,
        path: Path,
        belongs: Mapping[str, str],
        outbox: Outbox,
        samples: int,
        counts: dict[str, int],
        every: float = EVERY,
    ):
        self.wanted = False
        self._path, self._belongs, self._every = path, dict(belongs), every
        self._outbox, self._samples, self._counts = outbox, samples, counts
        # Batches are encoded once, to keep the interpreter free for the loop.
        self._encoded: deque[tuple[int, bytes]] = deque(
            (len(batch.samples), codec.encode(batch)) for batch in outbox.earlier
        )
        self._last = -1
        self._memory: Snapshot | None = None
        self._offered, self._end = threading.Event(), threading.Event()
        self._said = ""
        self._thread = threading.Thread(target=self._run, name="checkpoint", daemon=True)

    def offer(self, memory: Snapshot) -> None:
        """Hand over the newest memory from the loop; returns at once."""
        self._memory, self.wanted = memory, False
        self._offered.set()

    def __enter__(self) -> CheckpointWriter:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write the last memory that was handed over before returning."""
        self._end.set()
        self._offered.set()
        self._thread.join()
        self._write()

    def _run(self) -> None:
        pause = 0.0
        while not self._end.wait(pause := min(self._every, pause + FIRST)):
            self.wanted = True
            self._offered.wait()
            # Clear after the wait, never before it, so that the single signal of the end is not missed.
            self._offered.clear()
            self._write()

    def _write(self) -> None:
        memory, self._memory = self._memory, None
        if memory is None:
            return
        self._encode_samples()
        checkpoint = Checkpoint(
            belongs=self._belongs,
            run_id=self._outbox.run_id,
            seq=memory.seq,
            arrays=memory.arrays,
            counters=memory.counters,
            samples=[payload for _count, payload in self._encoded],
        )
        content = msgspec.msgpack.encode(checkpoint)
        try:
            # Only the owner may read or write it, because a process trusts it at its start.
            content = MAGIC + hashlib.sha256(content).digest() + content
            write_whole(self._path, content, mode=0o600, durable=True)
        except OSError as error:
            self._counts["checkpoints_failed"] += 1
            self._warn(f"the checkpoint cannot be written ({error.strerror}); the loop continues without it")
            return
        self._counts["checkpoints_written"] += 1
        self._warn("")

    def _encode_samples(self) -> None:
        new = self._outbox.since(self._last, self._samples)
        for batch in self._outbox.batches(new):
            self._encoded.append((len(batch.samples), codec.encode(batch)))
            self._last = batch.seq
        kept = sum(count for count, _payload in self._encoded)
        while self._encoded and kept - self._encoded[0][0] >= self._samples:
            kept -= self._encoded.popleft()[0]

    def _warn(self, text: str) -> None:
        """Log each failure once, and its end once."""
        if text and text != self._said:
            log.warning("%s: %s; further ones are only counted", self._path, text)
        elif self._said and not text:
            log.info("%s: the checkpoint is written again", self._path)
        self._said = text
