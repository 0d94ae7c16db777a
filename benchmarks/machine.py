"""What the figures were taken on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = (
    *("numpy", "scipy", "casadi", "daqp", "osqp", "filterpy", "do-mpc", "acados_template"),
    *("hydra-core", "mcap"),
)


def describe() -> dict[str, Any]:
    """Processor, load, Python, compiler and the versions that compute."""
    from trms_cli import __version__
    from trms_cli.core.compilation import compiler

    versions = {"trms": __version__}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load_1min": round(load, 2),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "compiler": Path(compiler() or "none").name,
        "threads": os.environ.get("OPENBLAS_NUM_THREADS", "not limited"),
        "versions": versions,
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
