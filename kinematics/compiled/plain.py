"""Kernels compiled by Numba's public interface alone: what `compiler` does, with any Numba.

Results are the same; a first start takes twice as long, and later ones import all that Numba can
compile. Kernels are kept in the same folder, which names their sources and Numba's version, but by
Numba, without a digest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
from numba import config
from numba.extending import overload

from softfinger.kinematics.compiled.kernel_folder import kernel_folder

_njit: Any = numba.njit
_overload: Any = overload
_config: Any = config


class InnerKernel:
    """Stands for an inner kernel in Python: Numba sees the kernel, a call is refused."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func = function
        self.__name__ = function.__name__
        self.__doc__ = function.__doc__
        self.__module__ = function.__module__
        self._register(options)

    def _register(self, options: dict[str, Any]) -> None:
        """Let Numba know what a compiled caller means."""
        _overload(self, jit_options=options, strict=False)(lambda *_: self.py_func)

    def __call__(self, *values: Any) -> Any:
        """Refuse: inner kernels are compiled for kernels. Raises TypeError."""
        raise TypeError(
            f"{self.__module__}.{self.__name__} is an inner kernel, which only kernels may call; "
            "what Python calls is marked @kernel"
        )


inner = InnerKernel


def compiled(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Return ``function`` as one that Numba compiles and keeps, where there is a folder."""
    folder = kernel_folder()
    # Through the folder as it was opened and judged, whatever its path leads to by now.
    place = f"/proc/self/fd/{folder.descriptor}" if folder else ""
    before, _config.CACHE_DIR = _config.CACHE_DIR, place
    try:
        return _njit(cache=folder is not None, **options)(function)
    finally:
        _config.CACHE_DIR = before
