"""Replacement for `compiler` that works with any Numba version, using only public interfaces.

Kernels compiled by either module return identical results. With this module, the first start takes
twice as long. Each later start imports Numba's implementations of Python and NumPy functions. Numba
stores the kernels in the same folder, but without a digest of the content.
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
    """Inner kernel as a Python object, which Numba can compile but Python cannot call."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func = function
        self.__name__ = function.__name__
        self.__doc__ = function.__doc__
        self.__module__ = function.__module__
        self._register(options)

    def _register(self, options: dict[str, Any]) -> None:
        """Register the kernel's type with Numba, so that compiled kernels can call it."""
        _overload(self, jit_options=options, strict=False)(lambda *_: self.py_func)

    def __call__(self, *values: Any) -> Any:
        """Raise TypeError; only kernels can call inner kernels."""
        raise TypeError(
            f"{self.__module__}.{self.__name__} is an inner kernel, which can be called only by "
            "other kernels; decorate it with @kernel to call it from Python"
        )


inner = InnerKernel


def compiled(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Compile ``function`` with Numba; cache the result on disk if a folder is available."""
    folder = kernel_folder()
    # Use the descriptor of the checked folder, because the path may since have been replaced.
    place = f"/proc/self/fd/{folder.descriptor}" if folder else ""
    before, _config.CACHE_DIR = _config.CACHE_DIR, place
    try:
        return _njit(cache=folder is not None, **options)(function)
    finally:
        _config.CACHE_DIR = before
