"""What the figures were measured on and with."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path

PACKAGES = ("tandem-control", "casadi", "daqp", "numpy")


def describe() -> dict[str, str]:
    """The processor, how many of its cores this process may use, and the system; no names of hosts."""
    cores = len(os.sched_getaffinity(0))
    return {
        "processor": _processor(),
        "cores": str(cores),
        "system": f"{platform.system()} {platform.machine()}",
    }


def versions() -> dict[str, str]:
    """Python's and the packages'."""
    return {
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in PACKAGES},
    }


def load() -> float:
    """Processes that wanted a core in the last minute, on average: above the number of cores, times are too long."""
    return os.getloadavg()[0]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    found = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    name = found.get("model name", platform.processor() or "unknown")
    wide = " with AVX-512" if "avx512f" in found.get("flags", "").split() else ""
    return name + wide
