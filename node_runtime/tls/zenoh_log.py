"""Counts refused links and denied messages from Zenoh's log, and logs them in Tandem's words.

Zenoh can only write its log to standard output. While a router listens for other machines, file descriptor 1 is a pipe
that a thread reads. The thread counts refusals, logs each kind once, and passes on all lines that are not Zenoh's. The
pipe never blocks the router: if the thread falls behind, lines of the log are lost.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import sys
import threading
from collections import OrderedDict
from collections.abc import Iterator

import zenoh

from node_runtime.printable import printable
from node_runtime.rejected import RejectedMessages
from protocol import topics

REFUSED = "error,zenoh_link_tls=warn,zenoh::net::routing::interceptor::access_control=info"
"""Log filter for refused links."""
DENIED = "error,zenoh_link_tls=warn,zenoh::net::routing::interceptor::access_control=trace"
"""Log filter that includes denied messages. Zenoh then logs every message, so it suits slow loops only."""
PIPE_BYTES = 1024 * 1024
READ_BYTES = 256 * 1024
MAX_NAMES = 1000

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_ZENOH_LINE = re.compile(
    r"^\d{4}-\d\d-\d\dT\S+ +[A-Z]+ .*?(?P<thread>ThreadId\(\d+\)) (?P<module>zenoh\S*): (?P<text>.*)$"
)
_TAIL = re.compile(r" Hint: increase the system open file limit\.?$| at /\S+:\d+\.?$")
_UNKNOWN_CLIENT = re.compile(r"^[0-9a-f]+ did not match any configured ACL subject")
_NAMED = re.compile(r"^(?P<zid>[0-9a-f]+) on \S*CertCommonName\((?P<name>[^)]*)\)")
_DENIED = re.compile(
    r"^(?:Using cached result: )?(?P<zid>[0-9a-f]+) (?:on \S+ )?is unauthorized to "
    r"(?P<what>.+?) \(ingress\) on (?P<key>.+)$"
)
# Before the first message on a key, Zenoh checks all permissions for it, in this order and with this end.
_CHECKING, _LAST_QUESTION = "caching permissions for", "Declare Liveliness Subscriber ("
_RELEVANT = (b"unauthorized", b"caching permissions", b"Declare Liveliness Subscriber")
_KNOWN = {*topics.BY_NAME, topics.OUTBOX_QUERY, topics.HIDDEN_QUERY}
_REASONS = (
    ("peer sent no certificates", "it has no certificate"),
    ("UnknownIssuer", "its certificate comes from another authority"),
    ("BadSignature", "its certificate comes from another authority"),
    ("certificate expired", "its certificate has expired"),
    ("certificate not valid yet", "its certificate is not valid yet"),
    ("UnknownCA", "it does not know the authority of our certificate"),
    ("InvalidContentType", "it does not speak TLS"),
    ("corrupt message", "it does not speak TLS"),
)


class Refusals:
    """Reads Zenoh's log line by line. `bad` counts refusals and logs the first of each kind."""

    def __init__(self, bad: RejectedMessages):
        self._bad = bad
        self._checking: set[str] = set()
        self._names: OrderedDict[str, str] = OrderedDict()

    def read(self, line: str) -> bool:
        """Process a line; return whether it belongs to Zenoh's log."""
        found = _ZENOH_LINE.match(_COLOUR.sub("", line).rstrip())
        if found is None:
            return False
        thread, module, text = found["thread"], found["module"], found["text"]
        if module.startswith("zenoh_link"):
            why = _TAIL.sub("", text)
            reason = next((said for mark, said in _REASONS if mark in why), "other")
            self._bad.count("TLS link", f"refused, {reason}", why)
            return True
        if not module.endswith("access_control"):
            return False
        if (named := _NAMED.match(text)) is not None:
            # Every session has a new id, and health checks open one every few seconds, so the size is limited.
            self._names[named["zid"]] = named["name"]
            self._names.move_to_end(named["zid"])
            if len(self._names) > MAX_NAMES:
                self._names.popitem(last=False)
        if _UNKNOWN_CLIENT.match(text):
            self._bad.count("TLS link", "a certificate without rights here", text)
        elif _CHECKING in text:
            self._checking.add(thread)
        elif thread in self._checking and not text.startswith("Using"):
            if _LAST_QUESTION in text:
                self._checking.discard(thread)
        elif (denied := _DENIED.match(text)) is not None:
            name = self._names.get(denied["zid"], "no certificate known here")
            what, key = denied["what"].split("/")[0].lower(), denied["key"]
            # The sender chooses the key, so only known names become part of a counter's name.
            parts = key.split("/", 2)
            own = [topics.PREFIX, name.partition(".")[2]]
            place = parts[2] if parts[:2] == own and parts[2:] and parts[2] in _KNOWN else "elsewhere"
            self._bad.count(
                f"from {name}", f"denied, {what} {place}", f"{key}: beyond the rights of its role"
            )
        return True


@contextlib.contextmanager
def counting_refusals(bad: RejectedMessages, filters: str) -> Iterator[None]:
    """Count refusals in `bad` while a router listens for other machines. Use it once per process, before the router
    opens.

    filters: `REFUSED` or `DENIED`; the environment variable RUST_LOG has precedence.
    """
    sys.stdout.flush()
    real = os.dup(1)
    reading, writing = os.pipe()
    with contextlib.suppress(OSError):  # a smaller pipe is sufficient
        fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    os.set_blocking(writing, False)
    os.dup2(writing, 1)
    os.close(writing)
    reader = threading.Thread(
        target=_read, args=(reading, real, Refusals(bad)), name="zenoh's log", daemon=True
    )
    reader.start()
    zenoh.init_log_from_env_or(filters)
    try:
        yield
    finally:
        os.dup2(real, 1)  # this closes the pipe's last writer, so the reader ends
        reader.join(2.0)
        os.close(real)


def _read(reading: int, real: int, refusals: Refusals) -> None:
    rest = b""
    while chunk := os.read(reading, READ_BYTES):
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            # Most lines are about allowed messages, so skipping them must be cheap.
            if b"is authorized to" in line and not any(mark in line for mark in _RELEVANT):
                continue
            text = line.decode(errors="replace")
            if not refusals.read(text):
                with contextlib.suppress(OSError):  # standard output is closed; refusals are still counted
                    os.write(real, printable(_COLOUR.sub("", text)).encode() + b"\n")
    os.close(reading)
