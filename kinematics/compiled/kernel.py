"""Decorators for compiled kernels.

A kernel is a pure function of arrays, records and scalars. A function decorated with ``kernel`` can
be called from Python. When the function is first called, Numba compiles it together with all
functions that it calls. Numba stores the code in the folder that `compiled.kernel_folder` selects.
Only other kernels can call functions decorated with ``inner_kernel``, ``fast_inner_kernel`` or
``inlined_kernel``. Such functions compile in a fraction of the time that a kernel requires.
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

# Minor versions of Numba whose private interfaces were tested with `compiler`.
TESTED_NUMBA = ("0.63", "0.64", "0.65", "0.66", "0.67", "0.68")

# index(k) converts k to an unsigned index. A negative index counts from the end, so Numba tests the
# sign of each signed index. The test prevents vectorisation. Do not mix signed and unsigned
# integers in a sum.
index: Callable[[int], int] = cast(Any, np.uint64)

_OPTIONS: dict[str, Any] = {"error_model": "numpy"}
_SUMS = {"reassoc", "contract", "nsz", "arcp"}


class JitDisabled(SoftfingerError):
    """Error raised if Numba's JIT compilation is disabled."""


def _chosen_compiler() -> tuple[ModuleType, str]:
    """Return the compiler module and the reason for using `plain`, or "" if it is not used."""
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        raise JitDisabled(
            "NUMBA_DISABLE_JIT is set, but the kernels must be compiled; unset this variable"
        )
    if ".".join(numba.__version__.split(".")[:2]) not in TESTED_NUMBA:
        return plain, (
            f"Numba {numba.__version__} has not been tested, expected one of "
            f"{', '.join(TESTED_NUMBA)}"
        )
    try:
        from softfinger.kinematics.compiled import compiler
    except (ImportError, AttributeError) as error:
        return plain, f"Numba {numba.__version__}: {error}"
    return compiler, ""


_compiler, why_plain = _chosen_compiler()


def kernel(function: Function) -> Function:
    """Compile ``function`` with Numba, using an on-disk cache and IEEE arithmetic.

    The kernel keeps the GIL. If a kernel released the GIL, the control loop might have to wait for
    a whole switch interval to reacquire it.
    """
    return cast(Function, _compiler.compiled(function, _OPTIONS))


def inner_kernel(function: Function) -> Function:
    """Compile ``function`` for calls from kernels; a call from Python raises TypeError."""
    return _inner(function)


def fast_inner_kernel(function: Function) -> Function:
    """Compile an :func:`inner_kernel` whose sums may be reordered and fused for vectorisation.

    Results are undefined for NaN and infinity.
    """
    return _inner(function, fastmath=_SUMS)


def inlined_kernel(function: Function) -> Function:
    """Compile an inlined :func:`inner_kernel`, whose products and sums may be fused.

    Use this decorator for the innermost functions of a hot path, where a call costs as much as the
    function body. The code is repeated in each caller, so it should be short.
    """
    return _inner(function, fastmath={"contract"}, forceinline=True)


def _inner(function: Function, **options: Any) -> Function:
    return cast(Function, _compiler.inner(function, {**_OPTIONS, **options}))
