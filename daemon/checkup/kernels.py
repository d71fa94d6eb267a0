"""Numba's cache of compiled kernels: whether it can be written and whether a start will be warm."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from daemon.checkup.result import Result
from daemon.settings import Settings

# Called from the loop or the start-up; what they call is compiled and kept with them.
_SENSING = (("kinematics.ladder", "estimate_frame"), ("kinematics.lookup", "lookup"))
_SIMULATED = (("daemon.simulation.plant", "step"),)


def check_kernels(settings: Settings) -> list[Result]:
    """Whether compiled kernels can be kept, and whether those of this scene are there."""
    kernels = list(_entries(settings))
    if not kernels:
        return [Result("pass", "kernels", "this scene has none")]
    results = []
    folders = sorted({str(kernel._cache.cache_path) for kernel in kernels})
    for folder in folders:
        writable = os.access(_existing(Path(folder)), os.W_OK)
        results.append(
            Result("pass", "kernel cache", f"{folder} may be written")
            if writable
            else Result(
                "warn",
                "kernel cache",
                f"{folder} may not be written: every start compiles for half a minute",
                "export NUMBA_CACHE_DIR=$HOME/.cache/softfinger/kernels",
            )
        )
    cold = [kernel.py_func.__name__ for kernel in kernels if not is_warm(kernel)]
    if cold:
        results.append(
            Result(
                "warn",
                "kernels",
                f"{', '.join(cold)} not compiled yet: the next start takes half a minute",
                "softfinger doctor --fix, or just start it",
            )
        )
    else:
        results.append(Result("pass", "kernels", "compiled, so that a start is short"))
    return results


def is_warm(kernel: Any) -> bool:
    """Whether the cache has this kernel for the present source."""
    # Numba has no public way to ask; the index is empty when its stamp is another source's.
    return bool(kernel._cache._cache_file._load_index())


def _entries(settings: Settings) -> Iterator[Any]:
    names: tuple[tuple[str, str], ...] = ()
    if settings.tactile.backend != "none":
        names += _SENSING
    if "simulated" in (settings.servos.backend, settings.tactile.backend):
        names += _SIMULATED
    for module, name in names:
        yield getattr(importlib.import_module(module), name)


def _existing(path: Path) -> Path:
    """The folder, or the nearest one above it that is there."""
    while not path.exists() and path != path.parent:
        path = path.parent
    return path
