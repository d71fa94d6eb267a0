"""Report or change the floating-point environment, which affects the last bits of results.

``python -m tests.harness.arithmetic MODULE …`` runs ``python -m MODULE …`` in a different
environment. In this environment, OpenBLAS uses the kernels of an older processor. NumPy uses only
its baseline SIMD loops, and Numba compiles for a generic processor. The generic kernels are cached
in their own folder (see `kinematics.compiled.kernel_folder`).
"""

import ctypes
import os
import platform
import sys

import llvmlite.binding
import numpy as np
from numpy._core import _multiarray_umath

# Environment variables that override the defaults for this processor.
VARIABLES = (
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
    "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES",
)
_AVX512 = ("skylakex", "cooperlake", "sapphirerapids")  # OpenBLAS cores that use AVX-512


def chosen() -> dict[str, str]:
    """Return those of VARIABLES that are set in this process (usually none)."""
    return {name: os.environ[name] for name in VARIABLES if os.environ.get(name)}


def blas_core() -> str:
    """Return the processor type of the OpenBLAS kernels, or "" if NumPy uses another BLAS."""
    library = ctypes.CDLL(np.linalg._umath_linalg.__file__)
    for name in ("scipy_openblas_get_corename64_", "openblas_get_corename64_"):
        if hasattr(library, name):
            core = getattr(library, name)
            core.restype = ctypes.c_char_p
            return str(core().decode())
    return ""


def simd() -> list[str]:
    """Return the SIMD extensions that NumPy uses beyond its baseline."""
    has = _multiarray_umath.__cpu_features__
    return [name for name in _multiarray_umath.__cpu_dispatch__ if has[name]]


def described() -> str:
    """Describe the floating-point environment in one line."""
    processor = os.environ.get("NUMBA_CPU_NAME") or llvmlite.binding.get_host_cpu_name()
    extensions = " ".join(simd()) or "the baseline"
    return f"OpenBLAS {blas_core() or 'none'}, NumPy {extensions}, kernels for {processor}"


def other() -> dict[str, str]:
    """Return environment variables that select a different floating-point code path."""
    core = blas_core().lower()
    if platform.machine() == "aarch64":
        older = "CORTEXA57" if core == "armv8" else "ARMV8"
    elif core in _AVX512:
        older = "Haswell"
    else:
        older = "Prescott" if core == "nehalem" else "Nehalem"  # NumPy itself requires Nehalem.
    variables = {"OPENBLAS_CORETYPE": older, "NUMBA_CPU_NAME": "generic"}
    extensions = simd()
    return variables | ({"NPY_DISABLE_CPU_FEATURES": " ".join(extensions)} if extensions else {})


def main() -> None:
    """Replace this process with the command, run in the changed environment."""
    variables = other()
    named = " ".join(f"{name}='{value}'" for name, value in variables.items())
    print(f"usual arithmetic: {described()}", f"now with {named}", sep="\n", flush=True)
    os.execve(sys.executable, [sys.executable, "-m", *sys.argv[1:]], os.environ | variables)


if __name__ == "__main__":
    main()
