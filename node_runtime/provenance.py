"""What a process runs on and with: of a log's messages, and of figures that were measured."""

from __future__ import annotations

import os
import platform
import re
import time
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path

import threadpoolctl

from node_runtime.config.loading import to_json
from node_runtime.config.sections import Config
from protocol.messages import RunInfo

SCIENCE = ("tandem-control", "numpy", "scipy", "casadi", "daqp")
"""What a controller's numbers depend on."""
CONTROLLER = (*SCIENCE, "msgspec", "eclipse-zenoh")
"""What a controller process consists of."""
PACKAGES = (*CONTROLLER, "torch", "mcap")


def versions(packages: tuple[str, ...] = PACKAGES) -> dict[str, str]:
    """Of Python, and of those of `packages` that are installed here."""
    return {"python": platform.python_version(), **{p: _version(p) for p in packages if _version(p)}}


@cache
def _version(package: str) -> str:
    # Takes milliseconds to read, and a trainer of many plants has one `RunInfo` for each.
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def run_info(
    config: Config,
    process: str,
    run_id: str,
    units: Mapping[str, str] | None = None,
    *,
    packages: tuple[str, ...] = PACKAGES,
    facts: Mapping[str, str] | None = None,
    unix_time: float | None = None,
) -> RunInfo:
    """What a log needs to know about a process.

    units: of its signals, by name. packages: whose versions it says. facts: what it runs with besides, said before
    the versions. unix_time: when it began; None: now.
    """
    found = versions(packages)
    return RunInfo(
        run_id=run_id,
        seq=0,
        process=process,
        config=to_json(config),
        versions={"python": found.pop("python"), **(facts or {}), **found},
        seed=config.seed,
        units=dict(units or {}),
        unix_time=time.time() if unix_time is None else unix_time,
    )


def describe() -> dict[str, str]:
    """The processor, how many of its cores this process may use, and the system; no names of hosts."""
    cores = len(os.sched_getaffinity(0))
    return {
        "processor": _processor(),
        "cores": str(cores),
        "system": f"{platform.system()} {platform.machine()}",
    }


def arithmetic() -> dict[str, str]:
    """What rounds on this machine, beside compiled functions: its processor, and the kernels that its BLAS chose."""
    found = [library for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"]
    # Torch may bring its own, which no controller uses.
    ours = [library for library in found if re.search(r"[/\\](numpy|scipy)\b", library["filepath"])] or found
    kernels = {
        f"{library['internal_api']} {library['version']} {library.get('architecture', '')}"
        for library in ours
    }
    return {"processor": _processor(), "blas": ", ".join(sorted(kernels)).strip() or "unknown"}


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
