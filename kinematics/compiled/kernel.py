"""The decorators behind every compiled kernel, and which way they are compiled.

A kernel takes arrays, records and scalars and is pure. One that Python calls is a ``kernel``:
compiled by Numba at its first call, with all it calls, and kept in the folder of
`compiled.kernel_folder`. One that only kernels call is an ``inner_kernel`` (``fast_inner_kernel``,
``inlined_kernel``), which costs a fraction to compile and can't be called from Python.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np

from softfinger import SoftfingerError
from softfinger.kinematics.compiled import plain

Function = TypeVar("Function", bound=Callable[..., Any])

# Minor versions of Numba with whose private parts `compiler` was tested.
TESTED = ("0.63", "0.64", "0.65", "0.66", "0.67", "0.68")

# index(k): k as an index that Numba need not look at whether it is negative, and so counts from the
# end, which would keep a loop over it out of SIMD lanes. Added to others of its kind alone.
index: Callable[[int], int] = cast(Any, np.uint64)

_OPTIONS: dict[str, Any] = {"error_model": "numpy"}
_SUMS = {"reassoc", "contract", "nsz", "arcp"}


class JitDisabled(SoftfingerError):
    """Numba is told not to compile. The message says what mends it."""


def _chosen() -> tuple[ModuleType, str]:
    """Return what compiles, and why it is Numba alone, else an empty text."""
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        raise JitDisabled(
            "NUMBA_DISABLE_JIT is set: the kernels run compiled only; unset it to go on"
        )
    if ".".join(numba.__version__.split(".")[:2]) not in TESTED:
        return plain, f"Numba {numba.__version__} is not one of {', '.join(TESTED)}"
    try:
        from softfinger.kinematics.compiled import compiler
    except (ImportError, AttributeError) as error:
        return plain, f"Numba {numba.__version__}: {error}"
    return compiler, ""


_compiler, why_plain = _chosen()


def kernel(function: Function) -> Function:
    """Compile ``function`` with Numba: cached on disk, IEEE arithmetic, the GIL kept.

    The GIL is kept because reacquiring it in the loop can cost a whole switch interval.
    """
    return cast(Function, _compiler.compiled(function, _OPTIONS))


def inner_kernel(function: Function) -> Function:
    """Compile ``function`` for kernels alone; a call from Python raises TypeError."""
    return _inner(function)


def fast_inner_kernel(function: Function) -> Function:
    """Compile an :func:`inner_kernel` whose sums may be reordered and fused to run in SIMD lanes.

    For finite numbers only: NaN and infinity have no defined result there.
    """
    return _inner(function, fastmath=_SUMS)


def inlined_kernel(function: Function) -> Function:
    """Compile an :func:`inner_kernel` into each of its callers; products and sums may be fused.

    For the innermost functions of a hot path, where a call costs as much as the work. Its code is
    repeated in each caller, so it should be short.
    """
    return _inner(function, fastmath={"contract"}, forceinline=True)


def _inner(function: Function, **options: Any) -> Function:
    return cast(Function, _compiler.inner(function, {**_OPTIONS, **options}))
