"""The decorators behind every compiled kernel, and nothing else.

A kernel takes arrays, records and scalars and is pure. One that Python calls is a ``kernel``:
compiled by Numba at its first call, with all it calls, and kept in the folder of
`compiled.kernel_folder`. One that only kernels call is an ``inner_kernel`` (``fast_inner_kernel``,
``inlined_kernel``), which costs a fraction to compile and can't be called from Python.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from softfinger.kinematics.compiled.compiler import InnerKernel, KernelCache, KernelCompiler

Function = TypeVar("Function", bound=Callable[..., Any])

_SUMS = {"reassoc", "contract", "nsz", "arcp"}
_njit: Any = numba.njit


def kernel(function: Function) -> Function:
    """Compile ``function`` with Numba: cached on disk, IEEE arithmetic, the GIL kept.

    The GIL is kept because reacquiring it in the loop can cost a whole switch interval.
    """
    dispatcher = _njit(error_model="numpy", no_cfunc_wrapper=True, pipeline_class=KernelCompiler)(
        function
    )
    try:
        dispatcher._cache = KernelCache(function)
    except RuntimeError:
        pass  # no folder: `kernel_folder` has warned
    inner = _inner(function).dispatcher  # for kernels that call it: what is kept has no bitcode
    dispatcher.get_call_template = inner.get_call_template
    dispatcher.get_overload = inner.get_overload
    return cast(Function, dispatcher)


def inner_kernel(function: Function) -> Function:
    """As :func:`kernel`, for what only kernels call. A call from Python raises TypeError."""
    return cast(Function, _inner(function))


def fast_inner_kernel(function: Function) -> Function:
    """As :func:`inner_kernel`, with sums reordered and fused so that they run in SIMD lanes.

    For finite numbers only: NaN and infinity have no defined result there.
    """
    return cast(Function, _inner(function, fastmath=_SUMS))


def inlined_kernel(function: Function) -> Function:
    """As :func:`inner_kernel`, but a part of every caller, and products and sums may be fused.

    For the innermost functions of a hot path, where a call costs as much as the work. Its code is
    there again in each caller, so it should be short.
    """
    return cast(Function, _inner(function, fastmath={"contract"}, forceinline=True))


def _inner(function: Callable[..., Any], **options: Any) -> InnerKernel:
    return InnerKernel(function, {"error_model": "numpy", **options})
