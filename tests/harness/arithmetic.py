"""The arithmetic of a test run, on which the last bits of its numbers depend, and another one.

``python -m tests.harness.arithmetic MODULE …`` runs ``python -m MODULE …`` under another one:
OpenBLAS with the kernels of an older processor, NumPy without the SIMD loops that it chooses by the
processor, and Numba's kernels for any processor of this kind. Those are kept in a folder of their
own, since the folder's name covers the processor that they were compiled for
(`kinematics.compiled.kernel_folder`).
"""

import ctypes
import os
import platform
import sys

import llvmlite.binding
import numpy as np
from numpy._core import _multiarray_umath

# What chooses another arithmetic than the processor's own.
VARIABLES = (
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
    "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES",
)
_AVX512 = ("skylakex", "cooperlake", "sapphirerapids")  # OpenBLAS's cores that use it


def chosen() -> dict[str, str]:
    """The variables that are set, which choose another arithmetic; empty in a usual run."""
    return {name: os.environ[name] for name in VARIABLES if os.environ.get(name)}


def blas_core() -> str:
    """The processor whose kernels OpenBLAS uses; empty where NumPy has another BLAS."""
    library = ctypes.CDLL(np.linalg._umath_linalg.__file__)
    for name in ("scipy_openblas_get_corename64_", "openblas_get_corename64_"):
        if hasattr(library, name):
            core = getattr(library, name)
            core.restype = ctypes.c_char_p
            return str(core().decode())
    return ""


def simd() -> list[str]:
    """The SIMD extensions that NumPy uses beyond those that it was built for."""
    has = _multiarray_umath.__cpu_features__
    return [name for name in _multiarray_umath.__cpu_dispatch__ if has[name]]


def described() -> str:
    """One line that names the arithmetic."""
    processor = os.environ.get("NUMBA_CPU_NAME") or llvmlite.binding.get_host_cpu_name()
    extensions = " ".join(simd()) or "the baseline"
    return f"OpenBLAS {blas_core() or 'none'}, NumPy {extensions}, kernels for {processor}"


def other() -> dict[str, str]:
    """Variables that choose an arithmetic which this processor has, too."""
    core = blas_core().lower()
    if platform.machine() == "aarch64":
        older = "CORTEXA57" if core == "armv8" else "ARMV8"
    elif core in _AVX512:
        older = "Haswell"
    else:
        older = "Prescott" if core == "nehalem" else "Nehalem"  # NumPy itself asks for Nehalem
    variables = {"OPENBLAS_CORETYPE": older, "NUMBA_CPU_NAME": "generic"}
    extensions = simd()
    return variables | ({"NPY_DISABLE_CPU_FEATURES": " ".join(extensions)} if extensions else {})


def main() -> None:
    """Become the command under the other arithmetic."""
    variables = other()
    named = " ".join(f"{name}='{value}'" for name, value in variables.items())
    print(f"usual arithmetic: {described()}", f"now with {named}", sep="\n", flush=True)
    os.execve(sys.executable, [sys.executable, "-m", *sys.argv[1:]], os.environ | variables)


if __name__ == "__main__":
    main()
