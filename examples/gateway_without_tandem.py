"""A gateway without any of Tandem's code: it needs zenoh and msgpack only.

It follows docs/reference/gateway.md.

    tandem run --no-plant                          # in one terminal
    python examples/gateway_without_tandem.py      # in another; arguments: the router's endpoint, folder of keys

`Compressor` is the machine, here a simulated one; `Gateway` has the rules, `main` the clock and the bus.
"""

import contextlib
import json
import math
import os
import queue
import sys
import time
import uuid
from collections import Counter

import msgpack
import zenoh

KEY, PERIOD = "tandem/jet1", 0.05  # jet1 is the plant's name; seconds between samples
PATIENCE, SILENCE = 1.25, 1.0  # periods that a command acts; seconds until another controller may take over
LARGEST = 256 * 1024  # bytes of a command
FIELDS = {"run_id": str, "seq": int, "state_run_id": str, "state_seq": int, "period": float, "plan": list}
U_MIN, U_MAX, R_E = [0.1547], [2.1547], 1.5 / math.sqrt(1.6875)


class Compressor:
    """Sensors, actuator and safe input. It is simulated, so it must be told the time."""

    def __init__(self):
        self.x, self.u, self.t = [0.15, 1.2875, 1.1547, 0.0], None, 0.0

    def read(self, t):
        steps = 0 if self.u is None else math.ceil((t - self.t) / 5e-4)
        for _ in range(steps):
            z, y, r, rdot = self.x
            flow, pressure = 1 - y + 1.5 * z - 0.5 * z**3, z + 1 - r * math.sqrt(max(y, 0.0))
            slopes = flow, pressure, rdot, 1000.0 * (self.u[0] - r) - math.sqrt(2000.0) * rdot
            self.x = [x + slope * (t - self.t) / steps for x, slope in zip(self.x, slopes, strict=True)]
        self.t = t
        return self.x

    def write(self, u, t):
        self.read(t)
        self.u = u

    def safe(self, t):
        z, y, _, _ = self.read(t)
        return [R_E - 2.8 * (z - 0.5) + 1.9 * (y - 1.6875)]


class Gateway:
    """The rules for what acts on the machine and for its messages. Times are in seconds on this machine's own clock."""

    def __init__(self, machine, run_id, first):
        # first: when sample 0 is due. seq: of the newest sample. source: of the acting input.
        self.machine, self.run_id, self.first, self.seq, self.source = machine, run_id, first, -1, "hold"
        # The acting input and its start, and the inputs before it since the newest sample.
        self.u, self.since, self.pieces = None, first, []
        # Of the last obeyed command, and the time at which another input acts if no other command comes.
        self.plan, self.command_seq, self.arrived, self.switch = [], -1, 0.0, math.inf
        # The obeyed controller: run_id, seq, and the time of its last message.
        self.leader, self.heard = ("", -1), -math.inf
        self.refused = Counter()

    def due(self):
        """When the next sample is due."""
        return self.first + (self.seq + 1) * PERIOD

    def sample(self):
        """The `PlantState` of the sample that is due."""
        t = self.due()
        self.seq += 1
        self.note(t)
        pieces, self.pieces = [piece for piece in self.pieces if piece["u"]], []
        whole = math.isclose(sum(piece["seconds"] for piece in pieces), PERIOD, rel_tol=1e-6)
        mean = [sum(p["seconds"] * p["u"][j] for p in pieces) / PERIOD for j in range(len(U_MIN))]
        return {
            "run_id": self.run_id,
            "seq": self.seq,
            "t": t,
            "x": self.machine.read(t),
            "applied": mean if whole else None,
            "pieces": pieces,
            "source": self.source,
            "command_seq": self.command_seq,
        }

    def receive(self, payload, arrived, now):
        """Obey a command, or count the reason why not."""
        try:
            command = msgpack.unpackb(payload)
            reason = "oversized" if len(payload) > LARGEST else self.refusal(command, arrived)
        except (ValueError, TypeError, KeyError):
            reason = "malformed"
        if reason is not None:
            self.refused[f"bad_controller_command_{reason}".replace(" ", "_")] += 1
            return
        self.plan, self.command_seq, self.arrived = command["plan"], command["seq"], arrived
        self.act(now)

    def refusal(self, c, arrived):
        """Return why a command must not be obeyed, or None. Raises if its types are wrong."""
        who, plan = (c["run_id"], c["seq"]), c["plan"]
        if any(type(c[name]) is not kind for name, kind in FIELDS.items()) or c["seq"] >= 2**63:
            return "malformed"
        if not all(math.isfinite(value) for u in plan for value in u):
            return "not finite"
        if not plan or any(len(u) != len(U_MIN) for u in plan):
            return "wrong size"
        if arrived - self.heard <= SILENCE and who[0] != self.leader[0]:
            return "foreign"
        if arrived - self.heard <= SILENCE and who[1] <= self.leader[1]:
            return "out of order"
        self.leader, self.heard = who, arrived
        if not math.isclose(c["period"], PERIOD, rel_tol=1e-6):
            return "wrong period"
        if c["state_seq"] < 0:
            return "answers no sample"
        if c["state_run_id"] != self.run_id or c["state_seq"] > self.seq:
            return "foreign"
        age = arrived - (self.first + c["state_seq"] * PERIOD)
        return "stale" if age > (1 + PATIENCE) * PERIOD else None

    def act(self, now):
        """Write the input that acts from now on: the command's, later its plan's, in the end the safe one."""
        # The small term counts a switching time that rounding delayed as reached.
        periods = (now - self.arrived) / PERIOD + 1e-6
        entry, until = int(periods), int(periods) + 1
        if periods < PATIENCE:
            u, self.source, until = self.plan[0], "command", PATIENCE
        elif entry < len(self.plan):
            u, self.source = self.plan[entry], "plan"
        else:
            u, self.source = self.machine.safe(now), "safe"
        self.switch = self.arrived + until * PERIOD
        self.note(now)
        self.u = [min(max(float(value), low), high) for value, low, high in zip(u, U_MIN, U_MAX, strict=True)]
        self.machine.write(self.u, now)

    def note(self, t):
        """Store which input acted until t."""
        if t > self.since:
            self.pieces.append({"seconds": t - self.since, "u": self.u})
        self.since = t


