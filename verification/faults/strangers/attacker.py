"""A stranger on the bus: many bad messages a second, on every topic.

    python -m verification.faults.strangers.attacker CONFIG KIND RATE SECONDS SEED

It listens, so that it can repeat, truncate and change messages of the run's processes. It prints the number sent
as one JSON object, by topic. With a weights kind it acts as a stolen trainer: right run, next version, right hash
unless the hash is what is wrong. Its sets have `samples` = MARK, so that a log distinguishes them from the trainer's.
"""

from __future__ import annotations

import random
import struct
import sys
import threading
from collections import Counter, deque
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh

from network_model.description import hash_layers
from node_runtime.bus.session import connect
from node_runtime.bus.zenoh_bus import Bus, Mailbox
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic

MARK = 424_242
STRANGER = "stranger-000000000000"
KINDS = ("garbage", "truncated", "oversized", "replayed", "reordered", "foreign run", "NaN")
WEIGHTS = ("NaN", "huge", "huge, just within the norm", "wrong shape", "wrong hash", "stale", "subtly worse")
LARGE = 1024 * 1024
"""Bytes; topics with a larger limit get oversized messages only rarely, to limit the load."""
LARGE_EVERY_S = 2.0
LISTEN_S = 0.3
REMEMBERED = 100


class Ear:
    """The last good messages of each topic, from any sender."""

    def __init__(self, mailbox: Mailbox, prefix: str):
        self._mailbox, self._prefix = mailbox, prefix
        self.last: dict[str, deque[bytes]] = {}

    def listen(self) -> None:
        for delivery in self._mailbox.drain():
            name = delivery.key.removeprefix(self._prefix)
            topic = topics.BY_NAME.get(name)
            if topic is None:
                continue
            try:
                message = codec.decode(topic, delivery.payload)
            except codec.BadMessage:
                continue
            if message.run_id == STRANGER:
                continue
            self.last.setdefault(name, deque(maxlen=REMEMBERED)).append(delivery.payload)


def garbage(rng: random.Random) -> bytes:
    """Return random bytes, sometimes with the beginning of a map."""
    body = rng.randbytes(rng.randrange(300))
    return rng.choice([b"", bytes([0x80 | rng.randrange(16)])]) + body


def not_finite(tree: Any, rng: random.Random) -> bool:
    """Put a NaN or an infinity in place of one number below `tree`; return whether there was one."""
    places = list(_floats(tree))
    if not places:
        return False
    where, key = rng.choice(places)
    where[key] = rng.choice([float("nan"), float("inf"), float("-inf")])
    return True


def _floats(tree: Any) -> Any:
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        if isinstance(value, float):
            yield tree, key
        elif isinstance(value, bytes) and isinstance(tree, dict) and tree.get("dtype") in ("<f4", "<f8"):
            yield _Numbers(tree), key
        else:
            yield from _floats(value)


class _Numbers:
    """Return the numbers of an encoded array, so that one can be set."""

    def __init__(self, array: dict[str, Any]):
        self._array = array

    def __setitem__(self, key: str, value: float) -> None:
        form = "<f" if self._array["dtype"] == "<f4" else "<d"
        packed = struct.pack(form, value)
        self._array[key] = packed + self._array[key][len(packed) :]


def bad(kind: str, topic: Topic, heard: deque[bytes], rng: random.Random) -> bytes | None:
    """Return one message of this kind; None if the messages received so far do not allow one."""
    if kind == "garbage":
        return garbage(rng)
    if kind == "oversized":
        return bytes(topic.max_bytes + 1)
    if not heard:
        return None
    if kind == "reordered":
        # Backwards from the newest, which was received already.
        heard.rotate(1)
        return heard[0]
    payload = rng.choice(heard)
    if kind == "truncated":
        return payload[: rng.randrange(len(payload))]
    if kind == "replayed":
        return payload
    tree = msgspec.msgpack.decode(payload)
    if kind == "foreign run":
        tree["run_id"], tree["seq"] = STRANGER, tree["seq"] + rng.randrange(1000)
    elif not not_finite(tree, rng):
        return None
    return msgspec.msgpack.encode(tree)


