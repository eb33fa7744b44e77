"""Format of a log file, for writing and reading: its number, channels and metadata."""

from __future__ import annotations

import re
from pathlib import Path

from mcap.records import Header
from mcap.writer import LIBRARY_IDENTIFIER

from run_log.errors import LogError

PROFILE = "tandem"
"""The MCAP profile, which distinguishes logs of Tandem from other MCAP files."""
VERSIONS = {1: "0.1.0", 2: "0.2.0", 3: "0.3.0"}
"""First version of Tandem with each format. A new format is due when an older reader would misread a log."""
FORMAT = max(VERSIONS)
"""Number of the format that is written: it determines channels, attachments and metadata."""
READABLE = (2, 3)
"""Formats that this version reads. In format 2 a raw channel has a message's bytes without a wrapping."""
LIBRARY = f"tandem log {FORMAT}; {LIBRARY_IDENTIFIER}"
"""Library name in the header, the first record of a file. It contains the number of the format."""

RAW = "raw/"
"""Prefix of channels with the bytes of messages (`run_log.raw_message`). Those for people are `run_log.views`."""
UNIX_CLOCK = "Unix time of the machine that recorded"
VIRTUAL_CLOCK = "virtual time of the simulation, from its beginning"
TIMES = {
    "log_time": "arrival at the recorder",
    "publish_time": "sending, where a message has a time of its own; else as log_time",
}
"""Meaning of the two times of a message; both are on the clock of the log."""
IDENTITY = "tandem"
"""Metadata with the identity of a log, and its clock."""
UNITS, VERSIONS_USED, SEEDS, CONFIGURATION = "units", "versions", "seeds", "configuration"
"""Metadata that repeat attachments, for viewers that show metadata."""
CONTINUED = "continued"
"""Metadata of a log that continues in another file."""
RECOVERED = "recovered"
"""Metadata of a recovered log."""
CONFIG = "config.json"
"""The attachment with the resolved configuration."""
PLANT = "plant.json"
"""The attachment with the controller's numbers of the plant."""


def check_header(path: Path, header: Header) -> None:
    """Raises `LogError` if the MCAP file is not a log of Tandem, or has a format that this version does not read."""
    if header.profile != PROFILE:
        whose = f"profile {header.profile!r}" if header.profile else "no profile"
        raise LogError(
            f"{path}: is an MCAP file with {whose}, written by {header.library!r}, and not a log of Tandem"
        )
    found = re.match(r"tandem log (\d{1,9});", header.library)
    if found is None:
        raise LogError(
            f"{path}: was written as {header.library!r}, which does not name a log format of Tandem"
        )
    number = int(found[1])
    if number not in READABLE:
        way = (
            f"Tandem {VERSIONS[number]} reads it"
            if number in VERSIONS
            else "it needs the version of Tandem that wrote it, or a later one"
        )
        ours = ", ".join(map(str, READABLE))
        raise LogError(f"{path}: has the log format {number}, and this version reads formats {ours}; {way}")
