"""Format of a log file, for writing and reading: its number, channels and metadata."""

from __future__ import annotations

import re
from pathlib import Path

from mcap.records import Header
from mcap.writer import LIBRARY_IDENTIFIER

from run_log.errors import LogError

PROFILE = "tandem"
"""The MCAP profile: what tells our logs from other MCAP files."""
VERSIONS = {1: "0.1.0", 2: "0.2.0", 3: "0.2.0"}
"""By format: the version of Tandem that brought it. A new line is due when an older reader would be misled."""
FORMAT = max(VERSIONS)
"""Number of the format that is written: it determines channels, attachments and metadata."""
READABLE = (2, 3)
"""Formats that this version reads. In format 2 a raw channel has a message's bytes without a wrapping."""
LIBRARY = f"tandem log {FORMAT}; {LIBRARY_IDENTIFIER}"
"""What the header, a file's first record, says of who wrote it: the format's number is in it."""

RAW = "raw/"
"""Channels of a topic's bytes as they travelled (`run_log.raw_message`); those for people are `run_log.views`."""
UNIX_CLOCK = "Unix time of the machine that recorded"
VIRTUAL_CLOCK = "virtual time of the simulation, from its beginning"
TIMES = {
    "log_time": "arrival at the recorder",
    "publish_time": "sending, where a message has a time of its own; else as log_time",
}
"""What the two times of a message mean; both are on the log's one clock."""
IDENTITY = "tandem"
"""Metadata that says what a log is of, and its clock."""
UNITS, VERSIONS_USED, SEEDS, CONFIGURATION = "units", "versions", "seeds", "configuration"
"""Metadata with what the attachments have as well, for viewers that show metadata."""
CONTINUED = "continued"
"""Metadata of a log that goes on in another file."""
RECOVERED = "recovered"
"""Metadata of a log that was made whole again."""
CONFIG = "config.json"
"""The attachment with the resolved configuration."""
PLANT = "plant.json"
"""The attachment with what the controller knew of the plant."""


def check_header(path: Path, header: Header) -> None:
    """Raises `LogError`: the file is MCAP, but no log of Tandem, or has a format that this version does not read."""
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
