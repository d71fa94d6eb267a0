"""Inner kernels as tests call them: from Python, which needs a wrapper that they don't have."""

from typing import Any

from softfinger.kinematics.compiled.kernel import kernel


def called(inner: Any) -> Any:
    """The same source compiled as a kernel that Python may call."""
    return kernel(inner.py_func)
