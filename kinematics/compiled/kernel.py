"""The decorators behind every compiled kernel, and nothing else.

A kernel takes arrays, records and scalars and is pure. One that Python calls is a ``kernel``:
compiled by Numba at its first call, with all it calls, and kept in the folder of
`compiled.kernel_cache`. One that only kernels call is an ``inner_kernel`` (``fast_inner_kernel``,
``inlined_kernel``), which costs a fraction to compile and can't be called from Python.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from softfinger.kinematics.compiled.inner_kernels import InnerKernel, OuterCompiler
from softfinger.kinematics.compiled.kernel_cache import KernelFolder

Function = TypeVar("Function", bound=Callable[..., Any])

_SUMS = {"reassoc", "contract", "nsz", "arcp"}
_njit: Any = numba.njit
_config: Any = numba.config
_LOCATOR = f"{KernelFolder.__module__}.{KernelFolder.__qualname__}"


def kernel(function: Function) -> Function:
    """Compile ``function`` with Numba: cached on disk, IEEE arithmetic, the GIL kept.

    The GIL is kept because reacquiring it in the loop can cost a whole switch interval.
    """
    options = {"error_model": "numpy", "no_cfunc_wrapper": True, "pipeline_class": OuterCompiler}
    # Numba takes the setting when the decorator runs; other people's functions keep their own.
    theirs = _config.CACHE_LOCATOR_CLASSES
    _config.CACHE_LOCATOR_CLASSES = _LOCATOR
    try:
        return cast(Function, _njit(cache=True, **options)(function))
    except RuntimeError:  # no folder: `kernel_folder` has warned
        return cast(Function, _njit(**options)(function))
    finally:
        _config.CACHE_LOCATOR_CLASSES = theirs


def inner_kernel(function: Function) -> Function:
    """As :func:`kernel`, for what only kernels call. A call from Python raises TypeError."""
    return _inner(function, fastmath=False)


def fast_inner_kernel(function: Function) -> Function:
    """As :func:`inner_kernel`, with sums reordered and fused so that they run in SIMD lanes.

    For finite numbers only: NaN and infinity have no defined result there.
    """
    return _inner(function, fastmath=_SUMS)


def inlined_kernel(function: Function) -> Function:
    """As :func:`inner_kernel`, but a part of every caller, and products and sums may be fused.

    For the innermost functions of a hot path, where a call costs as much as the work. Its code is
    there again in each caller, so it should be short.
    """
    return _inner(function, fastmath={"contract"}, forceinline=True)


def _inner(function: Function, **options: Any) -> Function:
    return cast(Function, InnerKernel(function, {"error_model": "numpy", **options}))
