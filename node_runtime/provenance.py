"""Versions and hardware of a process, for a log's messages and for measured results."""

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
"""Packages that influence a controller's numbers."""
CONTROLLER = (*SCIENCE, "msgspec", "eclipse-zenoh")
"""Packages of a controller process."""
PACKAGES = (*CONTROLLER, "torch", "mcap")


def versions(packages: tuple[str, ...] = PACKAGES) -> dict[str, str]:
    """Return the versions of Python and of the installed packages among `packages`."""
    return {"python": platform.python_version(), **{p: _version(p) for p in packages if _version(p)}}


@cache
def _version(package: str) -> str:
    # Reading takes milliseconds, and a trainer of many plants creates one `RunInfo` for each.
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
    """Return the facts about a process that a log needs.

    Args:
        config: the configuration.
        process: the role.
        run_id: the incarnation.
        units: units of its signals, by name.
        packages: packages whose versions are included.
        facts: further facts, which precede the versions.
        unix_time: start of the process; None for now.
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
    """Return the processor, the number of cores available to this process, and the system, without host names."""
    cores = len(os.sched_getaffinity(0))
    return {
        "processor": _processor(),
        "cores": str(cores),
        "system": f"{platform.system()} {platform.machine()}",
    }


def arithmetic() -> dict[str, str]:
    """Return what determines rounding besides compiled functions: the processor and the kernels of its BLAS."""
    found = [library for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"]
    # Torch may bring a BLAS of its own, which no controller uses.
    ours = [library for library in found if re.search(r"[/\\](numpy|scipy)\b", library["filepath"])] or found
    kernels = {
        f"{library['internal_api']} {library['version']} {library.get('architecture', '')}"
        for library in ours
    }
    return {"processor": _processor(), "blas": ", ".join(sorted(kernels)).strip() or "unknown"}


def load() -> float:
    """Return the load average of the last minute. Above the number of cores, measured times are too long."""
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