def settings(endpoint, keys):
    """The Zenoh configuration; keys: folder of a certificate, if the endpoint begins with tls/."""
    tree = {"mode": "client", "connect": {"endpoints": [endpoint], "timeout_ms": -1}}
    tree["scouting"] = {"multicast": {"enabled": False}}
    if keys is not None:
        tls = {"root_ca_certificate": f"{keys}/authority.pem", "connect_private_key": f"{keys}/key.pem"}
        tls |= {"connect_certificate": f"{keys}/certificate.pem", "enable_mtls": True}
        tree["transport"] = {"link": {"tls": tls | {"verify_name_on_connect": True}}}
    return zenoh.Config.from_json5(json.dumps(tree))


def serve(session, gateway, commands):
    """Sleep until a command comes or an action is due, and do it."""
    while True:
        wait = min(gateway.due(), gateway.switch) - time.monotonic()
        try:
            received = commands.get(timeout=max(0.0, wait))
        except queue.Empty:
            received = None
        now = time.monotonic()
        # Samples during a stall are missing. They are not made up later.
        gateway.seq += max(0, math.ceil((now - gateway.due()) / PERIOD - 0.5))
        if now >= gateway.due():
            state = msgpack.packb(gateway.sample())
            session.put(f"{KEY}/plant/state", state, priority=zenoh.Priority.REAL_TIME, express=True)
            if gateway.seq % round(0.5 / PERIOD) == 0:
                health = {"run_id": gateway.run_id, "seq": gateway.seq, "process": "plant", "note": ""}
                health |= {"status": "running", "counters": dict(gateway.refused)}
                session.put(f"{KEY}/plant/health", msgpack.packb(health))
        if now >= gateway.switch:
            gateway.act(now)
        if received is not None:
            gateway.receive(*received, now)


def main(endpoint="tcp/127.0.0.1:7447", keys=None):
    commands = queue.Queue(256)

    def heard(message):
        if not commands.full():
            commands.put((message.payload.to_bytes(), time.monotonic()))

    with contextlib.suppress(
        OSError
    ):  # without this permission, samples are late when other processes use the core
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    with zenoh.open(settings(endpoint, keys)) as session:
        both = f"{KEY}/controller/command", f"{KEY}/@direct/controller/command"
        subscribers = [session.declare_subscriber(key, heard) for key in both]
        machine = Compressor()
        gateway = Gateway(machine, f"plant-{uuid.uuid4().hex[:12]}", time.monotonic() + PERIOD)
        try:
            serve(session, gateway, commands)
        finally:
            machine.write(machine.safe(time.monotonic()), time.monotonic())
            del subscribers


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main(*sys.argv[1:])
