"""Links between network namespaces: a wire that delays, drops and is cut, and a client that vanishes behind one."""

from __future__ import annotations

import itertools
import socket
import subprocess
import sys

import numpy as np
import pytest

from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import override, to_json
from node_runtime.realtime import clock
from protocol import messages as m
from protocol import topics
from tests.helpers.live import Process, live_config, matched, wait_for
from tests.verification.calm import sampled
from verification.faults.processes import link

ECHO = """
import socket, sys
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as echo:
    echo.bind(("0.0.0.0", 9999))
    print("ready", flush=True)
    while True:
        data, whence = echo.recvfrom(100)
        echo.sendto(data, whence)
"""


@pytest.mark.live
@pytest.mark.skipif(not link.available(), reason="links to network namespaces need root")
def test_a_wire_delays_drops_and_cuts() -> None:
    with link.link("wire", 50) as wire, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
        words = [*wire.prefix, sys.executable, "-c", ECHO]
        with subprocess.Popen(words, stdout=subprocess.PIPE) as echo:
            try:
                assert echo.stdout is not None
                assert echo.stdout.readline()
                there = (wire.here.rpartition(".")[0] + f".{int(wire.here.rpartition('.')[2]) + 1}", 9999)

                turns = itertools.count()

                def answered(count: int, wait: float) -> list[float]:
                    """Return the delay of each answer; late answers from an earlier turn do not count."""
                    turn, begin, times = next(turns), clock.now(), []
                    sent = {b"%d %d" % (turn, number) for number in range(count)}
                    for word in sorted(sent):
                        here.sendto(word, there)
                    here.settimeout(wait)
                    try:
                        while len(times) < count:
                            if here.recv(100) in sent:
                                times.append(clock.now() - begin)
                    except TimeoutError:
                        pass
                    return times

                wait_for(lambda: len(answered(5, 1.0)) == 5)
                wire.shape(link.Shape(delay=0.1))
                # The behaviour of the wire's process shows that it received the new shape.
                wait_for(lambda: min(answered(3, 1.0), default=0.0) >= 0.2)
                wire.shape(link.Shape(loss=0.5))
                wait_for(lambda: 20 < len(answered(200, 0.5)) < 100)
                wire.shape(link.Shape(cut=True))
                wait_for(lambda: answered(3, 0.3) == [])
                wire.shape(link.Shape())
                wait_for(lambda: len(answered(5, 1.0)) == 5)
            finally:
                echo.kill()


LINGER_S = 10.0
FAR = """
import sys, threading
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import from_json
from protocol import topics
with Bus(from_json(sys.argv[1]), "plant", "plant-far") as bus:
    kept = [bus.queue(topics.OUTPUT_WEIGHTS), bus.queue(topics.COMMAND)]
    print("ready", flush=True)
    threading.Event().wait()
"""


@pytest.mark.live
@pytest.mark.skipif(not link.available(), reason="links to network namespaces need root")
def test_a_vanished_client_does_not_stop_the_router() -> None:
    """Zenoh closed its two links in its only two receiving threads, which waited up to 10 s."""
    local = live_config("bus.lease_ms=400")
    port = local.bus.endpoint.rpartition(":")[2]
    listening = override(local, [f'bus.endpoint="tcp/0.0.0.0:{port}"', "bus.insecure=true"])
    with (
        link.link("wire", 51) as wire,
        Process("node_runtime.router", listening),
        Bus(local, "controller", "controller-1") as controller,
        Bus(local, "plant", "plant-1") as plant,
    ):
        heard = controller.queue(topics.PLANT_STATE)
        far = to_json(override(local, [f'bus.endpoint="tcp/{wire.here}:{port}"']))
        with subprocess.Popen(
            [*wire.prefix, sys.executable, "-c", FAR, far], stdout=subprocess.PIPE
        ) as client:
            try:
                assert client.stdout is not None
                assert client.stdout.readline()
                wait_for(
                    lambda: matched(controller, topics.OUTPUT_WEIGHTS) and matched(plant, topics.PLANT_STATE)
                )
                wire.shape(link.Shape(cut=True))
                K = m.Array.of(np.zeros((65, 4)))
                sent: list[float] = []
                for seq in range(60):
                    weights = m.OutputWeights(
                        run_id="controller-1", seq=seq, hidden_version=0, hidden_sha256="", K=K
                    )
                    controller.publish(topics.OUTPUT_WEIGHTS, weights)
                    sent.append(clock.now())
                    plant.publish(topics.PLANT_STATE, sampled("hold", 0.05 * seq).state)
                    clock.sleep_until(clock.now() + 0.05)
                wait_for(lambda: len(heard) == len(sent))
                # A waiting router waits for 10 s from a lease after the cut.
                under_way = [d.received_ns * 1e-9 - at for d, at in zip(heard.drain(), sent, strict=True)]
                assert max(under_way) < LINGER_S / 2
            finally:
                client.kill()
