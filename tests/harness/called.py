"""Call inner kernels from Python: they have no wrapper for this, so tests compile one."""

from typing import Any

from softfinger.kinematics.compiled.kernel import kernel


def called(inner: Any) -> Any:
    """Compile the same source as a kernel that can be called from Python."""
    return kernel(inner.py_func)
