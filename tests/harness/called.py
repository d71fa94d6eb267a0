"""Compile inner kernels as kernels that tests can call from Python."""

from typing import Any

from softfinger.kinematics.compiled.kernel import kernel


def called(inner: Any) -> Any:
    """Compile an inner kernel's source as a kernel that Python can call."""
    return kernel(inner.py_func)
