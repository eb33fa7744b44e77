"""Links that can be cut, delayed, narrowed and made lossy, between this machine and a network namespace of its own.

Linux's tc netem is a kernel module that small virtual machines lack. The trainer's link is therefore a wire between
two TUN devices. This program carries every IP packet between them, and TCP must resend what it drops. The
plant's link is a pair of kernel devices (veth). It costs a command no time and can only be cut.

        python link.py pump NAMESPACE DEVICE DEVICE      is how `Wire` starts this program
"""

from __future__ import annotations

import fcntl
import heapq
import itertools
import os
import select
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, Protocol

import msgspec

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
MTU = 1500
QUEUE_S = 0.5
"""Seconds. A narrow wire queues packets for this long before it drops them, as routers do."""


class Shape(msgspec.Struct, frozen=True):
    """Treatment of packets in either direction."""

    cut: bool = False
    loss: float = 0.0
    """Share that is dropped."""
    delay: float = 0.0
    """Seconds, each way."""
    rate: float = 0.0
    """Bits per second, each way; 0: unlimited."""


class Link(Protocol):
    """A path to a namespace; processes in it reach this machine at `here`."""

    here: str
    prefix: list[str]
    """Command prefix that runs a command at the other end."""

    def shape(self, shape: Shape) -> None:
        """From now on."""


def available() -> bool:
    """Return whether this process may make network namespaces."""
    return (
        os.geteuid() == 0
        and subprocess.run(["ip", "netns"], capture_output=True, check=False).returncode == 0
    )


@contextmanager
def link(kind: Literal["veth", "wire"], number: int, seed: int = 0) -> Iterator[Link]:
    """Make a namespace behind a link, for the length of a `with`. `number`: 0 to 99, different for each link."""
    name = f"tandem{os.getpid()}-{number}"
    _ip("netns", "add", name)
    try:
        _ip("-n", name, "link", "set", "lo", "up")
        made = Veth(name, number) if kind == "veth" else Wire(name, number, seed)
        try:
            yield made
        finally:
            made.close()
    finally:
        _ip("netns", "del", name)


class _End:
    """Names and addresses of both kinds of link. The subnet depends on the process, so two suites may run at once."""

    def __init__(self, namespace: str, number: int):
        net = f"10.{128 + os.getpid() % 100}.{(os.getpid() // 100) % 250}"
        self.here, self._there = f"{net}.{4 * (number % 60) + 1}", f"{net}.{4 * (number % 60) + 2}"
        self.prefix = ["ip", "netns", "exec", namespace]
        self.near, self.far = f"tn{os.getpid()}a{number}", f"tn{os.getpid()}b{number}"
        self._namespace = namespace

    def _up(self) -> None:
        _ip("link", "set", self.far, "netns", self._namespace)
        _ip("addr", "add", f"{self.here}/30", "dev", self.near)
        _ip("link", "set", self.near, "up")
        _ip("-n", self._namespace, "addr", "add", f"{self._there}/30", "dev", self.far)
        _ip("-n", self._namespace, "link", "set", self.far, "up")


class Veth(_End):
    """A pair of kernel devices; can only be cut."""

    def __init__(self, namespace: str, number: int):
        super().__init__(namespace, number)
        _ip("link", "add", self.near, "type", "veth", "peer", "name", self.far)
        self._up()

    def shape(self, shape: Shape) -> None:
        if shape not in (Shape(), Shape(cut=True)):
            raise ValueError(f"a veth link can only be cut, not {shape}")
        _ip("link", "set", self.near, "down" if shape.cut else "up")

    def close(self) -> None:
        _ip("link", "del", self.near)


class Wire(_End):
    """Two TUN devices and a process between them that drops and delays packets."""

    def __init__(self, namespace: str, number: int, seed: int):
        super().__init__(namespace, number)
        words = [sys.executable, __file__, "pump", self.near, self.far, str(seed)]
        self._pump = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._pump.stdout is not None
        if not self._pump.stdout.readline():
            raise RuntimeError("the wire's process ended before it had its devices")
        self._up()

    def shape(self, shape: Shape) -> None:
        assert self._pump.stdin is not None
        self._pump.stdin.write(msgspec.json.encode(shape) + b"\n")
        self._pump.stdin.flush()

    def close(self) -> None:
        assert self._pump.stdin is not None
        self._pump.stdin.close()
        try:
            self._pump.wait(2.0)
        except subprocess.TimeoutExpired:
            self._pump.kill()
            self._pump.wait()


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


def _tun(name: str) -> int:
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TUN | IFF_NO_PI))
    return device


def pump(near: str, far: str, seed: int) -> None:
    """Carry packets until standard input ends; each of its lines is a new `Shape`."""
    import random

    rng, shape = random.Random(seed), Shape()
    a, b = _tun(near), _tun(far)
    other, free_at = {a: b, b: a}, {a: 0.0, b: 0.0}
    under_way: list[tuple[float, int, int, bytes]] = []
    number = itertools.count()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    while True:
        wait = max(0.0, under_way[0][0] - time.monotonic()) if under_way else None
        readable, _, _ = select.select([a, b, sys.stdin], [], [], wait)
        now = time.monotonic()
        if sys.stdin in readable:
            lines = os.read(sys.stdin.fileno(), 65536).splitlines()
            if not lines:
                return
            shape = msgspec.json.decode(lines[-1], type=Shape)
        for device in (a, b):
            if device not in readable:
                continue
            packet = os.read(device, MTU + 100)
            if shape.cut or rng.random() < shape.loss:
                continue
            due = now
            if shape.rate:
                begin = max(now, free_at[device])
                if begin - now > QUEUE_S:
                    continue
                due = free_at[device] = begin + 8 * len(packet) / shape.rate
            heapq.heappush(under_way, (due + shape.delay, next(number), other[device], packet))
        while under_way and under_way[0][0] <= now:
            _, _, device, packet = heapq.heappop(under_way)
            try:
                os.write(device, packet)
            except OSError:  # the device is not up: the packet is lost
                continue


if __name__ == "__main__":
    pump(sys.argv[2], sys.argv[3], int(sys.argv[4]))