def flood(config: Config, kind: str, rate: float, seconds: float, seed: int) -> Counter[str]:
    """Send `rate` bad messages a second, over all topics in turn; return how many went to each."""
    rng, stop = random.Random(seed), threading.Event()
    sent: Counter[str] = Counter()
    with Bus(config, "monitor", STRANGER) as bus:
        ear = Ear(bus.everything(), topics.everything(config.name).removesuffix("**"))
        (session,) = connect(config, stop, "monitor")
        block = zenoh.CongestionControl.BLOCK
        put = {
            t.name: session.declare_publisher(t.key(config.name), congestion_control=block)
            for t in topics.ALL
        }
        begin = clock.now()
        while clock.now() < begin + LISTEN_S:
            clock.sleep_until(clock.now() + 0.05)
            ear.listen()
        begin, turn, next_large = clock.now(), 0, 0.0
        while (now := clock.now()) < begin + seconds:
            ear.listen()
            # As many as are due, a few at a time.
            while turn < (now - begin) * rate:
                topic = topics.ALL[turn % len(topics.ALL)]
                turn += 1
                if kind == "oversized" and topic.max_bytes > LARGE:
                    if now < next_large:
                        continue
                    next_large = now + LARGE_EVERY_S
                payload = bad(kind, topic, ear.last.setdefault(topic.name, deque(maxlen=REMEMBERED)), rng)
                if payload is not None:
                    put[topic.name].put(payload)
                    sent[topic.name] += 1
            clock.sleep_until(clock.now() + 0.002)
        session.close()
    return sent


def forged(
    kind: str, real: m.HiddenWeights, oldest: m.HiddenWeights, version: int, rng: Any
) -> m.HiddenWeights:
    """A set of hidden weights that must not stay in force."""
    layers = [layer.numpy().astype(np.float64) for layer in real.layers]
    base, trained_on = real.base_sha256, real.trained_on
    if kind == "NaN":
        layers[0][0, 0] = np.nan
    elif kind == "huge":
        layers = [layer * 1e6 for layer in layers]
    elif kind == "huge, just within the norm":
        layers = [layer * (99.0 / np.linalg.norm(layer)) for layer in layers]
    elif kind == "wrong shape":
        layers = [layer[:, :-1] for layer in layers]
    elif kind == "stale":
        layers = [layer.numpy().astype(np.float64) for layer in oldest.layers]
        base, trained_on = oldest.base_sha256, oldest.trained_on
    elif kind == "subtly worse":
        layers = [layer + 0.3 * rng.standard_normal(layer.shape) * np.abs(layer).mean() for layer in layers]
    packed = [m.Array.of(layer, "<f4") for layer in layers]
    digest = hash_layers([array.numpy() for array in packed])
    return m.HiddenWeights(
        run_id=real.run_id,
        seq=version,
        for_run=real.for_run,
        trained_on=trained_on,
        base_sha256=base,
        samples=MARK,
        loss_before=real.loss_before,
        loss_after=real.loss_after,
        network_sha256=real.network_sha256,
        sha256="0" * 64 if kind == "wrong hash" else digest,
        layers=packed,
    )


def steal(config: Config, kind: str, rate: float, seconds: float, seed: int) -> Counter[str]:
    """Send forged hidden weights in the trainer's name, `rate` a second."""
    rng = np.random.default_rng(seed)
    sent: Counter[str] = Counter()
    oldest: m.HiddenWeights | None = None
    newest: m.HiddenWeights | None = None
    version = -1
    with Bus(config, "monitor", STRANGER) as bus:
        mailbox = bus.queue(topics.HIDDEN_WEIGHTS)
        (session,) = connect(config, threading.Event(), "monitor")
        block = zenoh.CongestionControl.BLOCK
        put = session.declare_publisher(topics.HIDDEN_WEIGHTS.key(config.name), congestion_control=block)
        end, due = clock.now() + seconds, clock.now()
        while clock.now() < end:
            for delivery in mailbox.drain():
                try:
                    weights = codec.decode(topics.HIDDEN_WEIGHTS, delivery.payload)
                except codec.BadMessage:  # the attacker's own
                    continue
                if isinstance(weights, m.HiddenWeights) and weights.samples != MARK:
                    oldest, newest = oldest or weights, weights
                    version = max(version, weights.seq)
            if newest is not None and oldest is not None and clock.now() >= due:
                version, due = version + 1, clock.now() + 1.0 / rate
                put.put(codec.encode(forged(kind, newest, oldest, version, rng)))
                sent[topics.HIDDEN_WEIGHTS.name] += 1
            clock.sleep_until(clock.now() + 0.01)
        session.close()
    return sent


def main(words: list[str]) -> int:
    config, kind = load(Path(words[0])), words[1]
    rate, seconds, seed = float(words[2]), float(words[3]), int(words[4])
    attack = steal if kind.startswith("weights: ") else flood
    sent = attack(config, kind.removeprefix("weights: "), rate, seconds, seed)
    sys.stdout.write(msgspec.json.encode(sent).decode() + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
