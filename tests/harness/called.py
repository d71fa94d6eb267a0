"""Compile test wrappers for inner kernels, which Python cannot call directly."""

from typing import Any

from softfinger.kinematics.compiled.kernel import kernel


def called(inner: Any) -> Any:
    """Recompile an inner kernel's source as a kernel that Python can call."""
    return kernel(inner.py_func)
