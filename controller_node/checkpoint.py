"""The controller's memory in a local file, so that a controller that is started again knows what it had learned.

Written in a thread of its own, soon at first, then about once a second, and at an orderly end: a temporary file, fsync,
rename, so that the file is whole at every moment. A file that is damaged, or that belongs to another controller, is
named, kept aside and not used.
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
"""Seconds to the first one, and by how much each further one takes longer: most is learned at the beginning."""
MAGIC = b"tandem checkpoint 1\n"
LARGEST = 256 * 1024 * 1024
"""Bytes of a file that is read at all."""
DAMAGED, OTHER = ".damaged", ".other"
"""What is added to the name of a file that is kept aside."""


class CheckpointError(Exception):
    """A checkpoint that cannot be used; the text says which and why."""

    aside = DAMAGED


class OtherController(CheckpointError):
    """A whole checkpoint, of a controller of another plant, network or model."""

    aside = OTHER


class Checkpoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What outlives a controller process."""

    belongs: dict[str, str]
    """To which controller, in words that must be equal."""
    run_id: str
    seq: int
    """Its last tick in here."""
    arrays: dict[str, m.Array]
    counters: dict[str, int]
    samples: list[bytes]
    """Encoded `Samples`, oldest first."""

    def batches(self) -> list[m.Samples]:
        return [codec.decode_as(m.Samples, payload) for payload in self.samples]


class Resumes(Protocol):
    """What can go on with a checkpoint: `controller_node.memory.Memory`."""

    def belongs(self) -> dict[str, str]: ...

    def go_on(self, lasting: dict[str, m.Array], run_id: str) -> None: ...


@dataclass(frozen=True)
class Snapshot:
    """What the loop hands over: references to what it never changes again."""

    seq: int
    arrays: dict[str, m.Array]
    counters: dict[str, int]


# -- reading -------------------------------------------------------------------------------------------------


def resume(memory: Resumes, path: Path) -> Checkpoint | None:
    """Let a controller go on with the memory in a file, before its first tick.

    Returns:
        What there was, or None where there is no file, or none that may be used, after saying why. What cannot be used
        is kept beside, under another name, because the next checkpoint takes this one.
    """
    try:
        found = read(path, memory.belongs())
        try:
            memory.go_on(found.arrays, found.run_id)
        except ValueError as error:
            raise OtherController(f"the checkpoint of a controller with other settings: {error}") from error
        log.info("%s: goes on from %s, tick %d", path, found.run_id, found.seq)
        return found
    except FileNotFoundError:
        log.info("%s: no checkpoint yet; starting afresh", path)
    except OSError as error:
        log.warning("%s: the checkpoint cannot be read (%s); starting afresh", path, error.strerror)
    except CheckpointError as error:
        log.warning("%s: %s; starting afresh%s", path, error, keep_aside(path, error))
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
        raise CheckpointError(f"whole, but not readable: {error}") from error
    differs = [
        f"{name} is {found.belongs.get(name, 'not named')} there and {belongs.get(name, 'not named')} here"
        for name in sorted(found.belongs.keys() | belongs.keys())
        if found.belongs.get(name) != belongs.get(name)
    ]
    if differs:
        raise OtherController(f"the checkpoint of another controller: {'; '.join(differs)}")
    for name, array in found.arrays.items():
        if array.dtype != "<i8" and not np.isfinite(array.numpy()).all():
            raise CheckpointError(f"array {name} is not finite")
    return found


def keep_aside(path: Path, error: CheckpointError) -> str:
    """Rename a file that cannot be used; says so, for the end of a sentence."""
    aside = path.with_name(path.name + error.aside)
    try:
        require_regular(path)
        require_regular(aside)
        path.replace(aside)
    except OSError as failed:
        return f"; it could not be kept aside ({failed.strerror})"
    return f"; it is kept as {aside}"


# -- writing -------------------------------------------------------------------------------------------------


class CheckpointWriter:
    """A context manager with a thread of its own.

    The loop looks at `wanted` after each tick, and hands its memory over when it is true: nothing else happens in the
    loop's thread.

    Args:
        path: the file.
        belongs: to which controller.
        outbox: whose newest samples are saved too.
        samples: how many of them.
        counts: figures of this writer's, kept up to date here.
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
        # Encoded once: the interpreter belongs to the loop.
        self._encoded: deque[tuple[int, bytes]] = deque(
            (len(batch.samples), codec.encode(batch)) for batch in outbox.earlier
        )
        self._last = -1
        self._memory: Snapshot | None = None
        self._offered, self._end = threading.Event(), threading.Event()
        self._said = ""
        self._thread = threading.Thread(target=self._run, name="checkpoint", daemon=True)

    def offer(self, memory: Snapshot) -> None:
        """The newest memory, from the loop; returns at once."""
        self._memory, self.wanted = memory, False
        self._offered.set()

    def __enter__(self) -> CheckpointWriter:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The last memory that was offered is written before this returns."""
        self._end.set()
        self._offered.set()
        self._thread.join()
        self._write()

    def _run(self) -> None:
        pause = 0.0
        while not self._end.wait(pause := min(self._every, pause + FIRST)):
            self.wanted = True
            self._offered.wait()
            # Cleared after the wait, never before it: the end, which is said once, must not be missed.
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
            # For its owner alone, like everything that a process will believe when it starts.
            content = MAGIC + hashlib.sha256(content).digest() + content
            write_whole(self._path, content, mode=0o600, durable=True)
        except OSError as error:
            self._counts["checkpoints_failed"] += 1
            self._warn(f"the checkpoint cannot be written ({error.strerror}); the loop goes on without")
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
        """Once for each trouble, and once when it is over."""
        if text and text != self._said:
            log.warning("%s: %s; further ones are only counted", self._path, text)
        elif self._said and not text:
            log.info("%s: the checkpoint is written again", self._path)
        self._said = text
