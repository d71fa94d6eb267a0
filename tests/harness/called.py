"""Compile test wrappers for inner kernels, which Python cannot call directly."""

from typing import Any

from softfinger.kinematics.compiled.kernel import kernel


def called(inner: Any) -> Any:
    """Compile the same source as a kernel that can be called from Python."""
    return kernel(inner.py_func)
